"""The results of a run: its proof is printed, its files (proof, plots, video, report) are each complete or absent.

Strip and film are drawn in the background, beside the rollouts of the proof. Child processes draw, so that a thread of
this one has little to do. What comes in its way is raised by finish().
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.data_files import write_json
from planner.base.errors import RenderingUnavailable
from planner.base.files import file_error
from planner.base.gl import backend
from planner.cli.console import Console
from planner.cli.solving import show_fixes
from planner.model.mjcf.model_index import compile_model
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.proof import Proof
from planner.proof.diagnostics import SuggestedFix
from planner.proof.prove_plan import with_informative_sections, with_rollouts, without_informative_sections
from planner.solvers.work import WorkBudget
from planner.view.plots.case_pictures import CASE_PICTURES, case_pictures, draw_case_picture
from planner.view.plots.plan import draw_plan
from planner.view.plots.proof import draw_proof
from planner.view.plots.style import save
from planner.view.report.page import NAME as REPORT
from planner.view.report.page import write_report

if TYPE_CHECKING:
    from planner.proof.repair.refinement import Refinement

_FILMS = ("strip.png", "video.mp4")
_PATIENCE = 0.1  # s between two looks at the progress


def checked_looks(arguments: argparse.Namespace, twin: Twin | None, *, film: bool = True) -> dict[str, Any]:
    """Width, height and camera that the flags ask for, as arguments of render_video.

    Where it is no `film` but a strip, also whether that is transparent, as arguments of render_strip.

    Raises:
        PlannerError: A size or a direction that no film can have, or a camera that the model does not have.
    """
    from planner.view.render.camera import angles_of_camera, checked_direction
    from planner.view.render.video import check_size

    looks: dict[str, Any] = {"camera": arguments.camera} | ({} if film else {"transparent": arguments.transparent})
    if arguments.size is not None:
        looks |= dict(zip(("width", "height"), arguments.size, strict=True))
        check_size(*arguments.size, even=film)
    if isinstance(arguments.camera, tuple):
        checked_direction(arguments.camera)
    elif arguments.camera is not None and twin is not None:
        angles_of_camera(compile_model(twin.mjcf, twin.assets), arguments.camera)
    return looks


class _Stopped(Exception):
    """The film is no longer wanted."""


class BackgroundRender:
    """Strip and film of a proof on their way into a folder; a context manager, at whose end nothing draws any more."""

    def __init__(
        self, proof: Proof, folder: Path, keep: Collection[str], console: Console,
        looks: dict[str, Any] | None = None, transparent: bool = False,
    ) -> None:  # fmt: skip
        """Begin with the files that are not named in `keep`. Without an OpenGL library there is nothing to do.

        `looks` are width, height and camera of the film (checked_looks()); the strip has the camera, and may be
        `transparent`.
        """
        self.names = tuple(name for name in _FILMS if name not in keep) if backend() is not None else ()
        self._proof, self._folder, self._console = proof, folder, console
        self._looks, self._transparent = looks or {}, transparent
        self._stop, self._error = threading.Event(), None
        self._done = (0, 0)  # frames, and frames in all
        self._thread = threading.Thread(target=self._draw, name="film", daemon=True)
        if self.names:
            self._thread.start()

    def finish(self, deadline: float | None = None) -> bool:
        """Wait for the files, until a deadline of time.monotonic() at most, and show how far they are.

        Returns whether they are finished.

        Raises:
            RenderingUnavailable: The OpenGL library is there but does not work.
            FileError: A file cannot be written.
        """
        show = self._console.progress("video")
        while self._thread.is_alive():
            self._thread.join(_PATIENCE)
            if deadline is not None and time.monotonic() >= deadline and self._thread.is_alive():
                return False
            if 0 < self._done[0] < self._done[1]:
                show(*self._done)
        if self._error is not None:
            raise self._error
        if self._done[1]:
            show(*self._done)
        return True

    def __enter__(self) -> BackgroundRender:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        with suppress(RuntimeError):  # it was never started
            self._thread.join()

    def _draw(self) -> None:
        from planner.view.render.video import render_strip, render_video

        try:
            if "strip.png" in self.names:
                strip, camera = self._folder / "strip.png", self._looks.get("camera")
                render_strip(self._proof.replay, strip, camera=camera, transparent=self._transparent)
            if "video.mp4" in self.names:
                render_video(self._proof, self._folder / "video.mp4", progress=self._count, **self._looks)
        except _Stopped:
            pass
        except BaseException as error:
            self._error = error

    def _count(self, done: int, total: int) -> None:
        if self._stop.is_set():
            raise _Stopped
        self._done = (done, total)


INTERRUPTED = "The drawing of pictures was interrupted."
OUT_OF_TIME = "The time budget was reached before all pictures were drawn."
PICTURES = ("plots.png", *CASE_PICTURES.values(), "proof.png", *_FILMS)
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
    plan: Plan, proof: Proof | None, folder: Path, fixes: Sequence[SuggestedFix], video: bool, console: Console,
    path: Sequence[Refinement] = (), keep: Collection[str] = frozenset(), options: Mapping[str, Any] | None = None,
    films: BackgroundRender | None = None, budget: WorkBudget | None = None,
) -> str:  # fmt: skip
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
    console.write_progress(f"\nbefore the perturbed simulations: {early.headline}")
    console.write_progress("What is measured now does not change PASS or FAIL and is shown beside it:")
    return with_rollouts(
        with_informative_sections(proof, console.write_passing),
        rollouts,
        progress=console.progress("perturbed simulations"),
        **options,
    )


def refinement_row(line: Refinement) -> dict[str, Any]:
    """A step of a refinement as JSON values."""
    return line._asdict() | {"status": line.status.name}


def show_work(budget: WorkBudget, console: Console) -> None:
    """Print where the work of a run went, and which limit ended it, if any."""
    console.write_result(f"work: {budget}" + (f"; ended by its {budget.end.name}" if budget.exhausted else ""))


def show_proof(proof: Proof, fixes: Sequence[SuggestedFix], console: Console, whole: bool = False) -> None:
    """Print each step of a proof by its number that is nearest to its bound, or `whole`; then the verdict."""
    whole = whole or console.verbose
    console.write_result()
    rows = proof.rows() if whole else [row for section in proof.sections.values() for row in section.judged_rows()]
    console.table(("step", "measured" if whole else "nearest to its bound", "value", "bound", ""), rows)
    for section in proof.sections.values():
        if section.not_applicable:
            console.write_result(f"{section.title}: not applicable, {section.not_applicable}")
    for line in proof.monte_carlo.lines() if proof.monte_carlo is not None else ():
        console.write_result(line)
    console.write_result("\n".join(["", proof.headline, proof.reason, *filter(None, [proof.own_step])]))
    show_fixes(fixes, console)
