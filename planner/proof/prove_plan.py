"""prove(): independent verification of a plan step by step, each value with its bound.

The steps are in prove(), a line each. PASS requires the plan's consistency, model parity and the same step (0, 1, 2,
where they apply), a trajectory that MuJoCo reproduces and that ends at the goal, in the user's own file too (3, 4, 6 in
the same mode), and a converged solve. Open loop is tried first, and also requires step convergence: a cost that changes
with a smaller step is an integration error.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import count, number, short_repr
from planner.base.errors import PlannerError
from planner.base.executors import checked_executor
from planner.base.measured import Section, bound_excess
from planner.model.twin import Twin
from planner.problem.goals import goals_of, unchecked_goals
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.compare.model_parity import parity_in
from planner.proof.consistency import NOT_FINITE, consistency, optimality, recomputed, with_finite_parts
from planner.proof.contact_sensitivity import contact_sensitivity
from planner.proof.error_propagation import propagate_errors
from planner.proof.error_scales import worst_by_unit
from planner.proof.goal_regulator import (
    RegulatedRun,
    controller_section,
    hold_gain,
    hold_section,
    simulate_regulator,
    slowest_rate,
)
from planner.proof.original_model import PATH_IN_FILE, your_file
from planner.proof.original_model import TITLE as FILE
from planner.proof.replay_errors import goal, tracking
from planner.proof.replays.compiled_twin import another_model, unmodelled_of
from planner.proof.replays.replaying import Replay, replay_in, twin_of
from planner.proof.replays.sampled_gains import sampling_of
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.perturbed import MonteCarloSettings, perturbed
from planner.proof.robustness.rollouts import MODES
from planner.proof.same_step import same_step
from planner.proof.skating import foot_penetration, skating
from planner.proof.step_convergence import own_step, step_convergence
from planner.proof.verdict import Proof

ROLLOUTS = 512  # default maximum number of perturbed simulations in each mode
_ROUNDING = 1e-9  # distance below which the start counts as equal to the goal
_LATER = "it was not asked for: it follows the verdict, with rollouts"
_SHOWN = {"perturbed": "robustness", "controller": "feedback rate", "another_ground": "contact sensitivity"}


@np.errstate(all="ignore")  # a trajectory may diverge: NaN passes no bound
def prove(
    plan: Plan, *, mjcf: Any = None, twin: Twin | None = None, seed: int = 0, rollouts: int = ROLLOUTS,
    perturbation: Perturbation | None = None, hold_seconds: float = 0.0, optimal: bool = True,
    budget: float | None = None, partial: Path | None = None, progress: Callable[[int, int], object] | None = None,
    executor: Executor | None = None,
) -> Proof:  # fmt: skip
    """Replay a plan in MuJoCo at a refined step, open loop and with its gains, and judge it.

    Args:
        plan: A plan of a problem with a twin.
        mjcf: Replay in this MJCF (a path, the XML text or a mujoco.MjSpec) instead of the plan's own. It must have the
            same states. Elements removed from the file of the plan's mechanism are removed from this one too.
        twin: Replay in this model, with its own maps, instead of the plan's own.
        seed: Seed of the random states of parity and of the perturbations.
        rollouts: Maximum number of perturbed simulations in step 5; 0 skips it.
        perturbation: The errors that step 5 draws; by default Perturbation.usual(plan.problem).
        hold_seconds: Duration for which an infinite-horizon LQR regulates the goal after the end, s; 0 skips it.
        optimal: Whether PASS requires a converged solve. False judges feasibility alone.
        budget: Time limit of step 5, s: it then ends with fewer rollouts. None has no limit.
        partial: A file that stores finished rollouts, so that an interrupted proof can be resumed.
        progress: Called with the number of finished rollouts and their total.
        executor: Runs the rollouts, any concurrent.futures.Executor; by default MuJoCo's threads. Results are equal to
            the last bit.

    Raises:
        PlannerError: The plan cannot be replayed at all; a plan with replay errors gets FAIL.
    """
    if not isinstance(plan, Plan):
        raise PlannerError(f"plan is {short_repr(plan)}, expected a Plan.")
    problem = plan.problem
    if problem is None:
        raise PlannerError(
            "the plan comes without its problem, which is its maker's own Python: expected prove() of a plan just "
            "solved, or load_plan(path, problem=...)."
        )
    for name, value, kind in (("twin", twin, Twin), ("perturbation", perturbation, Perturbation)):
        if value is not None and not isinstance(value, kind):
            raise PlannerError(f"{name} is {short_repr(value)}, expected a {kind.__name__} or None.")
    if not isinstance(optimal, bool):
        raise PlannerError(f"optimal is {short_repr(optimal)}, expected True or False.")
    count("seed", seed, minimum=0)
    count("rollouts", rollouts, minimum=0)
    checked_executor(executor)
    number("hold_seconds", hold_seconds, minimum=0.0)
    twin = twin or twin_of(plan)
    plan, not_finite = with_finite_parts(plan, problem)
    compiled = another_model(problem, twin, mjcf)
    sampling = sampling_of(plan)
    openly = replay_in(compiled, plan)
    fed = replay_in(compiled, plan, feedback=True, sampling=sampling, planned=openly.plan_xs)
    runs: dict[str, Replay] = {"open-loop": openly, "feedback": fed}
    now = recomputed(plan, problem, plan.xs, plan.us)
    consistent = consistency(plan, problem, now)
    required = {
        # Step 0: consistency of the file's numbers: start, states, cost, gradient, gains, times.
        "plan": replace(consistent, measured=(*not_finite, *consistent.measured)),
        # Step 1: the plan's dynamics against MuJoCo's, at random states where the two models are the same.
        "parity": parity_in(compiled, problem, seed),
        # Step 2: MuJoCo with the plan's own integrator and step: proves the transcription, nothing else.
        "same_step": same_step(plan, problem, compiled),
    }
    errors = propagate_errors(plan, problem, runs)
    convergence = step_convergence(problem, runs["open-loop"])
    steps = {mode: [tracking(run, problem), goal(run, problem)] for mode, run in runs.items()}
    judged = {"open-loop": [*steps["open-loop"], convergence.section], "feedback": steps["feedback"]}
    sound = all(section.passed for section in required.values())
    goals = goals_of(problem, plan.xs)
    followed = [m for m in MODES if sound and all(step.passed for step in judged[m])]
    found = your_file(plan, problem, goals, runs=runs, followed=followed or MODES[1:], mjcf=mjcf, twin=twin)
    in_file = {m: section for m, (section, _) in found.items()}
    mode = next((m for m in followed if in_file[m].passed), None)
    broken = [m for m in MODES if not all(step.passed for step in judged[m])]
    # The mode that passed, else the one with the smaller error where it fails; gains at equal errors in the file.
    seen = (
        mode
        or min(reversed(followed), key=lambda m: bound_excess([in_file[m]]), default=None)
        or min(broken, key=lambda m: bound_excess(judged[m]), default="open-loop")
    )
    given, in_given = found[seen if followed else "feedback"]
    if in_given is not None:
        given = replace(given, measured=(*given.measured, *own_step(plan, problem, in_given, goals)))
    lost = tuple(one for step in judged["feedback"] for one in step.failures if mode == MODES[0])
    lost_in_file = in_file["feedback"].failures if mode == MODES[0] and not lost else ()
    repeated = bool(followed)
    converged = optimality(plan, problem, now, repeated)
    passed = mode is not None and (converged.passed or not optimal)
    sections = {
        **required,
        # Whether the solve converged, and whether one more step of it would still lower the cost.
        "optimality": converged,
        # Step 3: MuJoCo at a refined step, open loop and with the plan's gains; also how errors grow along the
        # plan, the replay error that this predicts, what halving MuJoCo's step changes, and the cost at a step of zero.
        "refined_open_loop": steps["open-loop"][0],
        "refined_feedback": steps["feedback"][0],
        "growth": errors.section,
        "order": convergence.section,
        # Step 4: whether the replay meets the goals, and whether the machine stays at a goal to be regulated.
        "goal": steps[seen][1],
        "hold": Section("hold", not_applicable="it was not asked for"),
        # Step 6: the model exactly as the user gave it, in the same mode.
        "your_file": given,
        # Shown, not judged, and after the verdict. Step 5: the success rate with other masses, friction,
        # starts, noise and delay. Then the effect of encoders and slow gains, and of other contact parameters.
        **_not_measured(_LATER),
    }
    asked = {
        "seed": seed, "rollouts": rollouts, "hold_seconds": hold_seconds, "optimal": optimal, "perturbation": None,
        "another_model": compiled.twin is not plan.twin,
    }  # fmt: skip
    lacks = unmodelled_of(problem, compiled)
    tested, untested = (lacks.in_the_file, lacks.never_replayed) if given.measured else ((), lacks.phrases)
    proof = Proof(
        verdict="PASS" if passed else "FAIL", mode=mode,
        reason=_reason(
            passed, (*required.values(), *(() if repeated else judged[seen]), given, converged),
            [*steps[seen], given], runs[seen],
        ),
        sections=sections, replay=runs[seen], replays=runs, errors=errors, convergence=convergence, asked=asked,
        planned_without=tested,
        lost_with_gains=lost or lost_in_file, lost_in_file=bool(lost_in_file),
        not_checked=(
            *([f"without {' and '.join(untested)}"] if untested else []), *_said_in_file(given),
            *_unjudged(plan, problem), *skating(plan, problem), *foot_penetration(plan, problem),
        ),
    )  # fmt: skip
    if hold_seconds:
        proof = _held(proof, simulate_regulator(runs["feedback"], hold_gain(problem), hold_seconds))
    if not rollouts:
        return proof
    return with_rollouts(
        with_informative_sections(proof), rollouts, seed=seed, perturbation=perturbation, budget=budget,
        partial=partial,
        progress=progress, executor=executor,
    )  # fmt: skip


def _not_measured(reason: str) -> dict[str, Section]:
    return {name: Section(title, not_applicable=reason) for name, title in _SHOWN.items()}


def without_informative_sections(proof: Proof, reason: str) -> Proof:
    """A proof that says why the steps that are only shown were not run."""
    return replace(proof, sections=proof.sections | _not_measured(reason))


def with_informative_sections(proof: Proof, note: Callable[[str], object] = lambda _: None) -> Proof:
    """A proof with the steps that are only shown: slow gains and encoders, and other contact parameters.

    `note` is called with a line before each.
    """
    plan, compiled, runs = proof.replay.plan, proof.replay.compiled, proof.replays
    problem = plan.problem
    assert problem is not None  # a proof has a problem

    def passes(run: Replay) -> bool:
        return tracking(run, problem).passed and goal(run, problem).passed

    with np.errstate(all="ignore"):
        note("the slowest rate at which the gains still hold")
        planned = runs["feedback"].plan_xs
        rates = slowest_rate(plan, compiled, passes, planned)
        note("the same with encoders")
        encoding = replace(sampling_of(plan), encoders=True)
        encoded = replay_in(compiled, plan, feedback=True, sampling=encoding, planned=planned, contacts=False)
        note("contact sensitivity")
        as_judged = functools.partial(replay_in, sampling=sampling_of(plan), planned=planned)
        ground = contact_sensitivity(plan, compiled, runs, as_judged)
    shown = {"controller": controller_section(rates, encoded), "another_ground": ground}
    return replace(proof, sections=proof.sections | shown)


def with_rollouts(
    proof: Proof, rollouts: int = ROLLOUTS, *, seed: int = 0, perturbation: Perturbation | None = None,
    budget: float | None = None, partial: Path | None = None, progress: Callable[[int, int], object] | None = None,
    executor: Executor | None = None,
) -> Proof:  # fmt: skip
    """A proof with step 5 added; the arguments are those of prove()."""
    run, trials = proof.replay, MonteCarloSettings(rollouts, seed, perturbation)
    found = perturbed(
        run.plan, run.compiled, trials, budget=budget, partial=partial, progress=progress, executor=executor
    )  # fmt: skip
    asked = proof.asked | {"rollouts": found.done, "perturbation": asdict(found.perturbation)}
    return replace(proof, sections=proof.sections | {"perturbed": found.section}, monte_carlo=found, asked=asked)


def _held(proof: Proof, held: RegulatedRun) -> Proof:
    """The proof with the hold step added: a machine that does not stay at a goal to be regulated, fails."""
    section = hold_section(held)
    proof = replace(proof, sections=proof.sections | {"hold": section}, held=held)
    if section.passed or not proof.passed:
        return proof
    plan, warned = proof.replay.plan, "".join(f" {sentence}" for sentence in held.warnings)
    miss = plan.space.difference(proof.replays["feedback"].xs[-1:], held.hold.x_goal)
    worst = max(worst_by_unit(plan, miss), key=lambda one: one.share)
    reason = (
        f"hold: {'; '.join(map(str, section.failures))}.{warned} The replay ends with {worst.name} "
        f"{worst.value:.2g} {worst.unit}".rstrip()
        + " from the goal, too far for the regulator; larger final weights "
        "end nearer."
    )
    return replace(proof, verdict="FAIL", mode=None, reason=reason)


def _stands_at_goal(plan: Plan, problem: Problem) -> bool:
    """Whether staying at the start would pass, though the goal differs from it."""
    goals = [one for one in goals_of(problem, plan.xs) if np.isfinite(one.tolerance)]
    away = [one.miss_at(problem.x0) for one in goals]
    near = all(miss <= one.tolerance for miss, one in zip(away, goals, strict=True))
    return bool(goals) and near and max(away) > _ROUNDING


def _said_in_file(given: Section) -> tuple[str, ...]:
    """What is off in the user's file and is not judged: the path of a plan with contacts."""
    return tuple(one.note for one in given.measured if given.passed and one.name == PATH_IN_FILE and one.value > 1.0)


def _unjudged(plan: Plan, problem: Problem) -> tuple[str, ...]:
    """Goals of the cost that are not judged, one phrase each."""
    if problem.requirements is not None and problem.requirements.goal is not None:
        return ()
    unjudged = unchecked_goals(problem, plan.xs, plan.us)
    phrases = [f"the end of {name} was not judged" for name in unjudged]
    if _stands_at_goal(plan, problem):
        phrases.append("the start is within the goal's tolerance")
    goals = goals_of(problem, plan.xs)
    soft = sum(not math.isfinite(one.tolerance) for one in goals)
    if soft:
        phrases.append(f"{soft} of {len(goals)} goals not judged")
    if not unjudged and not goals and problem.periodic is None:
        phrases.append("no goal was asked for")
    return tuple(phrases)


def _reason(passed: bool, judged: tuple[Section, ...], steps: list[Section], run: Replay) -> str:
    """The verdict in a sentence: how the plan passed, or which step failed and by how much."""
    if not passed:
        broken = next(section for section in judged if section.failures)
        more = "".join(f" {sentence}" for sentence in (*run.warnings, *run.reached))
        if broken.title == "parity":  # an early term causes the later differences
            return f"{broken.title}: {broken.failures[0]}, {broken.failures[0].note}.{more}"
        if broken.title == "plan" and run.plan.changed:
            return f"plan: {broken.failures[-1].note}.{more}"
        if broken.title == "optimal":
            why = run.plan.message if broken.failures[0].name == "not_converged" else f"{broken.failures[0]}."
            alone = "To judge feasibility alone: planner prove --feasible, or prove(..., optimal=False)."
            return f"not optimal: {why} {alone}{more}"
        if broken.failures[0].name == NOT_FINITE:  # the other numbers are of no plan
            return f"plan: {broken.failures[0].note}"
        found = [one.note if one.bound == 0.0 and broken.title == FILE else str(one) for one in broken.failures]
        failures = "; ".join(sentence.removesuffix(".") for sentence in found)
        in_file = () if broken.title == FILE else next(one for one in judged if one.title == FILE).failures
        more += "".join(f" In your file: {one.note}" for one in in_file if one.bound == 0.0)
        if broken.title.startswith("refined") and any(
            one.title == FILE and one.passed and not one.not_applicable for one in judged
        ):
            more += " Your file passes with this plan; the plan's own model moves otherwise in shorter steps."
        if run.reached and broken.title != "plan":  # reaching a range causes the other errors
            return f"{broken.title}:{more} {failures[0].upper()}{failures[1:]}."
        return f"{broken.title}: {failures}.{more}"
    measured = [one for section in steps for one in section.measured if one.bound]
    worst = max(measured, key=lambda one: one.value / (one.bound or 1.0))
    how = "with the plan's gains" if run.feedback else "open loop"
    step = f"at a step of {run.timestep:.3g} s"
    return f"MuJoCo repeats the plan {how} {step}; nearest to its bound: {worst.bound_share_text}."
