"""Write the files of a run (proof, plots, video, report), each complete or absent."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.errors import RenderingUnavailable
from planner.base.files import file_error
from planner.base.json_files import write_json
from planner.cli.background_render import BackgroundRender
from planner.cli.console import Console
from planner.cli.showing import refinement_row
from planner.problem.plan import Plan
from planner.proof import Proof
from planner.proof.diagnostics import SuggestedFix
from planner.proof.prove_plan import with_informative_sections, with_rollouts, without_informative_sections
from planner.solvers.work import WorkBudget
from planner.view.plots import CASE_PICTURES, case_pictures, draw_case_picture, draw_plan, draw_proof, save
from planner.view.report import NAME as REPORT
from planner.view.report import write_report

if TYPE_CHECKING:
    from planner.proof.repair.refinement import Refinement

INTERRUPTED = "The drawing of pictures was interrupted."
OUT_OF_TIME = "The time budget was reached before all pictures were drawn."
PICTURES = ("plots.png", *CASE_PICTURES.values(), "proof.png", "strip.png", "video.mp4")
Draw = Callable[[Path], object]
OUTPUTS = ("plan.npz", "proof.json", *PICTURES, REPORT)


def is_finite(plan: Plan) -> bool:
    """Whether a plan can be replayed."""
    return bool(np.isfinite(plan.xs).all() and np.isfinite(plan.cost))


def write_proof(
    plan: Plan, proof: Proof | None, folder: Path, digest: str, fixes: Sequence[SuggestedFix],
    path: Sequence[Refinement] = (), budget: WorkBudget | None = None,
) -> None:  # fmt: skip
    """Write proof.json, also for a plan that was not replayed.

    `digest` is that of the plan's file, `fixes` say what to write so that it passes, and `path` lists the refinements
    of the plan. A `budget` that ended the run says where its work went.
    """
    failed = {"verdict": "FAIL", "mode": None, "reason": f"The plan was not replayed. {plan.message}"}
    content = (failed if proof is None else proof.to_dict()) | {"plan_digest": digest}
    if fixes:
        content["cures"] = [one.to_dict() for one in fixes]
    if path:
        content["refinement"] = [refinement_row(line) for line in path]
    if budget is not None and budget.exhausted:  # else the file is that of `planner prove`
        content["budget"] = budget.to_dict()
    write_json(folder / "proof.json", content)


def draw_results(
    plan: Plan,
    proof: Proof | None,
    folder: Path,
    fixes: Sequence[SuggestedFix],
    video: bool,
    console: Console,
    path: Sequence[Refinement] = (),
    keep: Collection[str] = frozenset(),
    options: Mapping[str, Any] | None = None,
    films: BackgroundRender | None = None,
    budget: WorkBudget | None = None,
) -> str:
    """Draw the pictures and the report into a folder; returns why there is no video, or "".

    Files named in `keep` are of this plan and stay; other pictures are removed first. An interruption leaves the
    finished pictures and a report of them. `path` (the refinements) and `options` (the flags) are for the report.
    `films` are on their way into this folder already. After the deadline of a `budget` no more are drawn.
    """
    coming = films.names if films is not None else ()
    wanted = {name: draw for name, draw in _pictures(plan, proof, video, console).items() if name not in keep}
    for name in set(PICTURES) - set(keep) - set(coming):
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise file_error(error, folder / name) from error
    film_status = "" if video else "No video was asked for (--no-video)."
    if proof is None:
        film_status = "There is nothing to film: the plan was not replayed."
    try:
        for name, draw in wanted.items():
            if budget is not None and budget.out_of_time:
                film_status = OUT_OF_TIME
            elif name not in coming:
                draw(folder / name)
        if films is not None and not films.finish(None if budget is None else budget.deadline):
            film_status = OUT_OF_TIME
    except RenderingUnavailable as error:
        film_status = str(error)
    except KeyboardInterrupt:  # the plan and its proof are worth keeping without pictures
        film_status = INTERRUPTED
    if wanted or REPORT not in keep:
        write_report(
            plan, proof, folder, video_note=film_status, path=path, options=options, fixes=fixes
        )  # fmt: skip
    return film_status


def _pictures(plan: Plan, proof: Proof | None, video: bool, console: Console) -> dict[str, Draw]:
    """Functions that draw the pictures of a run, by file name, quick ones first."""
    pictures: dict[str, Draw] = {"plots.png": lambda file: save(draw_plan(plan, proof), file)}
    if proof is not None:
        for name, picture in case_pictures(plan, proof.replay).items():
            pictures[name] = lambda file, picture=picture: save(draw_case_picture(picture), file)
        pictures["proof.png"] = lambda file: save(draw_proof(proof), file)
        if video:
            from planner.view.render.video import render_strip, render_video

            pictures["strip.png"] = lambda file: render_strip(proof.replay, file)
            pictures["video.mp4"] = lambda file: render_video(proof, file, progress=console.progress("video"))
    return pictures


def completed(proof: Proof, rollouts: int, console: Console, *, missing: str = "", **options: Any) -> Proof:
    """Note the verdict at once, then measure what does not change it, with so many rollouts.

    `missing` is why that is left out, said in the proof; `options` are those of prove_plan.with_rollouts().
    No rollouts leave the proof as it is. show_proof() is to follow: the verdict is printed there, once.
    """
    if not rollouts:
        return proof
    if missing:
        return without_informative_sections(proof, missing)
    early = replace(proof, asked=proof.asked | {"rollouts": rollouts})  # robustness is not known yet
    console.write_progress(f"\nbefore the perturbed simulations: {early.headline}\n{early.reason}")
    console.write_progress("What is measured now does not change PASS or FAIL and is shown beside it:")
    return with_rollouts(
        with_informative_sections(proof, console.write_progress),
        rollouts,
        progress=console.progress("perturbed simulations"),
        **options,
    )
