"""Commands on plans: solve, prove, render, report."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from planner.base.arguments import choice, count
from planner.base.errors import PlannerError
from planner.base.files import staged_folder, write_atomically
from planner.base.jsonable import json_text
from planner.cases.plan_file import load_plan
from planner.cli.console import Console
from planner.cli.problems import asked_problem, solved
from planner.cli.results import OUTPUTS, plan_facts, show_plan, show_proof, write_results
from planner.problem.archive import plan_name
from planner.problem.plan import Plan
from planner.proof import Proof, prove
from planner.proof.case_replay import replay_case
from planner.proof.compiled_twin import CompiledTwin
from planner.proof.perturbation import Perturbation
from planner.proof.replaying import Replay

DONE, NOT_DONE = 0, 1


def solve_case(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case and save the plan."""
    asked = asked_problem(arguments)
    out = plan_name(arguments.out)
    with write_atomically(out) as unfinished:  # fails now rather than after the work
        plan, seconds = solved(asked, arguments, console)
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


def _perturbation(words: list[str] | None, plan: Plan) -> Perturbation:
    """What --perturb says, e.g. mass=0.1, and for the rest what is usual for a plan."""
    given = {}
    for word in words or ():
        name, _, value = word.partition("=")
        name = choice("--perturb", name.strip(), Perturbation.__dataclass_fields__)
        try:
            given[name] = float(value)
        except ValueError:
            raise PlannerError(f"--perturb {name} is {value!r}, expected a number, e.g. {name}=0.05.") from None
    return Perturbation.usual(plan.problem, **given)


def prove_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Replay a stored plan and judge it."""
    plan = load_plan(arguments.plan)
    perturbation = _perturbation(arguments.perturb, plan)
    if arguments.replay_case is not None:
        for flag in ("mjcf", "out"):
            if getattr(arguments, flag) is not None:
                raise PlannerError(
                    f"--replay-case is of the plan's own model and prints, expected it without --{flag}."
                )
        return _show_case(plan, arguments, perturbation, console)

    def judge() -> Proof:
        return prove(
            plan, mjcf=None if arguments.mjcf is None else Path(arguments.mjcf), rollouts=arguments.rollouts,
            seed=arguments.seed, perturbation=perturbation, hold_seconds=arguments.hold,
            progress=lambda done, total: console.progress("perturbed simulations", done, total),
        )  # fmt: skip

    if arguments.out is None:
        proof = judge()
    elif Path(arguments.out).suffix != ".json":
        raise PlannerError(f"cannot write the proof as {arguments.out!r}: expected a name ending in .json.")
    else:
        with write_atomically(arguments.out) as unfinished:  # fails now rather than after the work
            proof = judge()
            unfinished.write_text(json_text(proof.to_dict()), encoding="utf-8")
    show_proof(proof, console)
    if arguments.out is not None:
        console.say(arguments.out)
    code = DONE if proof.passed else NOT_DONE
    console.document({"command": "prove", "plan": plan_facts(plan), "proof": proof.to_dict(), "exit_code": code})
    return code


def _case(plan: Plan, arguments: argparse.Namespace, perturbation: Perturbation) -> Replay:
    """One rollout of the Monte Carlo in detail."""
    if plan.twin is None:
        raise PlannerError("the plan has no MuJoCo model to be replayed in, expected a Problem with a twin.")
    count("replay-case", arguments.replay_case, least=0)
    compiled, feedback = CompiledTwin(plan.twin), arguments.mode == "feedback"
    return replay_case(
        plan, compiled, arguments.replay_case, seed=arguments.seed, perturbation=perturbation, feedback=feedback
    )


def _show_case(plan: Plan, arguments: argparse.Namespace, perturbation: Perturbation, console: Console) -> int:
    run = _case(plan, arguments, perturbation)
    end, largest = float(np.abs(run.error[-1]).max()), float(np.abs(run.error).max())
    facts = {
        "case": arguments.replay_case, "seed": arguments.seed, "mode": arguments.mode, "end_error": end,
        "largest_error": largest, "cost": run.cost, "timestep": run.timestep, "warnings": list(run.warnings),
        "reached": list(run.reached),
    }  # fmt: skip
    console.table(("rollout", "value"), [(name.replace("_", " "), _shown(value)) for name, value in facts.items()])
    console.say(
        f"planner render {arguments.plan} --replay-case {arguments.replay_case} --mode {arguments.mode} films it"
    )
    console.document({"command": "prove", "replay_case": facts, "exit_code": DONE})
    return DONE


def _shown(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else " ".join(value) if isinstance(value, list) else str(value)


def render_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Film the replay of a stored plan."""
    from planner.base.gl import require_backend
    from planner.view.render.video import render_strip, render_video

    out = Path(arguments.out)
    if out.suffix not in (".mp4", ".png"):
        raise PlannerError(f"cannot render to {out}: expected a name ending in .mp4 or .png.")
    plan = load_plan(arguments.plan)
    require_backend()
    if arguments.replay_case is not None:
        shown = _case(plan, arguments, _perturbation(arguments.perturb, plan))
    else:
        shown = prove(plan, rollouts=0)  # both of its replays, side by side
    size = {} if arguments.size is None else dict(zip(("width", "height"), arguments.size, strict=True))
    if out.suffix == ".png":
        render_strip(shown.replay if isinstance(shown, Proof) else shown, out, **size)
    else:
        render_video(
            shown, out, fps=arguments.fps, speed=arguments.speed,
            progress=lambda done, total: console.progress("video", done, total), **size,
        )  # fmt: skip
    console.say(str(out))
    console.document({"command": "render", "file": str(out), "exit_code": DONE})
    return DONE


def report_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Prove a stored plan again and write all its files."""
    plan = load_plan(arguments.plan)
    with staged_folder(arguments.out, OUTPUTS) as staged:
        proof = None
        if np.isfinite(plan.xs).all() and np.isfinite(plan.cost):
            proof = prove(
                plan, rollouts=arguments.rollouts, hold_seconds=arguments.hold,
                progress=lambda done, total: console.progress("perturbed simulations", done, total),
            )  # fmt: skip
        write_results(plan, proof, staged.path, not arguments.no_video, console)
    if proof is not None:
        show_proof(proof, console)
    code = DONE if plan.success and proof is not None and proof.passed else NOT_DONE
    console.say(f"\n{Path(arguments.out) / 'report.html'}")
    console.document({"command": "report", "folder": arguments.out, "exit_code": code})
    return code
