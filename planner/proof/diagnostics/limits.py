"""Diagnose ranges of joints and actuators that the plan violates, and equalities that give in the file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.base.measured import Measurement, Quantity
from planner.model.capabilities import capabilities_of, constrained_dofs
from planner.model.coordinates import ANGLE
from planner.model.couplings import fixed_dofs
from planner.problem.joint_limits import OFF, is_word
from planner.problem.limits import MODEL, Limits
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.diagnostics.goals import loses_balance
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, no_fix, rounded_up
from planner.proof.error_scales import bounds_in_file
from planner.proof.original_model import EQUALITY_RATE, RANGE_EXCESS, TIMESTEP
from planner.proof.reached_limits import OVERLAP, ROUNDING
from planner.proof.replays.ranges import Excess, efforts_in, joints_in
from planner.proof.replays.replaying import Replay, stopped_dofs
from planner.proof.verdict import Proof

MARGIN_FACTOR = 1.5  # new margin relative to the range violation
DEFAULT_SHARE, DEFAULT_MARGIN = 0.01, 0.01  # default margin of Limits: share of a range, and rad


def within_limits(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The limits that the plan lacks and needs."""
    if proof is None:
        return []
    return [*_joints(problem, proof), *_efforts(plan, problem, proof.replay)]


def _joints(problem: Problem, proof: Proof) -> list[SuggestedFix]:
    if not _stops_matter(proof) or _knows_ranges(problem):
        return []
    run = proof.replay
    found = [one for one in _planned(run) if one.beyond.max() > OVERLAP * np.ptp(one.range)]
    if not found:
        return []
    worst = max(found, key=lambda one: one.beyond.max() / np.ptp(one.range))
    return [fix(problem, "limits.position", MODEL, "range_unknown", **_excess(worst, run.t))]


def fixed_joints(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Joints that equalities and ranges of the file leave one value: they lean on stops, and only MuJoCo has those."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if proof is None or mechanism is None or not mechanism.couplings or not proof.your_file.failures:
        return []
    fixed = np.flatnonzero(fixed_dofs(mechanism, np.array(mechanism.joint_range)))
    if not fixed.size:
        return []
    joint, more = mechanism.joint_of(int(fixed[0])), len(fixed) - 1
    return [no_fix("model", "fixed_joints", joint=joint, others=f" and {more} more" if more else "")]


def wider_margin(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """A margin increased by the joints' range violation, between the knots or in MuJoCo."""
    if proof is None or not _stops_matter(proof) or not _knows_ranges(problem):
        return []
    run, limits, ranges = proof.replay, problem.limits, problem.ranges
    if limits is None or ranges is None or np.any(ranges.violation(plan.xs) > limits.tolerance):
        return []  # violations at the plan's knots are the solve's
    states = np.concatenate([run.qpos, run.qvel, run.act], axis=1)
    found = [*_planned(run), *joints_in(run.compiled.model, states, stopped_dofs(plan))]
    worst = max(found, key=lambda one: one.beyond.max(), default=None)
    if not np.isfinite(states).all():
        return []
    if worst is None or worst.beyond.max() <= 0.0:
        return _for_file(problem, proof, found)
    value = rounded_up(_margin(limits, worst) + MARGIN_FACTOR * float(worst.beyond.max()))
    return [fix(problem, "limits.margin", value, "range_exceeded", **_excess(worst, run.t))]


def _for_file(problem: Problem, proof: Proof, joints: list[Excess]) -> list[SuggestedFix]:
    """A margin for what the user's file alone moves beyond a range."""
    excess = next((one for one in proof.your_file.measured if one.name == RANGE_EXCESS), None)
    if excess is None:
        return []
    margin = max((_margin(problem.limits, one) for one in joints if one.unit == excess.unit), default=0.0)
    value = rounded_up(margin + MARGIN_FACTOR * float(excess.value))
    return [fix(problem, "limits.margin", value, "range_exceeded_in_file", excess=Quantity(excess.value, excess.unit))]


def _margin(limits: Limits | None, one: Excess) -> float:
    """The plan's current margin to the ends of a range."""
    given = getattr(limits, "margin", 0.0)
    if isinstance(given, Mapping):
        given = next((value for name, value in given.items() if repr(name) in one.name), None)
    if given is None:  # the default of Limits
        given = max(DEFAULT_SHARE * float(np.ptp(one.range)), DEFAULT_MARGIN if one.unit == ANGLE else 0.0)
    return float(given)


def _efforts(plan: Plan, problem: Problem, run: Replay) -> list[SuggestedFix]:
    limits = problem.limits
    if limits is not None and is_word(limits.control, MODEL):
        return []
    stated = limits is not None and limits.control is not None and not is_word(limits.control, OFF)
    planned = run.compiled.commands(np.repeat(plan.us, run.substeps, axis=0))
    own = list(efforts_in(run.compiled.model, run.twin.sim_of(run.plan_xs), planned))
    beyond = [one for one in own if one.beyond.max() > ROUNDING * min(np.ptp(one.range), np.abs(one.values).max())]
    if not beyond:
        return []
    worst = max(beyond, key=lambda one: one.beyond.max() / np.ptp(one.range))
    low, high = worst.range
    most = float(worst.values[np.argmax(worst.beyond)])
    values = {"actuator": worst.name, "what": worst.what, "most": most, "lower": float(low), "upper": float(high)}
    if stated:  # limits of the user's own, wider than the file's
        return [no_fix("limits.control", "limit_beyond_model", **values)]
    return [fix(problem, "limits.control", MODEL, "clamp_unknown", **values)]


def clamped_in_file(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Actuators that give less in the replayed file than in the plan's model, which has other clamps or none."""
    if proof is None or _efforts(plan, problem, proof.replay):
        return []
    found = next((one for one in proof.your_file.failures if one.name == "clamped_actuators"), None)
    return [] if found is None else [no_fix("limits.control", "clamped_in_file", what=found.note)]


def _excess(one: Excess, t: np.ndarray) -> dict[str, Any]:
    """The range and a joint's violation of it, as values of a finding."""
    last = int(np.argmax(one.beyond))
    side = one.range[0] if one.values[last] < one.range[0] else one.range[1]
    when = t[min(last, len(t) - 1)]
    return {
        "joint": one.name, "excess": Quantity(one.beyond.max(), one.unit), "limit": Quantity(side, one.unit),
        "time": Quantity(when, "s"),
    }  # fmt: skip


def _knows_ranges(problem: Problem) -> bool:
    return problem.limits is not None and problem.limits.position is not None


def _planned(run: Replay) -> list[Excess]:
    return list(joints_in(run.compiled.model, run.twin.sim_of(run.plan_xs), stopped_dofs(run.plan)))


def _stops_matter(proof: Proof) -> bool:
    """Whether a step fails because a joint leaves its range, and not because a standing machine falls."""
    if loses_balance(proof):
        return False
    nearest = proof.refined_feedback if proof.replay.feedback else proof.refined_open_loop
    judged = (nearest,) if proof.mode is None else ()
    failures = [one.name for section in (proof.your_file, *judged) for one in section.failures]
    return "unknown_stops" in failures or "position_range_violation" in failures


SPARE = 2.0  # of what passes, by which the stiffer equality is to give less
STEPS = 2.0  # of the simulator: the shortest time constant that MuJoCo takes
PATH = "largest_"  # begins the name of an error along the path


def soft_equalities(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The time constant with which the file's equalities give as much as passes.

    A force that changes slowly deflects a spring by the inverse square of its natural frequency. The spring swings at
    that frequency, so its velocity falls as the inverse; where its bound rises with the frequency, the share falls as
    the inverse square again. Where a contact, a stop or a clamp of the file is unknown to the plan, that is the cause.
    So is something else where the springs are as fast as the simulator's step lets them be: those of a URDF's mimic.
    Where that step forbids springs as fast as needed, a slower motion is left.
    """
    mechanism = capabilities_of(problem.dynamics).mechanism
    if proof is None or mechanism is None or not constrained_dofs(mechanism).any():
        return []
    failures = proof.your_file.failures
    of_path = all(one.name.startswith((PATH, "replayed_")) for one in failures)
    if not failures or not of_path or not (proof.refined_open_loop.passed or proof.refined_feedback.passed):
        return []
    found = {one.name: one.value for one in proof.your_file.measured}
    rate, shortest = found.get(EQUALITY_RATE, 0.0), STEPS * found[TIMESTEP]
    times = max(_times_as_fast(plan, one, rate) for one in failures)
    if not 0.0 < rate * shortest < 1.0 or not math.isfinite(times):
        return []
    time = 1.0 / (rate * times)
    if time >= shortest:
        return [no_fix("model", "equality_gives", rate=rate, time=time)]
    return [no_fix("model", "equality_gives_too_much", rate=rate, time=shortest, step=Quantity(found[TIMESTEP], "s"))]


def _times_as_fast(plan: Plan, failed: Measurement, rate: float) -> float:
    """How many times as fast springs of a rate, rad/s, are to be for what failed to pass with some to spare."""
    if not failed.bound:
        return math.inf
    needed, falls = SPARE * failed.value / failed.bound, 2.0
    if failed.unit.endswith("/s"):
        bounds, faster = bounds_in_file(plan, rate), bounds_in_file(plan, 2.0 * rate)
        rises = (bounds == failed.bound) & (faster == 2.0 * bounds)
        falls = 2.0 if failed.name.startswith(PATH) and rises.any() else 1.0
    return needed ** (1.0 / falls)
