"""The command `run`: plan, prove, refine a plan whose step is too coarse, plot and film, into one folder.

Each file appears when it is finished. After an interruption the same command continues with the missing files.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.base.versions import installed_versions
from planner.cases.plan_file import load_plan
from planner.cli.console import Console
from planner.cli.problems import ProblemOf, asked_problem, name_of, solved
from planner.cli.results import INTERRUPTED as UNFINISHED
from planner.cli.results import (
    OUTPUTS,
    draw_results,
    is_finite,
    plan_facts,
    refinement_row,
    show_plan,
    show_proof,
    write_proof,
)
from planner.cli.run_folder import ROLLOUTS as PARTIAL
from planner.cli.run_folder import RunFolder, run_folder
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import Proof, prove
from planner.proof.hold import hold_gain
from planner.proof.model_parity import parity
from planner.proof.refinement import Refinement, refine
from planner.proof.verdict import with_rollouts

INTERRUPTED = 130
BUDGET = 20.0  # s, limit of the perturbed rollouts; `planner prove` has none
FLAGS = ("update", "line_search", "hessian", "max_iterations", "rank", "no_refine", "rollouts", "hold", "objective",
         "durations", "control_limit", "exact_goal")  # fmt: skip
"""Flags of plan and proof, beside the problem, starts and seed."""


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Plan, prove, plot and film a case or a problem file into a folder."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    count("rollouts", arguments.rollouts, least=0)
    number("hold", arguments.hold, least=0.0)
    asked = asked_problem(arguments)
    if arguments.hold:
        hold_gain(asked.problem)  # refuses a goal that cannot be held before any work
    place = Path(arguments.out or f"renders/{name_of(arguments)}")
    with run_folder(place, OUTPUTS, _identity(asked, arguments)) as folder:
        try:
            code, document = _run(asked, arguments, folder, console)
        except KeyboardInterrupt:
            if not folder.began:
                raise
            finished = ", ".join(sorted(folder.finished))
            console.complain(f"interrupted; {place} holds {finished}, and the same command goes on from there.")
            return INTERRUPTED
    return console.finish("run", code, **document, folder=str(place))


def _identity(asked: ProblemOf, arguments: argparse.Namespace) -> dict[str, Any]:
    """JSON values that are equal for two runs with the same plan and proof."""
    problem = asked.problem
    return {
        "case": problem.case, "parameters": problem.parameters, "starts": asked.starts, "seed": asked.seed,
        "model": None if problem.twin is None else problem.twin.mjcf, "versions": installed_versions(),
        **{name: getattr(arguments, name) for name in FLAGS},
    }  # fmt: skip


def _run(
    asked: ProblemOf, arguments: argparse.Namespace, folder: RunFolder, console: Console
) -> tuple[int, dict[str, Any]]:
    stored = load_plan(folder.path / "plan.npz") if "plan.npz" in folder.finished else None
    if stored is None or stored.status is Status.INTERRUPTED:
        resumed, path = False, ()
        _check_model(asked.problem)
        plan, seconds = solved(asked, arguments, console)
        folder.begin("plan.npz", plan.save, seconds=seconds)
    else:
        console.note(f"continuing {folder.path}, which holds {', '.join(sorted(folder.finished))}")
        resumed, plan, seconds = True, stored, float(folder.notes.get("seconds", 0.0))
        path = tuple(Refinement(**{**row, "status": Status[row["status"]]}) for row in folder.notes.get("path", []))
    show_plan(plan, seconds, console)
    proof = _proved(plan, arguments.hold) if is_finite(plan) else None
    if proof is not None and not (proof.passed or path or arguments.no_refine or plan.status is Status.INTERRUPTED):
        plan, proof, path = _refined(plan, proof, arguments, console)
        if path:
            folder.begin("plan.npz", plan.save, seconds=seconds, path=[refinement_row(line) for line in path])
    write_proof(plan, proof, folder.path, path)  # without the rollouts, which may be interrupted
    if proof is not None and arguments.rollouts:
        proof = with_rollouts(
            proof, arguments.rollouts, budget=BUDGET, partial=folder.path / PARTIAL,
            progress=console.progress("perturbed simulations"),
        )  # fmt: skip
        write_proof(plan, proof, folder.path, path)
    if proof is not None:
        show_proof(proof, console)
    note = draw_results(
        plan, proof, folder.path, not arguments.no_video, console, path=path, keep=folder.finished,
        options=_flags(arguments),
    )  # fmt: skip
    if note == UNFINISHED:
        raise KeyboardInterrupt
    folder.end()
    files = [name for name in OUTPUTS if (folder.path / name).is_file()]
    console.say(f"\n{folder.path}: {', '.join(files)}")
    if note and not arguments.no_video:
        console.say(f"no video: {note}")
    return 0 if plan.success and proof is not None and proof.passed else 1, {
        "plan": plan_facts(plan), "solve_seconds": seconds, "proof": None if proof is None else proof.to_dict(),
        "refinement": [refinement_row(line) for line in path], "resumed": resumed, "files": files, "video_note": note,
    }  # fmt: skip


def _refined(
    plan: Plan, proof: Proof, arguments: argparse.Namespace, console: Console
) -> tuple[Plan, Proof, tuple[Refinement, ...]]:
    """Solve a failed plan again at finer steps; returns it unchanged where the step is not the cause."""
    lines: list[Refinement] = []

    def show(line: Refinement) -> None:
        lines.append(line)
        if len(lines) == 2:  # the first is the failed plan
            console.note("the proof fails at a finer step; solving again with dt / 2")
            console.note(Refinement.header())
            console.note(str(lines[0]))
        if len(lines) > 1:
            console.note(str(line))

    began = time.perf_counter()
    done = refine(plan, proof, callback=show, update=arguments.update, line_search=arguments.line_search,
                  hessian=arguments.hessian, max_iterations=arguments.max_iterations,
                  prove=lambda p: _proved(p, arguments.hold))  # fmt: skip
    if len(done.path) == 1:
        return plan, proof, ()
    if done.plan.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # the next run begins an interrupted refinement again
    console.say(f"refinements: {len(done.path) - 1}, in {time.perf_counter() - began:.1f} s; {done.reason}")
    show_plan(done.plan, None, console)
    return done.plan, done.proof, done.path


def _check_model(problem: Problem) -> None:
    """Refuse a problem whose model in MuJoCo is another machine, before any planning."""
    failures = parity(problem).failures
    if failures:
        raise PlannerError(f"the plan's dynamics and MuJoCo's differ: {failures[0]}, {failures[0].note}.")


def _proved(plan: Plan, hold: float) -> Proof:
    """The proof without rollouts."""
    return prove(plan, rollouts=0, hold_seconds=hold)


def _flags(arguments: argparse.Namespace) -> dict[str, Any]:
    """Flags that are not at their defaults, for the line of the report that repeats the run."""
    given = {name: getattr(arguments, name) for name in (*FLAGS, "starts", "seed")}
    return {name: value for name, value in given.items() if value != arguments.parser.get_default(name)}
