"""The commands `render`, `view`, `report` and `export`: a stored plan as a film, in a window, as a page, for others."""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path

from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.base.files import staged_folder
from planner.base.gl import require_backend
from planner.cli.console import Console
from planner.cli.parser import FORMATS
from planner.cli.proving import load_allowed
from planner.problem.archive import plan_digest
from planner.problem.export import left_out, sampled
from planner.problem.plan import Plan
from planner.proof import Proof, prove
from planner.proof.diagnostics import suggested_fixes


def render_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Film both replays of a stored plan, or one perturbed simulation."""
    from planner.cli.proving import rollout_of
    from planner.cli.results import checked_looks
    from planner.view.render.encoder import FILMS
    from planner.view.render.video import render_strip, render_video

    out = Path(arguments.out)
    if out.suffix not in (*FILMS, ".png"):
        raise PlannerError(f"cannot render to {out}: expected a name ending in {', '.join(FILMS)} or .png.")
    if arguments.transparent and out.suffix != ".png":
        raise PlannerError(f"--transparent is for pictures, not for {out}: expected a name ending in .png.")
    plan = load_allowed(arguments.plan, arguments)
    looks = checked_looks(arguments, plan.twin, film=out.suffix in FILMS)
    require_backend()
    shown = prove(plan, rollouts=0) if arguments.replay_rollout is None else rollout_of(plan, arguments)
    if out.suffix == ".png":
        shown = shown.replay if isinstance(shown, Proof) else shown
        render_strip(shown, out, **looks)
    else:
        progress = console.progress("video")
        render_video(shown, out, fps=arguments.fps, speed=arguments.speed, progress=progress, **looks)
    console.write_result(str(out))
    return console.finish("render", 0, file=str(out))


def view_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Play the replays of a plan, or of the plan in a folder of `planner run`, in a window or a browser."""
    from planner.view.viewer import KEYS, require_display, view

    count("port", arguments.port, maximum=65535)
    if arguments.speed is not None:
        number("speed", arguments.speed, greater_than=0.0)
    if not arguments.browser:
        require_display()  # before the work
    path = Path(arguments.plan)
    plan = load_allowed(path / "plan.npz" if path.is_dir() else path, arguments)
    if plan.twin is None:
        raise PlannerError("the plan holds no MuJoCo model, expected a plan of a Problem with a twin.")
    if arguments.browser:
        from planner.view.browser import browse

        browse(plan, port=arguments.port, speed=arguments.speed, ready=console.write_result)
        return console.finish("view", 0)
    console.table(("key", "what it does"), KEYS)
    view(plan, rollouts=arguments.rollouts, speed=arguments.speed)
    return console.finish("view", 0)


def report_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Prove a stored plan again and write all its files."""
    from planner.cli.results import (
        OUTPUTS,
        BackgroundRender,
        checked_looks,
        completed,
        draw_results,
        is_finite,
        show_proof,
        write_proof,
    )

    plan = load_allowed(arguments.plan, arguments)
    if arguments.files:
        packed = {name: len(content) for name, content in _packed(plan).items()}
        console.table(("packed into the plan", "bytes"), [(name, str(size)) for name, size in packed.items()])
        return console.finish("report", 0, files=packed)
    looks = checked_looks(arguments, plan.twin)
    with staged_folder(arguments.out, OUTPUTS) as staged, ExitStack() as drawing:
        proof, films = None, None
        if is_finite(plan):
            proof = prove(plan, rollouts=0, hold_seconds=arguments.hold)
            if not arguments.no_video:
                drawn = BackgroundRender(proof, staged, (), console, looks, arguments.transparent)
                films = drawing.enter_context(drawn)
            proof = completed(proof, arguments.rollouts, console)
        plan.save(staged / "plan.npz")
        fixes = suggested_fixes(plan, proof)
        write_proof(plan, proof, staged, plan_digest(staged / "plan.npz"), fixes)
        if proof is not None:
            show_proof(proof, fixes, console)
        draw_results(plan, proof, staged, fixes, not arguments.no_video, console, films=films)
    console.write_result(f"\n{Path(arguments.out) / 'report.html'}")
    passed = proof is not None and proof.passed
    return console.finish("report", 0 if passed else 1, folder=arguments.out)


def _packed(plan: Plan) -> dict[str, bytes]:
    """What a plan holds of other files, by name: the task with tables that it named, the models, what these name."""
    packed: dict[str, bytes] = {}
    if plan.recipe is not None:
        packed[f"task: {plan.recipe.name}"] = json.dumps(plan.recipe.parameters).encode()
    if plan.twin is not None:
        texts = {"model, as planned": plan.twin.mjcf, "model, as given": plan.twin.original}
        packed |= {name: text.encode() for name, text in texts.items() if text} | plan.twin.assets
    return packed


def export_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Write a stored plan as a table, as a joint trajectory or as keyframes."""
    form, rate = arguments.to, arguments.rate
    if arguments.only is not None and form != "csv":
        raise PlannerError(f"--only is for --to csv, expected none with --to {form}.")
    plan = load_allowed(arguments.plan, arguments)
    out = Path(arguments.plan).with_suffix(FORMATS[form]) if arguments.out is None else Path(arguments.out)
    if form in ("json", "yaml") and not (out.suffix == ".json" if form == "json" else out.suffix in (".yaml", ".yml")):
        raise PlannerError(f"cannot write {form} to {out}: expected a name ending in {FORMATS[form]}.")
    rows = len(sampled(plan, rate).t) - (arguments.only == "controls")
    missing: tuple[str, ...] = ()
    if form == "csv":
        plan.to_csv(out, rate, arguments.only)
    elif form == "keyframes":
        plan.to_keyframes(out, rate)
    else:
        plan.to_joint_trajectory(out, rate)
        missing = left_out(plan)
    if missing:
        console.write_result(f"left out, since the message has hinges and slides alone: {', '.join(missing)}")
    console.write_result(
        f"{out}: {rows} {'keyframes' if form == 'keyframes' else 'rows' if form == 'csv' else 'points'}"
    )
    return console.finish("export", 0, file=str(out), form=form, samples=rows, left_out=list(missing))
