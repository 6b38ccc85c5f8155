"""The command `run` (plan, prove, repair a plan that fails, plot and film, into one folder).

Every file of the folder appears when it is finished. A hidden file, the mark, names the run that the files belong to.
It is written with the first file and removed after the last one. A later run with the same identity that finds the mark
makes only the missing files.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from planner.base.arguments import number
from planner.base.data_files import finite, json_text
from planner.base.environment import installed_versions
from planner.base.errors import PlannerError
from planner.base.files import (
    PathLike,
    also_reading,
    file_error,
    folder_lock,
    open_folder,
    remove_empty,
    write_atomically,
)
from planner.cases.plan_file import load_plan
from planner.cases.problem_file import ProblemFile
from planner.cli import results, solving
from planner.cli.console import Console
from planner.cli.results import BackgroundRender, checked_looks
from planner.cli.solving import INTERRUPTED, asked_problem, name_of, solved
from planner.problem.archive import plan_digest
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import Proof, prove
from planner.proof.compare.model_parity import parity
from planner.proof.diagnostics import suggested_fixes
from planner.proof.goal_regulator import hold_gain
from planner.proof.repair import Repaired, Step, Tools, repair
from planner.proof.repair.clearance import ClearanceRefinement
from planner.proof.repair.continued import Resumption, SaddleStep
from planner.proof.repair.fixes import FixTrial
from planner.proof.repair.refinement import Refined, Refinement
from planner.solvers.work import DEFAULT_WORK, WorkBudget, work_of_proof
from planner.sweeps.processes import executor_of

MARK = ".planner-unfinished.json"
ROLLOUTS = ".planner-rollouts.npz"  # finished rollouts of a Monte Carlo


@dataclass
class RunFolder:
    """A folder that a run writes into."""

    path: Path
    outputs: tuple[str, ...]  # names of all files that a run may have
    run: str  # digest of the run's identity
    notes: dict[str, Any] = field(default_factory=dict)  # for the run that continues this one
    began: bool = False  # files of this run exist

    @property
    def finished(self) -> frozenset[str]:
        """Names of the finished files of this run."""
        return frozenset(name for name in self.outputs if self.began and (self.path / name).is_file())

    def begin(self, first: str, write: Callable[[Path], object], **notes: Any) -> None:
        """Write the first file of a run, then its mark, and remove the files of older runs."""
        with write_atomically(self.path / first) as unfinished:
            write(unfinished)  # a failure here, e.g. a full disk, leaves the older files as they are
            with write_atomically(self.path / MARK) as mark:
                mark.write_text(json_text({"run": self.run, "notes": notes}), encoding="utf-8")
            for name in {*self.outputs, ROLLOUTS} - {first}:
                (self.path / name).unlink(missing_ok=True)
        self.notes, self.began = notes, True

    def end(self) -> None:
        """Remove the mark of an unfinished run."""
        for name in (MARK, ROLLOUTS):
            (self.path / name).unlink(missing_ok=True)


@contextmanager
def run_folder(path: PathLike, outputs: Iterable[str], asked: dict[str, Any]) -> Iterator[RunFolder]:
    """Open the folder of a run, created with its parents if missing; `asked` holds the run's identity as JSON values.

    An exception leaves finished files; without any, created folders are removed again.

    Raises:
        FileError: The folder cannot be written, or another run is writing into it.
    """
    place = Path(path)
    run = hashlib.sha256(json.dumps(finite(asked), sort_keys=True).encode()).hexdigest()
    folder = RunFolder(place, tuple(outputs), run)
    probe, created = open_folder(place, folder.outputs)
    try:
        probe.rmdir()
        with folder_lock(place), also_reading(place / name for name in (*folder.outputs, MARK, ROLLOUTS)):
            mark = _mark(place / MARK)
            if mark.get("run") == run and (place / folder.outputs[0]).is_file():
                folder.began, folder.notes = True, mark.get("notes", {})
            yield folder
    except OSError as error:
        if error.filename is None or Path(error.filename).parent != place:
            raise
        raise file_error(error, place, expected="folder") from error
    finally:
        if not folder.began:
            remove_empty(created)


def _mark(path: Path) -> dict[str, Any]:
    """The mark of an unfinished run; empty where there is none or it cannot be read."""
    with suppress(OSError, ValueError, RecursionError):
        mark = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(mark, dict) and isinstance(mark.get("notes"), dict):
            return mark
    return {}


Store = Callable[[Plan, tuple[Refinement, ...]], None]
_OUTCOMES = {
    "applied": "applied automatically", "passes": "tried, PASS; left to you",
    "not tried": "not tried, for want of work",
    "fails": "tried, still FAIL", "refused": "tried, refused", "not solved": "tried, not solved",
}  # fmt: skip


def auto_repair(
    asked: ProblemFile, plan: Plan, proof: Proof | None, path: tuple[Refinement, ...], arguments: argparse.Namespace,
    console: Console, *, resumed: bool, store: Store, budget: WorkBudget,
) -> Repaired:  # fmt: skip
    """The plan that passes or that is best known; `store` gets each plan that takes the place of the one before."""

    def solve_again(problem: Problem, max_iterations: int, purpose: str, budget: WorkBudget) -> Plan:
        again = asked._replace(problem=problem, starts=problem.parameters["starts"])
        given = argparse.Namespace(**vars(arguments) | {"max_iterations": max_iterations})
        return solved(again, given, console, purpose=purpose, budget=budget)[0]

    def keep(plan: Plan, which: str, path: tuple[Refinement, ...]) -> None:
        store(plan, path)
        solving.show_plan(plan, None, console, which)

    options = {name: getattr(arguments, name) for name in ("update", "line_search", "hessian")}
    judge = partial(prove, rollouts=0, hold_seconds=arguments.hold)
    tools = Tools(solve_again, judge, options, arguments.max_iterations, partial(_show_step, console), keep)
    return repair(asked.problem, plan, proof, path, tools, again=resumed, budget=budget)


def _show_step(console: Console, step: Step) -> None:
    if isinstance(step, Refinement):
        if step.seconds == step.seconds:  # NaN is the failed plan's
            console.write_progress(f"solved again at a finer step:\n{Refinement.header()}\n{step}")
    elif isinstance(step, Refined):
        console.write_result(f"refinements: {len(step.path) - 1}; {step.reason}")
    elif isinstance(step, ClearanceRefinement):
        console.write_result("\n".join(f"planned again: {note}" for note in step.notes))
    elif isinstance(step, SaddleStep | Resumption):
        console.write_result(str(step))
    elif isinstance(step, FixTrial) and step.outcome == "begins":
        console.write_progress(f"the plan does not pass; trying {step.fix}")
    else:
        reason = f" ({step.reason})" if step.reason else ""
        console.write_result(f"{_OUTCOMES[step.outcome]}{reason}: {step.fix}")


# Of the work, at most, for the first solve, and for a search over durations, of which one repairs less: the rest is for
# the repair of a plan that fails.
FIRST_SHARE, SEARCH_SHARE = 0.5, 0.8
MAX_ROLLOUT_SECONDS = 20.0  # time limit of the perturbed simulations; `planner prove` has none
MEASURED_AFTER = 2.0  # proofs: what the steps after the verdict take that are only shown
FLAGS = ("update", "line_search", "hessian", "max_iterations", "rank", "no_refine", "rollouts", "hold", "work",
         "budget", "objective", "durations", "control_limit", "exact_goal")  # fmt: skip
"""Flags that decide plan and proof, beside those of the problem, its starts and seed."""


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Plan, prove, plot and film a case or a problem file into a folder."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    number("hold", arguments.hold, minimum=0.0)
    budget = WorkBudget(seconds=arguments.budget)  # from here on: loading takes a part of the time
    asked = asked_problem(arguments)
    works = (arguments.work, asked.work, DEFAULT_WORK)
    budget.limit = number("work", next(work for work in works if work is not None), minimum=0.0)
    if arguments.hold:
        hold_gain(asked.problem)  # refuses a goal that cannot be held before any work
    checked_looks(arguments, asked.problem.twin)  # refuses a wrong size or camera before any work
    place = Path(arguments.out or f"renders/{name_of(arguments)}")
    with run_folder(place, results.OUTPUTS, _identity(asked, arguments)) as folder:
        try:
            with executor_of(arguments.workers, arguments.scheduler) as executor:
                code, document = _run(asked, arguments, folder, console, executor, budget)
        except KeyboardInterrupt:
            if not folder.began:
                raise
            finished = ", ".join(sorted(folder.finished))
            console.write_error(f"interrupted; {place} holds {finished}, and the same command continues from there.")
            return INTERRUPTED
    return console.finish("run", code, **document, folder=str(place))


def _identity(asked: ProblemFile, arguments: argparse.Namespace) -> dict[str, Any]:
    """JSON values that are equal for two runs with the same plan and proof."""
    problem = asked.problem
    return {
        "case": problem.case, "parameters": problem.parameters, "starts": asked.starts, "seed": asked.seed,
        "cycles": asked.cycles, "phase_times": [[k, *ends] for k, ends in asked.phase_times.items()],
        "model": None if problem.twin is None else problem.twin.mjcf, "versions": installed_versions(),
        **{name: getattr(arguments, name) for name in FLAGS},
    }  # fmt: skip


def _run(
    asked: ProblemFile, arguments: argparse.Namespace, folder: RunFolder, console: Console, executor: Executor | None,
    budget: WorkBudget,
) -> tuple[int, dict[str, Any]]:  # fmt: skip
    stored = load_plan(folder.path / "plan.npz") if "plan.npz" in folder.finished else None
    if stored is None or stored.status is Status.INTERRUPTED:
        resumed, path = False, ()
        failures = parity(asked.problem).failures
        if failures:
            raise PlannerError(f"the plan's dynamics and MuJoCo's differ: {failures[0]}, {failures[0].note}.")
        share = FIRST_SHARE if asked.durations is None else SEARCH_SHARE
        plan, seconds = solved(asked, arguments, console, executor, budget=budget.part("first solve", share))
        folder.begin("plan.npz", plan.save, seconds=seconds)
    else:
        console.write_progress(f"continuing {folder.path}, which holds {', '.join(sorted(folder.finished))}")
        resumed, plan, seconds = True, stored, float(folder.notes.get("seconds", 0.0))
        path = tuple(map(_refinement_of, folder.notes.get("path", [])))
    solving.show_plan(plan, seconds, console)
    proof = prove(plan, rollouts=0, hold_seconds=arguments.hold) if results.is_finite(plan) else None
    if proof is not None and plan.problem is not None:
        budget.charge_proof(plan.problem)

    def store(better: Plan, path: tuple[Refinement, ...]) -> None:
        notes = {"path": [results.refinement_row(line) for line in path]} if path else {}
        folder.begin("plan.npz", better.save, seconds=seconds, **notes)

    if not (arguments.no_refine or plan.status is Status.INTERRUPTED or (proof is not None and proof.passed)):
        repaired = auto_repair(
            asked, plan, proof, path, arguments, console, resumed=resumed, store=store, budget=budget
        )  # fmt: skip
        plan, proof, path, fixes = repaired
    else:
        fixes = suggested_fixes(plan, proof)
    results.show_work(budget, console)
    digest = plan_digest(folder.path / "plan.npz")
    results.write_proof(plan, proof, folder.path, digest, fixes, path, budget)  # rollouts may be interrupted
    films = None
    with ExitStack() as drawing:
        if proof is not None:
            if not (arguments.no_video or budget.out_of_time):  # beside the rollouts, which know nothing of it
                looks = checked_looks(arguments, plan.twin)
                drawn = BackgroundRender(proof, folder.path, folder.finished, console, looks, arguments.transparent)
                films = drawing.enter_context(drawn)
            missing = _missing(plan, proof, budget)
            proof = results.completed(
                proof, arguments.rollouts, console, missing=missing, partial=folder.path / ROLLOUTS,
                budget=min(MAX_ROLLOUT_SECONDS, budget.seconds_left), executor=executor,
            )  # fmt: skip
            results.write_proof(plan, proof, folder.path, digest, fixes, path, budget)
            results.show_proof(proof, fixes, console)
        else:
            solving.show_fixes(fixes, console)
        film_status = results.draw_results(
            plan, proof, folder.path, fixes, not arguments.no_video, console, path=path, keep=folder.finished,
            options=_flags(arguments), films=films, budget=budget,
        )  # fmt: skip
    if film_status == results.INTERRUPTED:
        raise KeyboardInterrupt
    folder.end()
    files = [name for name in results.OUTPUTS if (folder.path / name).is_file()]
    console.write_result(f"\n{folder.path}: {', '.join(files)}")
    if film_status and not arguments.no_video:
        console.write_result(f"no video: {film_status}")
    return 0 if proof is not None and proof.passed else 1, {
        "plan": solving.plan_facts(plan), "solve_seconds": seconds, "proof": None if proof is None else proof.to_dict(),
        "refinement": [results.refinement_row(line) for line in path], "resumed": resumed, "files": files,
        "video_note": film_status, "cures": [one.to_dict() for one in fixes],
        "budget": budget.to_dict(),
    }  # fmt: skip


def _refinement_of(row: dict[str, Any]) -> Refinement:
    """The step that results.refinement_row() made a row of, back from a file, where what is no number is null."""
    known: dict[str, Any] = row | {"status": Status[row["status"]]}
    known |= {name: math.nan for name in ("cost", "end_error", "seconds") if row[name] is None}
    return Refinement(**known)


def _missing(plan: Plan, proof: Proof, budget: WorkBudget) -> str:
    """Why a run does not measure what a plan bears, which can take minutes of a motion that diverges; or ""."""
    if not (plan.converged or proof.passed):
        return "the solve did not succeed; planner prove measures it"
    needed = 0.0 if plan.problem is None else MEASURED_AFTER * work_of_proof(plan.problem)
    return "no work was left; planner prove measures it" if budget.exhausted or budget.left < needed else ""


def _flags(arguments: argparse.Namespace) -> dict[str, Any]:
    """Flags that are not at their defaults, for the line of the report that repeats the run."""
    given = {name: getattr(arguments, name) for name in (*FLAGS, "starts", "seed")}
    return {name: value for name, value in given.items() if value != arguments.parser.get_default(name)}
