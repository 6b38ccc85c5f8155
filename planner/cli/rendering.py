"""The command `render`: film the replay of a stored plan."""

from __future__ import annotations

import argparse
from pathlib import Path

from planner.base.errors import PlannerError
from planner.base.gl import require_backend
from planner.cli.allowed_imports import load_allowed
from planner.cli.console import Console
from planner.cli.proving import rollout_of
from planner.proof import Proof, prove


def render_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Film both replays of a stored plan, or one perturbed simulation."""
    from planner.view.render.video import render_strip, render_video

    out = Path(arguments.out)
    if out.suffix not in (".mp4", ".png"):
        raise PlannerError(f"cannot render to {out}: expected a name ending in .mp4 or .png.")
    plan = load_allowed(arguments.plan, arguments)
    require_backend()
    shown = prove(plan, rollouts=0) if arguments.replay_rollout is None else rollout_of(plan, arguments)
    size = {} if arguments.size is None else dict(zip(("width", "height"), arguments.size, strict=True))
    if out.suffix == ".png":
        render_strip(shown.replay if isinstance(shown, Proof) else shown, out, **size)
    else:
        progress = console.progress("video")
        render_video(shown, out, fps=arguments.fps, speed=arguments.speed, progress=progress, **size)
    console.write_result(str(out))
    return console.finish("render", 0, file=str(out))
