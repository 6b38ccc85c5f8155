"""Build and solve the problem that a command line names, for `run` and `solve`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from planner import cases
from planner.base.arguments import count, number, short_repr
from planner.base.errors import PlannerError
from planner.cases.problem_file import case_in, load
from planner.cli.console import Console
from planner.cli.flags import PROBLEM_FILE
from planner.problem.limits import EXACT, Limits
from planner.problem.objective import checked_durations, durations_or_default, weights_of, with_objective
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.free_time import solve_for
from planner.solvers.options import MAX_STARTS
from planner.solvers.periodic import solve_periodic
from planner.solvers.slq import solve
from planner.solvers.work import WorkBudget


class ProblemOf(NamedTuple):
    """The problem of a command line and how to solve it."""

    problem: Problem
    starts: int
    seed: int
    objective: dict[str, float] | None
    durations: list[float] | None
    notes: tuple[str, ...] = ()  # sentences about what was chosen by itself
    work: float | None = None  # of the file, for its budget


def asked_problem(arguments: argparse.Namespace) -> ProblemOf:
    """The problem of a case or a file, its number of starts, objective and durations."""
    count("max_iterations", arguments.max_iterations)
    objective = None if arguments.objective is None else objective_of(arguments.objective)
    durations = None if arguments.durations is None else durations_of(arguments.durations)
    named = case_in(arguments.problem) if arguments.case == PROBLEM_FILE else None
    if arguments.case == PROBLEM_FILE and named is None:
        given = {"starts": arguments.starts, "seed": arguments.seed, "package_path": _absolute(arguments.package_path)}
        file = load(arguments.problem, **given, objective=objective, durations=durations)
        return _with_durations(ProblemOf(*file))
    flags = {name[5:]: value for name, value in vars(arguments).items() if name.startswith("case_")}
    case, given, starts, seed = named or (arguments.case, flags, 1, 0)
    starts = starts if arguments.starts is None else count("starts", arguments.starts, maximum=MAX_STARTS)
    seed = seed if arguments.seed is None else count("seed", arguments.seed, minimum=0)
    problem = cases.build(case, **given)
    limit = arguments.control_limit
    if limit is not None or arguments.exact_goal:
        bound = None if limit is None else number("control-limit", limit, greater_than=0.0)
        problem = replace(problem, limits=Limits(control=bound, final=EXACT if arguments.exact_goal else None))
    if durations is not None and problem.periodic is not None:
        raise PlannerError(
            "--durations is given for a periodic motion, whose cycle has a fixed duration; leave it out."
        )
    if objective is not None:
        problem = with_objective(problem, objective)
    checked_durations(durations, objective or {})
    return _with_durations(ProblemOf(problem, starts, seed, objective, durations))


def _with_durations(asked: ProblemOf) -> ProblemOf:
    """With the durations that an objective with time chooses between, which are said where nobody gave them."""
    own = asked.problem.N * asked.problem.dynamics.dt
    between = durations_or_default(asked.durations, asked.objective or {}, own)
    if between is asked.durations:
        return asked
    said = "{:.3g} to {:.3g} s, a fifth and twice the problem's own: --durations SHORTEST,LONGEST asks for others."
    return asked._replace(durations=list(between), notes=(*asked.notes, "durations " + said.format(*between)))


def _absolute(folder: str | None) -> str | None:
    """A folder of the command line, which is not relative to the problem file."""
    return None if folder is None else str(Path(folder).absolute())


def objective_of(text: str) -> dict[str, float]:
    """Weights of criteria from "time" or from "effort=1,time=2"."""
    if "=" not in text:
        return weights_of(text.strip())
    weights: dict[str, float] = {}
    for word in text.split(","):
        name, _, value = word.partition("=")
        try:
            weights[name.strip()] = float(value)
        except ValueError:
            raise PlannerError(
                f"--objective has {short_repr(word)}, expected NAME=WEIGHT, e.g. effort=1,time=2."
            ) from None
    return weights_of(weights)


def durations_of(text: str) -> list[float]:
    """The shortest and the longest duration, s, from "0.5,3"."""
    try:
        shortest, longest = map(float, text.split(","))
    except ValueError:
        raise PlannerError(f"--durations is {short_repr(text)}, expected SHORTEST,LONGEST in s, e.g. 0.5,3.") from None
    return [shortest, longest]


def name_of(arguments: argparse.Namespace) -> str:
    """Name of a run: its case, or its file's name without folder and suffix."""
    return Path(arguments.problem).stem if arguments.case == PROBLEM_FILE else arguments.case


def solved(
    asked: ProblemOf, arguments: argparse.Namespace, console: Console, executor: Executor | None = None,
    purpose: str = "", budget: WorkBudget | None = None,
) -> tuple[Plan, float]:  # fmt: skip
    """The plan and the time of its solve, s; `purpose` of a solve after the first is printed with its table."""
    problem = asked.problem
    solve(problem, hessian=arguments.hessian, max_iterations=1)  # compiles outside of the measured time
    several = f", {asked.starts} starts" if asked.starts > 1 else ""
    for note in asked.notes:
        console.write_progress(note)
    console.write_progress(
        f"planning {name_of(arguments)}: {problem.N} stages of {problem.dynamics.dt:.4g} s{several}{purpose}"
    )
    began = time.perf_counter()
    options = {
        "update": arguments.update, "line_search": arguments.line_search, "hessian": arguments.hessian,
        "starts": asked.starts, "seed": asked.seed, "max_iterations": arguments.max_iterations,
        "rank": _rank(arguments.rank), "executor": executor, "budget": budget,
    }  # fmt: skip
    shown = console.iteration if asked.durations is None and asked.starts == 1 else console.row

    if problem.periodic is not None:
        plan = solve_periodic(problem, callback=console.row, **options)
    elif asked.objective is None:
        plan = solve(problem, callback=shown, **options)
    else:
        plan = solve_for(problem, asked.objective, durations=asked.durations, callback=shown, **options)
    return plan, time.perf_counter() - began


def _rank(name: str) -> Callable[[Plan], float] | None:
    """What --rank orders several starts by."""
    if name == "cost":
        return None
    from planner.proof.replays.replaying import proven_cost  # local, so that `solve` does not import what replays

    return proven_cost
