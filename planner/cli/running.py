"""The command `run`: plan, prove, solve again where the step is too coarse, plot and film, into one folder.

After an interruption the same command continues with the missing files.
"""

from __future__ import annotations

import argparse
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from planner.base.arguments import count, number
from planner.base.environment import installed_versions
from planner.base.errors import PlannerError
from planner.cases.plan_file import load_plan
from planner.cli import results
from planner.cli.auto_repair import auto_repair
from planner.cli.background_render import BackgroundRender
from planner.cli.console import Console
from planner.cli.problems import ProblemOf, asked_problem, name_of, solved
from planner.cli.run_folder import ROLLOUTS, RunFolder, run_folder
from planner.problem.archive import plan_digest
from planner.problem.plan import Plan, Status
from planner.proof import prove
from planner.proof.compare.model_parity import parity
from planner.proof.diagnostics import suggested_fixes
from planner.proof.goal_regulator import hold_gain
from planner.proof.repair.refinement import Refinement
from planner.sweeps.executors import executor_of

INTERRUPTED = 130
MAX_ROLLOUT_SECONDS = 20.0  # time limit of the perturbed simulations; `planner prove` has none
FLAGS = ("update", "line_search", "hessian", "max_iterations", "rank", "no_refine", "rollouts", "hold", "objective",
         "durations", "control_limit", "exact_goal")  # fmt: skip
"""Flags that decide plan and proof, beside those of the problem, its starts and seed."""


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Plan, prove, plot and film a case or a problem file into a folder."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    count("rollouts", arguments.rollouts, minimum=0)
    number("hold", arguments.hold, minimum=0.0)
    asked = asked_problem(arguments)
    if arguments.hold:
        hold_gain(asked.problem)  # refuses a goal that cannot be held before any work
    place = Path(arguments.out or f"renders/{name_of(arguments)}")
    with run_folder(place, results.OUTPUTS, _identity(asked, arguments)) as folder:
        try:
            with executor_of(arguments.workers, arguments.scheduler) as executor:
                code, document = _run(asked, arguments, folder, console, executor)
        except KeyboardInterrupt:
            if not folder.began:
                raise
            finished = ", ".join(sorted(folder.finished))
            console.write_error(f"interrupted; {place} holds {finished}, and the same command continues from there.")
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
    asked: ProblemOf, arguments: argparse.Namespace, folder: RunFolder, console: Console, executor: Executor | None
) -> tuple[int, dict[str, Any]]:
    stored = load_plan(folder.path / "plan.npz") if "plan.npz" in folder.finished else None
    if stored is None or stored.status is Status.INTERRUPTED:
        resumed, path = False, ()
        failures = parity(asked.problem).failures
        if failures:
            raise PlannerError(f"the plan's dynamics and MuJoCo's differ: {failures[0]}, {failures[0].note}.")
        plan, seconds = solved(asked, arguments, console, executor)
        folder.begin("plan.npz", plan.save, seconds=seconds)
    else:
        console.write_progress(f"continuing {folder.path}, which holds {', '.join(sorted(folder.finished))}")
        resumed, plan, seconds = True, stored, float(folder.notes.get("seconds", 0.0))
        path = tuple(Refinement(**{**row, "status": Status[row["status"]]}) for row in folder.notes.get("path", []))
    results.show_plan(plan, seconds, console)
    proof = prove(plan, rollouts=0, hold_seconds=arguments.hold) if results.is_finite(plan) else None

    def store(better: Plan, path: tuple[Refinement, ...]) -> None:
        notes = {"path": [results.refinement_row(line) for line in path]} if path else {}
        folder.begin("plan.npz", better.save, seconds=seconds, **notes)

    if not (arguments.no_refine or plan.status is Status.INTERRUPTED or (proof is not None and proof.passed)):
        repaired = auto_repair(asked, plan, proof, path, arguments, console, resumed=resumed, store=store)
        plan, proof, path, fixes = repaired
    else:
        fixes = suggested_fixes(plan, proof)
    digest = plan_digest(folder.path / "plan.npz")
    results.write_proof(plan, proof, folder.path, digest, fixes, path)  # without the rollouts, which may be interrupted
    films = None
    with ExitStack() as drawing:
        if proof is not None:
            if not arguments.no_video:  # beside the rollouts, which know nothing of it
                films = drawing.enter_context(BackgroundRender(proof, folder.path, folder.finished, console))
            proof = results.completed(
                proof, arguments.rollouts, console, budget=MAX_ROLLOUT_SECONDS, partial=folder.path / ROLLOUTS,
                executor=executor,
            )  # fmt: skip
            results.write_proof(plan, proof, folder.path, digest, fixes, path)
            results.show_proof(proof, fixes, console)
        else:
            results.show_fixes(fixes, console)
        film_status = results.draw_results(
            plan, proof, folder.path, fixes, not arguments.no_video, console, path=path, keep=folder.finished,
            options=_flags(arguments), films=films,
        )  # fmt: skip
    if film_status == results.INTERRUPTED:
        raise KeyboardInterrupt
    folder.end()
    files = [name for name in results.OUTPUTS if (folder.path / name).is_file()]
    console.write_result(f"\n{folder.path}: {', '.join(files)}")
    if film_status and not arguments.no_video:
        console.write_result(f"no video: {film_status}")
    return 0 if plan.success and proof is not None and proof.passed else 1, {
        "plan": results.plan_facts(plan), "solve_seconds": seconds, "proof": None if proof is None else proof.to_dict(),
        "refinement": [results.refinement_row(line) for line in path], "resumed": resumed, "files": files,
        "video_note": film_status, "cures": [one.to_dict() for one in fixes],
    }  # fmt: skip


def _flags(arguments: argparse.Namespace) -> dict[str, Any]:
    """Flags that are not at their defaults, for the line of the report that repeats the run."""
    given = {name: getattr(arguments, name) for name in (*FLAGS, "starts", "seed")}
    return {name: value for name, value in given.items() if value != arguments.parser.get_default(name)}
