"""The command `view`: look at a stored plan in MuJoCo's viewer."""

from __future__ import annotations

import argparse
from pathlib import Path

from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.cli.allowed_imports import load_allowed
from planner.cli.console import Console


def view_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Play the replays of a plan, or of the plan in a folder of `planner run`, in a window."""
    from planner.view.playing import KEYS
    from planner.view.viewer import require_display, view

    count("rollouts", arguments.rollouts, minimum=0)
    if arguments.speed is not None:
        number("speed", arguments.speed, greater_than=0.0)
    require_display()  # before the work
    path = Path(arguments.plan)
    plan = load_allowed(path / "plan.npz" if path.is_dir() else path, arguments)
    if plan.twin is None:
        raise PlannerError("the plan holds no MuJoCo model, expected a plan of a Problem with a twin.")
    console.table(("key", "what it does"), KEYS)
    view(plan, rollouts=arguments.rollouts, speed=arguments.speed)
    return console.finish("view", 0)
