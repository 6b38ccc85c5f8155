"""The commands `prove` and `check`: judge a stored plan, or show a perturbed simulation of it; prove many plans again.

Both load plans with the residuals of modules that --allow-import names.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice, short_repr
from planner.base.data_files import json_text
from planner.base.errors import PlannerError
from planner.base.files import write_atomically
from planner.cases.given_controls import plan_of_controls, recording_errors
from planner.cases.plan_file import load_plan
from planner.cli.console import Console, shown
from planner.cli.results import completed, show_proof
from planner.cli.solving import plan_facts
from planner.problem.archive import plan_digest
from planner.problem.plan import Plan
from planner.problem.residual import Residual
from planner.proof import prove
from planner.proof.diagnostics import suggested_fixes
from planner.proof.engines.section import NOTES, another_engine, require
from planner.proof.error_scales import worst_by_unit
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import Replay
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.perturbed import replay_rollout
from planner.proof.robustness.success import end_errors
from planner.sweeps.processes import executor_of
from planner.sweeps.regression import check
from planner.sweeps.stored_model import stated


def load_allowed(path: str | Path, arguments: argparse.Namespace) -> Plan:
    """The plan of a file, with the residuals of the modules that --allow-import names."""
    return load_plan(path, residuals=allowed_residuals(arguments))


def allowed_residuals(arguments: argparse.Namespace) -> dict[str, type[Residual]]:
    """Classes of residuals by name, of the modules that --allow-import names.

    Raises:
        PlannerError: A module that cannot be imported, or has no residual.
    """
    found: dict[str, type[Residual]] = {}
    for name in arguments.allow_import:
        named = f"--allow-import {short_repr(name)}"
        try:
            module = _imported(name)
        except Exception as error:  # a module may raise anything
            raise PlannerError(
                f"{named} cannot be imported ({type(error).__name__}: {short_repr(str(error))}), expected a module, or "
                "a file MODULE.py."
            ) from None
        own = {key: one for key, one in vars(module).items() if isinstance(one, type) and issubclass(one, Residual)}
        found |= {one.__name__: one for one in own.values() if one is not Residual}
        if not found:
            raise PlannerError(f"{named} has no residual, expected a class that derives from planner.Residual.")
    return found


def _imported(name: str) -> Any:
    if not name.endswith(".py"):
        if "" not in sys.path and str(Path.cwd()) not in sys.path:  # as python -m has it
            sys.path.insert(0, str(Path.cwd()))
        return importlib.import_module(name)
    module_name = Path(name).stem
    spec = importlib.util.spec_from_file_location(module_name, name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses and pickle look it up there
    spec.loader.exec_module(module)
    return module


_PICTURES = (".png", ".svg", ".pdf")


def prove_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Replay a stored plan and judge it."""
    if arguments.plot is not None and Path(arguments.plot).suffix not in _PICTURES:
        raise PlannerError(f"cannot draw {arguments.plot!r}: expected a name ending in {' or '.join(_PICTURES)}.")
    plan, digest = _plan_of(arguments)
    if arguments.replay_rollout is not None:
        for flag in ("model", "out", "engine", "plot"):
            if getattr(arguments, flag):
                raise PlannerError(
                    f"--{flag} is given with --replay-rollout, which shows a simulation in the plan's own model, "
                    "expected one of the two flags."
                )
        return _show_rollout(plan, arguments, console)
    if arguments.out is not None and Path(arguments.out).suffix != ".json":
        raise PlannerError(f"cannot write the proof as {arguments.out!r}: expected a name ending in .json.")
    other = None if arguments.controls else arguments.model
    perturbation, engines = _perturbation(plan, arguments), dict.fromkeys(arguments.engine)
    for name in engines:
        require(name)
    # an unwritable file fails before the work
    with nullcontext() if arguments.out is None else write_atomically(arguments.out) as unfinished:
        proof = prove(
            plan, mjcf=None if other is None else Path(other), rollouts=0, seed=arguments.seed,
            hold_seconds=arguments.hold, optimal=not (arguments.feasible or arguments.controls),
        )  # fmt: skip
        with executor_of(arguments.workers, arguments.scheduler) as executor:
            proof = completed(
                proof, arguments.rollouts, console, seed=arguments.seed, perturbation=perturbation, executor=executor
            )  # fmt: skip
        sections = {}
        for name in engines:
            console.write_progress(f"the engine {name}")
            sections[name] = another_engine(plan, name, twin=proof.replay.twin, seed=arguments.seed)
        others = {name: section.to_dict() for name, section in sections.items()}
        found = proof.to_dict() | ({"engines": others} if others else {})
        if unfinished is not None:
            unfinished.write_text(json_text(found | {"plan_digest": digest}), encoding="utf-8")
    fixes = suggested_fixes(plan, proof)
    show_proof(
        replace(proof, sections=proof.sections | sections), fixes, console, whole=True
    )  # shown: they are no part of the verdict
    for section in sections.values():
        for one in section.measured:
            if one.name in NOTES and one.note:
                console.write_result(f"{section.title}, {one.name.replace('_', ' ')}: {one.note}")
    if arguments.controls is not None and np.any(plan.K):  # positions that gains follow
        console.write_result()
        console.table(
            ("joint", "farthest from the recording", "at", "root mean square"), recording_errors(proof.replay)
        )
    elif arguments.controls is not None:
        console.write_result("the columns were read as controls; those of positions are named 'position of JOINT'")
    if digest is not None and (states := stated(plan)):
        console.write_result(f"as the plan's file states: {', '.join(states)}")
    if arguments.plot is not None:
        from planner.view.plots.plan import draw_plan  # local: Matplotlib takes a second
        from planner.view.plots.style import save

        save(draw_plan(plan, proof), arguments.plot)
    for file in (arguments.out, arguments.plot):
        if file is not None:
            console.write_result(file)
    return console.finish("prove", 0 if proof.passed else 1, plan=plan_facts(plan), proof=found)


def _plan_of(arguments: argparse.Namespace) -> tuple[Plan, str | None]:
    """The plan that the flags name and the digest of its file: a stored one, or that of anybody's controls."""
    given = {name: getattr(arguments, name) for name in ("start", "goal", "save", "part", "degrees")}
    if arguments.controls is None:
        if flags := [f"--{name}" for name, value in given.items() if value]:
            raise PlannerError(f"{flags[0]} is given without --controls, expected a CSV file of controls with it.")
        if arguments.plan is None:
            raise PlannerError("prove was given no plan, expected a plan.npz, or --controls u.csv --model m.xml.")
        return load_allowed(arguments.plan, arguments), plan_digest(arguments.plan)
    if arguments.plan is not None or arguments.model is None:
        what = "a plan and" if arguments.plan is not None else "no --model with"
        raise PlannerError(f"prove was given {what} --controls, expected --controls u.csv --model m.xml and no plan.")
    start, goal = (None if given[name] is None else _state(given[name]) for name in ("start", "goal"))
    plan = plan_of_controls(
        arguments.controls, Path(arguments.model), start=start, goal=goal, part=given["part"], degrees=given["degrees"]
    )
    if arguments.save is not None:
        plan.save(arguments.save)
    return plan, None


def _state(words: str) -> str | list[float] | dict[str, float]:
    """A keyframe's name, numbers 0,1.57, or positions elbow=0.3,wrist=0, as a problem file has them."""
    parts = [part.partition("=") for part in words.split(",")]
    try:
        if all(sign for _, sign, _ in parts) and len({name.strip() for name, _, _ in parts}) == len(parts):
            return {name.strip(): float(value) for name, _, value in parts}
        return [float(part) for part in words.split(",")]
    except ValueError:
        if "=" in words or "," in words:
            raise PlannerError(
                f"the state is {short_repr(words)}, expected numbers 0,1.57 or joints elbow=0.3."
            ) from None
        return words


def rollout_of(plan: Plan, arguments: argparse.Namespace) -> Replay:
    """The perturbed simulation that --replay-rollout, --mode, --seed and --perturb name."""
    perturbation = _perturbation(plan, arguments)
    if plan.twin is None:
        raise PlannerError("the plan holds no MuJoCo model, expected a plan of a Problem with a twin.")
    number = arguments.replay_rollout
    compiled, feedback = CompiledTwin(plan.twin), arguments.mode == "feedback"
    return replay_rollout(plan, compiled, number, seed=arguments.seed, perturbation=perturbation, feedback=feedback)


def _perturbation(plan: Plan, arguments: argparse.Namespace) -> Perturbation:
    """The plan's usual perturbation, changed by --perturb, e.g. mass=0.1."""
    given = {}
    for word in arguments.perturb or ():
        name, _, value = word.partition("=")
        name = choice("--perturb", name.strip(), Perturbation.__dataclass_fields__)
        try:
            given[name] = float(value)
        except ValueError:
            raise PlannerError(
                f"--perturb {name} is {short_repr(value)}, expected a number, e.g. {name}=0.05."
            ) from None
    return Perturbation.usual(plan.problem, **given)


def _show_rollout(plan: Plan, arguments: argparse.Namespace, console: Console) -> int:
    run = rollout_of(plan, arguments)
    errors = [
        (f"{part}_{one.word}_error", one) for part, along in (("end", run.error[-1:]), ("path", run.error))
        for one in worst_by_unit(plan, along)
    ]  # fmt: skip
    facts = {
        "case": arguments.replay_rollout, "seed": arguments.seed, "mode": arguments.mode,
        "end_error": float(end_errors(plan, run.xs[-1:])[0]),  # over its range of motion, as the Monte Carlo has it
        **{name: one.value for name, one in errors}, "cost": run.cost, "timestep": run.timestep,
        "warnings": list(run.warnings), "reached": list(run.reached),
    }  # fmt: skip
    told = facts | {name: f"{one.value:.5g} {one.unit}, {one.name}" for name, one in errors}
    told["end_error"] = f"{facts['end_error']:.5g} of its range of motion"
    console.table(("rollout", "value"), [(name.replace("_", " "), shown(value)) for name, value in told.items()])
    console.write_result(
        f"film: planner render {arguments.plan} --replay-rollout {arguments.replay_rollout} --mode {arguments.mode}"
    )
    return console.finish("prove", 0, replay_rollout=facts)


def check_plans(arguments: argparse.Namespace, console: Console) -> int:
    """Prove stored plans again and print a table of the numbers that changed."""
    with executor_of(arguments.workers, arguments.scheduler) as executor:
        done = check(
            *arguments.paths, tolerance=arguments.tolerance, update=arguments.update, model=arguments.model,
            callback=lambda one: console.write_progress(f"{one.plan}: {one.word}"), executor=executor,
            residuals=allowed_residuals(arguments),
        )  # fmt: skip
    for one in done:
        console.write_result(one.line)
    rows = [
        (str(one.plan), f"{change.step} {change.name}".replace("_", " ").strip(),
         shown(change.stored), shown(change.now), shown(change.bound), change.word)
        for one in done for change in one.changes
    ]  # fmt: skip
    if rows:
        console.table(("plan", "measured", "stored", "now", "bound", ""), rows)
    counts = Counter(one.word for one in done)
    console.write_result(f"plans checked: {len(done)}, {', '.join(f'{word}: {counts[word]}' for word in counts)}")
    plans = [
        {
            "plan": str(one.plan), "passed": one.passed, "word": one.word, "problem": one.problem,
            "model": None if one.model is None else {"state": one.model.state, "details": list(one.model.details)},
            "stated": list(one.stated),
            "verdict": None if one.proof is None else one.proof.verdict,
            "changes": [change._asdict() for change in one.changes],
        }
        for one in done
    ]  # fmt: skip
    return console.finish("check", int(not all(one.passed for one in done)), plans=plans)
