"""Commands that make plans or take stored ones: run, solve, prove, render, report."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from planner import cases
from planner.archive import plan_name
from planner.arguments import count
from planner.commands.parser import PROBLEM_FILE
from planner.commands.results import (
    INTERRUPTED,
    OUTPUTS,
    json_text,
    plan_facts,
    show_plan,
    show_proof,
    write_results,
)
from planner.console import Console
from planner.errors import PlannerError
from planner.files import staged_folder, write_atomically
from planner.parity import parity
from planner.plan import Plan
from planner.problem_file import ProblemFile, load
from planner.proof import Proof, prove
from planner.slq import solve

DONE, NOT_DONE, INTERRUPTED_CODE = 0, 1, 130


def _problem(arguments: argparse.Namespace) -> ProblemFile:
    """The problem of a case or a file, and from how many first guesses it is solved."""
    count("max_iterations", arguments.max_iterations)
    if arguments.case == PROBLEM_FILE:
        return load(arguments.problem, starts=arguments.starts, seed=arguments.seed)
    starts = 1 if arguments.starts is None else count("starts", arguments.starts)
    seed = 0 if arguments.seed is None else count("seed", arguments.seed, least=0)
    given = {name[5:]: value for name, value in vars(arguments).items() if name.startswith("case_")}
    return ProblemFile(cases.build(arguments.case, **given), starts, seed)


def _name(arguments: argparse.Namespace) -> str:
    """What a run is called: its case, or its file without folder and ending."""
    return Path(arguments.problem).stem if arguments.case == PROBLEM_FILE else arguments.case


def _solved(asked: ProblemFile, arguments: argparse.Namespace, console: Console) -> tuple[Plan, float]:
    problem = asked.problem
    solve(problem, max_iterations=1)  # what a first run compiles is not the solve's time
    several = f", {asked.starts} starts" if asked.starts > 1 else ""
    console.note(f"planning {_name(arguments)}: {problem.N} stages of {problem.dynamics.dt:.4g} s{several}")
    began = time.perf_counter()
    plan = solve(
        problem, update=arguments.update, line_search=arguments.line_search, starts=asked.starts, seed=asked.seed,
        max_iterations=arguments.max_iterations, callback=console.iteration if asked.starts == 1 else console.start,
    )  # fmt: skip
    return plan, time.perf_counter() - began


def _proved(plan: Plan) -> Proof | None:
    """The proof; None for a plan that is not finite, or when Ctrl-C ends the replay: the plan is still saved."""
    if not (np.isfinite(plan.xs).all() and np.isfinite(plan.cost)):
        return None
    try:
        return prove(plan)
    except KeyboardInterrupt:
        return None


def _exit_code(plan: Plan, proof: Proof | None) -> int:
    return DONE if plan.success and proof is not None and proof.passed else NOT_DONE


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Plan, prove, plot and film a case into a folder."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    asked = _problem(arguments)
    folder = Path(arguments.out or f"renders/{_name(arguments)}")
    with staged_folder(folder, OUTPUTS) as staged:
        first = parity(asked.problem)
        if not first.passed:
            raise PlannerError(f"the plan's dynamics and MuJoCo's differ: {'; '.join(map(str, first.failures))}.")
        plan, seconds = _solved(asked, arguments, console)
        show_plan(plan, seconds, console)
        proof = _proved(plan)
        if proof is not None:
            show_proof(proof, console)
        note = write_results(plan, proof, staged.path, not arguments.no_video, console)
    code = INTERRUPTED_CODE if note == INTERRUPTED else _exit_code(plan, proof)
    files = [name for name in OUTPUTS if (folder / name).is_file()]
    console.say(f"\n{folder}: {', '.join(files)}")
    if note and not arguments.no_video:
        console.say(f"no video: {note}")
    console.document(
        {
            "command": "run", "plan": plan_facts(plan), "solve_seconds": seconds,
            "proof": proof.to_dict() if proof is not None else None, "folder": str(folder), "files": files,
            "video_note": note, "exit_code": code,
        }
    )  # fmt: skip
    return code


def solve_case(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case and save the plan."""
    asked = _problem(arguments)
    out = plan_name(arguments.out)
    with write_atomically(out) as unfinished:  # fails now rather than after the work
        plan, seconds = _solved(asked, arguments, console)
        plan.save(unfinished)
    show_plan(plan, seconds, console)
    console.say(str(out))
    code = DONE if plan.success else NOT_DONE
    console.document(
        {
            "command": "solve",
            "plan": plan_facts(plan),
            "solve_seconds": seconds,
            "file": str(out),
            "exit_code": code,
        }
    )
    return code


def prove_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Replay a stored plan and judge it."""
    plan = Plan.load(arguments.plan)
    mjcf = None if arguments.mjcf is None else Path(arguments.mjcf)
    if arguments.out is None:
        proof = prove(plan, mjcf=mjcf)
    elif Path(arguments.out).suffix != ".json":
        raise PlannerError(f"cannot write the proof as {arguments.out!r}: expected a name ending in .json.")
    else:
        with write_atomically(arguments.out) as unfinished:  # fails now rather than after the work
            proof = prove(plan, mjcf=mjcf)
            unfinished.write_text(json_text(proof.to_dict()), encoding="utf-8")
    show_proof(proof, console)
    if arguments.out is not None:
        console.say(arguments.out)
    code = DONE if proof.passed else NOT_DONE
    console.document({"command": "prove", "plan": plan_facts(plan), "proof": proof.to_dict(), "exit_code": code})
    return code


def render_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Film the replay of a stored plan."""
    from planner.gl import require_backend
    from planner.render import render_strip, render_video

    out = Path(arguments.out)
    if out.suffix not in (".mp4", ".png"):
        raise PlannerError(f"cannot render to {out}: expected a name ending in .mp4 or .png.")
    plan = Plan.load(arguments.plan)
    require_backend()
    proof = prove(plan)
    size = {} if arguments.size is None else dict(zip(("width", "height"), arguments.size, strict=True))
    if out.suffix == ".png":
        render_strip(proof.replay, out, **size)
    else:
        render_video(
            proof.replay, out, fps=arguments.fps, speed=arguments.speed,
            progress=lambda done, total: console.progress("video", done, total), **size,
        )  # fmt: skip
    console.say(str(out))
    console.document({"command": "render", "file": str(out), "exit_code": DONE})
    return DONE


def report_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Prove a stored plan again and write all its files."""
    plan = Plan.load(arguments.plan)
    with staged_folder(arguments.out, OUTPUTS) as staged:
        proof = _proved(plan)
        write_results(plan, proof, staged.path, not arguments.no_video, console)
    if proof is not None:
        show_proof(proof, console)
    code = _exit_code(plan, proof)
    console.say(f"\n{Path(arguments.out) / 'report.html'}")
    console.document({"command": "report", "folder": arguments.out, "exit_code": code})
    return code
