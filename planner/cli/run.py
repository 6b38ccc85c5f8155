"""The command `run`: plan, prove, refine where the step was too coarse, plot and film, into one folder.

Each file is there as soon as it is finished. What an interrupted run left, the same command goes on from.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.base.versions import installed_versions
from planner.cases.plan_file import load_plan
from planner.cli.console import Console
from planner.cli.problems import ProblemOf, asked_problem, name_of, solved
from planner.cli.results import INTERRUPTED as UNFINISHED
from planner.cli.results import OUTPUTS, draw_results, plan_facts, refinement_row, show_plan, show_proof, write_proof
from planner.cli.run_folder import ROLLOUTS as PARTIAL
from planner.cli.run_folder import RunFolder, run_folder
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import Proof, prove
from planner.proof.hold import hold_gain
from planner.proof.model_parity import parity
from planner.proof.refinement import Refinement, refine
from planner.proof.verdict import with_rollouts

DONE, NOT_DONE, INTERRUPTED = 0, 1, 130
BUDGET = 20.0  # s of the perturbed step; planner prove takes what it needs


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Plan, prove, plot and film a case or a problem file into a folder."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    count("rollouts", arguments.rollouts, least=0)
    number("hold", arguments.hold, least=0.0)
    asked = asked_problem(arguments)
    if arguments.hold:
        hold_gain(asked.problem)  # a goal that cannot be held is refused before any work
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
    console.document({"command": "run", **document, "folder": str(place), "exit_code": code})
    return code


def _identity(asked: ProblemOf, arguments: argparse.Namespace) -> dict[str, Any]:
    """What makes two runs the same: their plan and what is asked of its proof."""
    problem = asked.problem
    solver = ("update", "line_search", "hessian", "max_iterations", "rank", "no_refine", "rollouts", "hold",
              "objective", "durations", "control_limit", "exact_goal")  # fmt: skip
    return {
        "case": problem.case, "parameters": problem.parameters, "starts": asked.starts, "seed": asked.seed,
        "model": None if problem.twin is None else problem.twin.mjcf, "versions": installed_versions(),
        **{name: getattr(arguments, name) for name in solver},
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
        console.note(f"going on with {folder.path}, finished so far: {', '.join(sorted(folder.finished))}")
        resumed, plan, seconds = True, stored, float(folder.notes.get("seconds", 0.0))
        path = tuple(Refinement(**{**row, "status": Status[row["status"]]}) for row in folder.notes.get("path", []))
    show_plan(plan, seconds, console)
    proof = _proved(plan, arguments.hold)
    if proof is not None and not (proof.passed or path or arguments.no_refine or plan.status is Status.INTERRUPTED):
        plan, proof, path = _refined(plan, proof, arguments, console)
        if path:
            folder.begin("plan.npz", plan.save, seconds=seconds, path=[refinement_row(line) for line in path])
    write_proof(plan, proof, folder.path, path)  # with all but the rollouts, which may be interrupted
    if proof is not None and arguments.rollouts:
        proof = with_rollouts(
            proof, arguments.rollouts, budget=BUDGET, partial=folder.path / PARTIAL,
            progress=lambda done, total: console.progress("perturbed simulations", done, total),
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
    code = DONE if plan.success and proof is not None and proof.passed else NOT_DONE
    return code, {
        "plan": plan_facts(plan), "solve_seconds": seconds, "proof": None if proof is None else proof.to_dict(),
        "refinement": [refinement_row(line) for line in path], "resumed": resumed, "files": files, "video_note": note,
    }  # fmt: skip


def _refined(
    plan: Plan, proof: Proof, arguments: argparse.Namespace, console: Console
) -> tuple[Plan, Proof, tuple[Refinement, ...]]:
    """What finer steps make of a plan that failed; nothing where the step is not what is wrong."""
    lines: list[Refinement] = []

    def show(line: Refinement) -> None:
        lines.append(line)
        if len(lines) == 2:  # the first is the plan as it was
            console.note("the plan does not survive a finer step; refining it")
            console.note(Refinement.header())
            console.note(str(lines[0]))
        if len(lines) > 1:
            console.note(str(line))

    began = time.perf_counter()
    done = refine(plan, proof, callback=show, update=arguments.update, line_search=arguments.line_search,
                  hessian=arguments.hessian, max_iterations=arguments.max_iterations,
                  prove=lambda p: _certain(p, arguments.hold))  # fmt: skip
    if len(done.path) == 1:
        return plan, proof, ()
    if done.plan.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # a refinement cut short is begun again
    console.say(f"refinements: {len(done.path) - 1}, in {time.perf_counter() - began:.1f} s; {done.reason}")
    show_plan(done.plan, None, console)
    return done.plan, done.proof, done.path


def _check_model(problem: Problem) -> None:
    """Refuse a problem whose model in MuJoCo is another machine, before any planning."""
    first = parity(problem)
    if not first.passed:
        failures = "; ".join(f"{figure}, {figure.note}" for figure in first.failures[:1])
        raise PlannerError(f"the plan's dynamics and MuJoCo's differ: {failures}.")


def _proved(plan: Plan, hold: float) -> Proof | None:
    """The proof without rollouts; None for a plan that is not finite."""
    if not (np.isfinite(plan.xs).all() and np.isfinite(plan.cost)):
        return None
    return _certain(plan, hold)


def _certain(plan: Plan, hold: float) -> Proof:
    return prove(plan, rollouts=0, hold_seconds=hold)


def _flags(arguments: argparse.Namespace) -> dict[str, Any]:
    """What a run was told beside its problem, for the line that repeats it."""
    usual = {"update": "feedback", "line_search": "armijo", "hessian": "gauss-newton",
             "max_iterations": 1000, "starts": None, "seed": None,
             "rank": "cost", "no_refine": False, "rollouts": 512, "hold": 0.0, "objective": None, "durations": None,
             "control_limit": None, "exact_goal": False}  # fmt: skip
    return {name: getattr(arguments, name) for name in usual if getattr(arguments, name) != usual[name]}
