"""The files of a run: plan, proof, plots, pictures, video, report, each of them finished or not there."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner.base.errors import RenderingUnavailable
from planner.base.files import file_error, write_atomically
from planner.base.jsonable import json_text
from planner.cli.console import Console
from planner.problem.plan import Plan, Status
from planner.proof import Proof
from planner.view.plots import CASE_PICTURES, case_pictures, draw_case_picture, draw_plan, draw_proof, save
from planner.view.report import NAME as REPORT
from planner.view.report import write_report

if TYPE_CHECKING:
    from planner.proof.refinement import Refinement

INTERRUPTED = "The pictures were interrupted."
PICTURES = ("plots.png", *CASE_PICTURES.values(), "proof.png", "strip.png", "video.mp4")
OUTPUTS = ("plan.npz", "proof.json", *PICTURES, REPORT)


def write_results(plan: Plan, proof: Proof | None, folder: Path, video: bool, console: Console) -> str:
    """Write everything into a folder; returns why there is no video, or "".

    Args:
        plan: As solved.
        proof: Of the plan; None for a plan that is not finite or whose replay was interrupted.
        folder: An existing folder.
        video: Whether to draw with OpenGL.
        console: For progress.
    """
    plan.save(folder / "plan.npz")
    write_proof(plan, proof, folder)
    return draw_results(plan, proof, folder, video, console)


def write_proof(plan: Plan, proof: Proof | None, folder: Path, path: Sequence[Refinement] = ()) -> None:
    """Write proof.json, also for a plan that was not replayed; `path` is how the plan was refined."""
    content = proof.to_dict() if proof is not None else _no_proof(plan)
    if path:
        content["refinement"] = [refinement_row(line) for line in path]
    with write_atomically(folder / "proof.json") as unfinished:
        unfinished.write_text(json_text(content), encoding="utf-8")


def draw_results(
    plan: Plan,
    proof: Proof | None,
    folder: Path,
    video: bool,
    console: Console,
    path: Sequence[Refinement] = (),
    keep: Collection[str] = frozenset(),
    options: Mapping[str, Any] | None = None,
) -> str:
    """Draw the pictures and the report into a folder, one finished file after the other; returns why there is no video.

    What is interrupted leaves the files before it finished and none half written, and a report of what there is.

    Args:
        plan: As solved.
        proof: Of the plan; None for a plan that is not finite or whose replay was interrupted.
        folder: An existing folder. Pictures in it that are not kept are removed first: they are of an older plan.
        video: Whether to draw with OpenGL.
        console: For progress.
        path: How the plan was refined, if it was.
        keep: Names of files that are finished and of this very plan and proof. The report is kept when nothing else
            had to be drawn.
        options: Flags that the command was given, for the report.
    """
    wanted = _pictures(plan, proof, folder, video, console)
    for name in PICTURES:
        if name not in keep:
            _remove(folder / name)
    note = "" if video else "It was not asked for (--no-video)."
    if proof is None:
        note = "There is nothing to film: the plan was not replayed."
    drawn = False
    try:
        for name, draw in wanted.items():
            if name not in keep:
                draw(folder / name)
                drawn = True
    except RenderingUnavailable as error:
        note = str(error)
    except KeyboardInterrupt:  # the plan and its proof are worth keeping without pictures
        note, drawn = INTERRUPTED, True
    if drawn or REPORT not in keep:
        write_report(plan, proof, folder, video_note=note, path=path, options=options)
    return note


def _pictures(
    plan: Plan, proof: Proof | None, folder: Path, video: bool, console: Console
) -> dict[str, Callable[[Path], object]]:
    """How each picture of a run is drawn, the quickest first."""
    pictures: dict[str, Callable[[Path], object]] = {"plots.png": lambda file: save(draw_plan(plan, proof), file)}
    if proof is not None:
        for name, picture in case_pictures(plan, proof.replay).items():
            pictures[name] = lambda file, picture=picture: save(draw_case_picture(picture), file)
        pictures["proof.png"] = lambda file: save(draw_proof(proof), file)
        if video:
            from planner.view.render.video import render_strip, render_video

            def film(file: Path) -> object:
                return render_video(proof, file, progress=lambda done, of: console.progress("video", done, of))

            pictures["strip.png"] = lambda file: render_strip(proof.replay, file)
            pictures["video.mp4"] = film
    return pictures


def _remove(file: Path) -> None:
    try:
        file.unlink(missing_ok=True)
    except OSError as error:
        raise file_error(error, file) from error


def _no_proof(plan: Plan) -> dict[str, Any]:
    return {"verdict": "FAIL", "mode": None, "reason": f"The plan was not replayed. {plan.message}"}


def refinement_row(line: Refinement) -> dict[str, Any]:
    """One step of a refinement as JSON values."""
    return line._asdict() | {"status": line.status.name}


def plan_facts(plan: Plan) -> dict[str, Any]:
    """A plan in JSON values, without its arrays."""
    return {
        "case": plan.case, "parameters": plan.parameters, "status": plan.status.name, "success": plan.success,
        "message": plan.message, "cost": plan.cost, "gradient_norm": plan.gradient_norm, "iterations": plan.nit,
        "starts": [start._asdict() | {"status": start.status.name} for start in plan.starts], "start": plan.start,
        "horizon": plan.N, "dt": plan.dt, "versions": plan.versions,
        "objective": None if plan.problem is None or plan.problem.objective is None else plan.problem.objective.weights,
    }  # fmt: skip


def show_plan(plan: Plan, seconds: float | None, console: Console) -> None:
    """The solve in two lines."""
    took = "" if seconds is None else f", {1e3 * seconds:.3g} ms"
    console.say(
        f"{plan.status.name}: {plan.nit} iterations, cost {plan.cost:.8g}, |gradient| {plan.gradient_norm:.2e}{took}"
    )
    if plan.starts:
        converged = sum(start.status is Status.CONVERGED for start in plan.starts)
        console.say(f"start {plan.start} of {len(plan.starts)} is the best; {converged} converged")
    if not plan.success:
        console.say(plan.message)


def show_proof(proof: Proof, console: Console) -> None:
    """Every figure beside its bound, then the verdict."""
    console.say()
    console.table(("step", "figure", "value", "bound", ""), proof.rows())
    for section in proof.sections.values():
        if section.not_applicable:
            console.say(f"{section.title}: not applicable, {section.not_applicable}")
    for line in proof.monte_carlo.lines() if proof.monte_carlo is not None else ():
        console.say(line)
    mode = f" ({proof.mode})" if proof.mode else ""
    console.say(f"\n{proof.verdict}{mode}: {proof.reason}")
