"""The files of a run: plan, proof, plots, pictures, video, report, written as one set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from planner.console import Console
from planner.errors import RenderingUnavailable
from planner.jsonable import finite
from planner.plan import Plan, Status
from planner.plots import plot_plan
from planner.proof import Proof
from planner.replay import Replay
from planner.report import write_report

INTERRUPTED = "The pictures were interrupted."
OUTPUTS = ("plan.npz", "proof.json", "plots.png", "strip.png", "video.mp4", "report.html")


def json_text(content: dict[str, Any]) -> str:
    """A JSON document as the files of a run hold it."""
    return json.dumps(finite(content), indent=2, allow_nan=False) + "\n"


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
    content = proof.to_dict() if proof is not None else _no_proof(plan)
    (folder / "proof.json").write_text(json_text(content), encoding="utf-8")
    replay = proof.replay if proof is not None else None
    note = "" if video else "It was not asked for (--no-video)."
    try:
        plot_plan(plan, replay, folder / "plots.png")
        if replay is None:
            note = "There is nothing to film: the plan was not replayed."
        elif video:
            _draw(replay, folder, console)
    except RenderingUnavailable as error:
        note = str(error)
    except KeyboardInterrupt:  # the plan and its proof are worth keeping without pictures
        note = INTERRUPTED
    write_report(plan, proof, folder, video_note=note)
    return note


def _draw(replay: Replay, folder: Path, console: Console) -> None:
    from planner.render import render_strip, render_video

    render_strip(replay, folder / "strip.png")
    render_video(replay, folder / "video.mp4", progress=lambda done, total: console.progress("video", done, total))


def _no_proof(plan: Plan) -> dict[str, Any]:
    return {"verdict": "FAIL", "mode": None, "reason": f"The plan was not replayed. {plan.message}"}


def plan_facts(plan: Plan) -> dict[str, Any]:
    """A plan in JSON values, without its arrays."""
    return {
        "case": plan.case, "parameters": plan.parameters, "status": plan.status.name, "success": plan.success,
        "message": plan.message, "cost": plan.cost, "gradient_norm": plan.gradient_norm, "iterations": plan.nit,
        "starts": [start._asdict() | {"status": start.status.name} for start in plan.starts], "start": plan.start,
        "horizon": plan.N, "dt": plan.dt, "versions": plan.versions,
    }  # fmt: skip


def show_plan(plan: Plan, seconds: float, console: Console) -> None:
    """The solve in two lines."""
    console.say(
        f"{plan.status.name}: {plan.nit} iterations, cost {plan.cost:.8g}, |gradient| {plan.gradient_norm:.2e}, "
        f"{1e3 * seconds:.3g} ms"
    )
    if plan.starts:
        converged = sum(start.status is Status.CONVERGED for start in plan.starts)
        console.say(f"start {plan.start} of {len(plan.starts)} is the best; {converged} converged")
    if not plan.success:
        console.say(plan.message)


def show_proof(proof: Proof, console: Console) -> None:
    """Every figure beside its bound, then the verdict."""
    rows = []
    for section in proof.sections.values():
        for figure in section.figures:
            bound = "" if figure.bound is None else f"{figure.bound:g}"
            mark = "" if figure.bound is None else ("ok" if figure.passed else "FAIL")
            value = f"{figure.value:.5g} {figure.unit}".rstrip()
            rows.append((section.title, figure.name.replace("_", " "), value, bound, mark))
    console.say()
    console.table(("step", "figure", "value", "bound", ""), rows)
    for section in proof.sections.values():
        if section.not_applicable:
            console.say(f"{section.title}: not applicable, {section.not_applicable}")
    mode = f" ({proof.mode})" if proof.mode else ""
    console.say(f"\n{proof.verdict}{mode}: {proof.reason}")
