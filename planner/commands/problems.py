"""The problem that a command line names, and its solve: shared by `run` and `solve`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from planner import cases
from planner.arguments import count
from planner.commands.parser import PROBLEM_FILE
from planner.console import Console
from planner.multistart import MOST_STARTS
from planner.plan import Plan
from planner.problem_file import ProblemFile as ProblemOf
from planner.problem_file import load
from planner.proof.cost import proven_cost
from planner.slq import solve

RANKS = {"cost": None, "proven-cost": proven_cost}


def asked_problem(arguments: argparse.Namespace) -> ProblemOf:
    """The problem of a case or a file, and from how many first guesses it is solved."""
    count("max_iterations", arguments.max_iterations)
    if arguments.case == PROBLEM_FILE:
        return load(arguments.problem, starts=arguments.starts, seed=arguments.seed)
    starts = 1 if arguments.starts is None else count("starts", arguments.starts, most=MOST_STARTS)
    seed = 0 if arguments.seed is None else count("seed", arguments.seed, least=0)
    given = {name[5:]: value for name, value in vars(arguments).items() if name.startswith("case_")}
    return ProblemOf(cases.build(arguments.case, **given), starts, seed)


def name_of(arguments: argparse.Namespace) -> str:
    """What a run is called: its case, or its file without folder and ending."""
    return Path(arguments.problem).stem if arguments.case == PROBLEM_FILE else arguments.case


def solved(asked: ProblemOf, arguments: argparse.Namespace, console: Console) -> tuple[Plan, float]:
    """The plan, and the seconds that the solve took."""
    problem = asked.problem
    solve(problem, hessian=arguments.hessian, max_iterations=1)  # what a first run compiles is not the solve's time
    several = f", {asked.starts} starts" if asked.starts > 1 else ""
    console.note(f"planning {name_of(arguments)}: {problem.N} stages of {problem.dynamics.dt:.4g} s{several}")
    began = time.perf_counter()
    plan = solve(
        problem, update=arguments.update, line_search=arguments.line_search, hessian=arguments.hessian,
        starts=asked.starts, seed=asked.seed, max_iterations=arguments.max_iterations,
        callback=console.iteration if asked.starts == 1 else console.start,
        rank=RANKS[arguments.rank],
    )  # fmt: skip
    return plan, time.perf_counter() - began
