"""Work: how each task of a sweep is solved, and, where that is asked for, proved. This is what travels to workers.

A task that raises is a row with its reason, as is one that takes longer than it may: the callback of the solver ends it
between two iterations. What one task gives depends on nothing but the work and its number; with `continued`, on the
controls of the neighbour before it too.
"""

from __future__ import annotations

import copy
import inspect
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner import cases
from planner.base.arguments import choice, short_repr
from planner.base.data_files import read_table
from planner.base.errors import PlannerError
from planner.cases.problem_file import ProblemFile, case_in, loaded
from planner.cases.problem_file.keys import KEYS
from planner.problem.limits import Limits
from planner.problem.objective import with_found_duration, with_objective
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import prove
from planner.solvers.slq import solve
from planner.sweeps.grid import Grid

FAILED, TIMEOUT, LOST = "FAILED", "TIMEOUT", "WORKER_LOST"
"""Statuses in addition to those of plans: it raised, it took too long, its worker ended."""

_BUILT = 32  # tasks, at most, that are built before a sweep begins
_SIGNATURE_TIMES = (0.25, 0.5, 0.75)  # parts of the horizon whose states identify a trajectory
_SIGNATURE_STATES = 8  # leading entries of each of these states


@dataclass(frozen=True)
class Work:
    """How the tasks of a sweep are done.

    Attributes:
        grid: The parameters of each task.
        source: Name of a case, path of a problem file, or a function of the parameters that returns a Problem.
        fixed: Parameters of the case, or keys of the file, that are the same for all tasks.
        options: Of solve().
        objective: Weights of criteria in place of the problem's own, or None.
        durations: The shortest and the longest, s, for an objective with time.
        limits: In place of the problem's own, or None.
        proved: Arguments of prove(), or None to prove nothing.
        timeout: s that a solve may take, or None.
    """

    grid: Grid
    source: str | Path | Callable[..., Problem]
    fixed: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    objective: dict[str, float] | None = None
    durations: list[float] | None = None
    limits: Limits | None = None
    proved: dict[str, Any] | None = None
    timeout: float | None = None

    def problem(self, task: int) -> ProblemFile:
        """The problem of a task, and how to solve it.

        Raises:
            PlannerError: Its parameters are out of range.
        """
        point = self.grid.point(task)
        if callable(self.source):
            built = self.source(**self.fixed, **point)
            if not isinstance(built, Problem):
                raise PlannerError(f"the function that builds returned {short_repr(built)}, expected a Problem.")
            file = ProblemFile(built, 1, 0, None, None)
        elif isinstance(self.source, Path):
            file = _of_file(self.source, self.fixed | point)
        else:
            file = ProblemFile(cases.build(self.source, **self.fixed, **point), 1, 0, None, None)
        if self.limits is not None:
            file = file._replace(problem=replace(file.problem, limits=self.limits))
        if self.objective is not None:
            file = file._replace(problem=with_objective(file.problem, self.objective), objective=self.objective)
        return file if self.durations is None else file._replace(durations=self.durations)


def source_of(build: Any) -> Any:
    """What builds the problems: a case's name, a function, or the whole path of a problem file."""
    for name, case in cases.CASES.items():
        if case is build:
            return name
    if callable(build):
        return build
    if isinstance(build, Path) or (isinstance(build, str) and build.lower().endswith(".toml")):
        return Path(build).absolute()
    return choice("build", build, tuple(cases.CASES))


def known_parameters(work: Work) -> tuple[list[str], str]:
    """The names of the parameters that exist, and whose they are."""
    source = work.source
    if isinstance(source, Path):
        named = case_in(source)
        if named is None:
            dotted = [name for name in work.grid.values if name.partition(".")[0] in KEYS]
            return [*KEYS, *dotted], source.name
        return list(inspect.signature(cases.CASES[named[0]]).parameters), named[0]
    if isinstance(source, str):
        return list(inspect.signature(cases.CASES[source]).parameters), source
    try:
        signature = inspect.signature(source).parameters
    except (TypeError, ValueError):
        return list(work.grid.values), ""
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in signature.values()):
        return list(work.grid.values), ""
    return list(signature), getattr(source, "__name__", "the function")


class Done(NamedTuple):
    """One task that is done.

    Attributes:
        row: Its row of the table.
        plan: The content of its plan's file, or None where there is no plan.
    """

    row: dict[str, Any]
    plan: bytes | None


class BatchResult(NamedTuple):
    """Some tasks that are done.

    Attributes:
        done: In the order of the tasks.
        controls: (N, nu) of the last one if it converged, for its neighbour; None otherwise.
    """

    done: list[Done]
    controls: np.ndarray | None


def run_batch(work: Work, tasks: list[int], continued: bool = False, controls: np.ndarray | None = None) -> BatchResult:
    """Do some tasks one after the other.

    Args:
        work: How.
        tasks: Their numbers.
        continued: Start each from the controls of the one before it, if that converged.
        controls: (N, nu) of the one before the first of them, or None.
    """
    done, last = [], controls
    for task in tasks:
        one, plan = _done(work, task, last if continued else None)
        done.append(one)
        last = plan.us if plan is not None and plan.converged else None
    return BatchResult(done, last)


def warm(work: Work) -> None:
    """Load, and on a cold start compile, what the tasks need.

    A function of the user's own is not called here: it may do anything, which is for the tasks to find out.
    """
    if callable(work.source):
        return
    with suppress(Exception), np.errstate(all="ignore"):  # an error of the first task is in its row
        first = with_found_duration(work.problem(0).problem)
        solve(first, hessian=work.options.get("hessian", "gauss-newton"), max_iterations=1)


def check_buildable(work: Work) -> None:
    """Raise the first task's error where none of _BUILT can be built: the input is wrong, and nothing is to be solved.

    They are evenly spaced, since the first of a large grid may have one value of a parameter in common. The first that
    can be built ends the check. A function of the user's own is not called, as in `warm`.

    Raises:
        PlannerError: What is wrong.
    """
    if callable(work.source):
        return
    first, last = None, len(work.grid) - 1
    for task in sorted({k * last // (_BUILT - 1) for k in range(_BUILT)}):
        try:
            with np.errstate(all="ignore"):
                work.problem(task)
        except PlannerError as error:
            first = first or error
        except Exception:
            return  # an error of this task alone, which is in its row
        else:
            return
    if first is not None:
        raise first


def failed(work: Work, task: int, status: str, reason: str) -> Done:
    """The row of a task that has no plan."""
    return Done({"task": task, **work.grid.point(task), "status": status, "reason": reason}, None)


def reason_of(error: BaseException) -> str:
    """An error in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, PlannerError) else f"{type(error).__name__}: {text}"


def _done(work: Work, task: int, controls: np.ndarray | None) -> tuple[Done, Plan | None]:
    """A task's row and plan. SystemExit and KeyboardInterrupt are its own here: Ctrl-C does not reach workers."""
    before, plan = set(threading.enumerate()), None
    try:
        with np.errstate(all="ignore"):
            done, plan = _planned(work, task, controls)
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        done = failed(work, task, FAILED, reason_of(error))
    left = [one.name for one in threading.enumerate() if one not in before and not one.daemon]
    if left and threading.current_thread() is threading.main_thread():  # else other tasks may have begun them
        done.row["reason"] = f"{done.row['reason']} It left a thread running: {', '.join(left)}.".strip()
    return done, plan


def _planned(work: Work, task: int, controls: np.ndarray | None) -> tuple[Done, Plan]:
    began = time.perf_counter()
    ends = None if work.timeout is None else began + work.timeout
    late = False

    def heed(_: Any) -> None:
        nonlocal late
        if ends is not None and time.perf_counter() > ends:
            late = True
            raise StopIteration

    file = work.problem(task)
    of_one = None if controls is None or file.phase_times else controls[: len(controls) // file.cycles]
    problem, neighbour = _from_neighbour(file.problem, of_one)
    options: dict[str, Any] = {"starts": file.starts, "seed": file.seed} | work.options
    plan = file._replace(problem=problem).solved(heed, **options)
    solved = time.perf_counter()
    row: dict[str, Any] = {
        "task": task, **work.grid.point(task), "status": TIMEOUT if late else plan.status.name,
        "reason": f"It was not done after {work.timeout:g} s." if late else "" if plan.success else plan.message,
        "cost": float(plan.cost), "iterations": plan.nit, "gradient_norm": float(plan.gradient_norm),
        "guess": "neighbour" if neighbour else "own", "start": plan.start, "print": _trajectory_signature(plan),
        "solve_seconds": solved - began,
    }  # fmt: skip
    if work.proved is not None and plan.status is not Status.NOT_FINITE:
        row |= _proof(plan, work.proved)
        row["prove_seconds"] = time.perf_counter() - solved
    return Done(row, plan.to_bytes()), plan


def _proof(plan: Plan, options: dict[str, Any]) -> dict[str, Any]:
    """The columns of a proof; the reason where it cannot be made."""
    try:
        proof = prove(plan, **options)
    except PlannerError as error:
        return {"verdict": "", "proof_reason": str(error)}
    row: dict[str, Any] = {
        "verdict": proof.verdict, "mode": proof.mode or "", "feasible": proof.feasible, "optimal": proof.optimal,
        "robustness": proof.robustness, "proof_reason": proof.reason,
    }  # fmt: skip
    for name, section in proof.sections.items():
        row |= {f"{name}.{one.name}": float(one.value) for one in section.measured}
    return row


def _from_neighbour(problem: Problem, controls: np.ndarray | None) -> tuple[Problem, bool]:
    """The problem with its neighbour's controls as first guess, resampled where it has other stages."""
    N, nu = problem.N, problem.dynamics.nu
    if controls is None or controls.shape[1] != nu:
        return problem, False
    stages = np.arange(N) * len(controls) // N
    return replace(problem, us=controls[stages]), True


def _trajectory_signature(plan: Plan) -> list[float]:
    """Some numbers that distinguish two trajectories."""
    knots = [int(part * plan.N) for part in _SIGNATURE_TIMES]
    return [float(value) for value in plan.xs[knots, :_SIGNATURE_STATES].ravel()]


def _of_file(path: Path, values: dict[str, Any]) -> ProblemFile:
    named = case_in(path)
    if named is not None:
        case, given, starts, seed = named
        return ProblemFile(cases.build(case, **given | values), starts, seed, None, None)
    return loaded(changed(read_table(path), values), path)


def changed(table: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """A problem file's table with some keys changed; "weights.effort" is a key of the table weights.

    Raises:
        PlannerError: A part of a dotted name is no table.
    """
    table = copy.deepcopy(table)
    for name, value in values.items():
        *folders, last = name.split(".")
        place: Any = table
        for folder in folders:
            place = place.setdefault(folder, {})
            if not isinstance(place, dict):
                raise PlannerError(f"{name} names a key of {folder!r}, which is no table in the file.")
        place[last] = value
    return table
