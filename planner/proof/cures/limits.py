"""Ranges of joints and actuators that the plan goes beyond, because it does not know them or keeps too near to them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from planner.model.coordinates import ANGLE
from planner.model.couplings import narrowed
from planner.model.mechanism import Mechanism
from planner.problem.limits import MODEL, Limits
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.cures.balance import loses_balance
from planner.proof.cures.cure import Cure, cure, no_cure, rounded_up
from planner.proof.original_model import OVERLAP, ROUNDING
from planner.proof.replays.ranges import Excess, efforts_in, joints_in
from planner.proof.replays.replaying import Replay, stopped_dofs
from planner.proof.verdict import Proof

ASIDE = 1.5  # times what a joint was beyond its range
NO_ROOM = 1e-6  # rad or m
MAX_NAMED = 3
SHARE, LEAST = 0.01, 0.01  # of a range, and rad: the margin that Limits keep by default


def within_limits(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """The limits that the plan is to know and does not."""
    if proof is None:
        return []
    return [*_joints(problem, proof), *_efforts(plan, problem, proof.replay)]


def _joints(problem: Problem, proof: Proof) -> list[Cure]:
    if not _stops_matter(proof) or _knows_ranges(problem):
        return []
    run = proof.replay
    found = [one for one in _planned(run) if one.beyond.max() > OVERLAP * np.ptp(one.range)]
    if not found:
        return []
    worst = max(found, key=lambda one: one.beyond.max() / np.ptp(one.range))
    return [cure(problem, "limits.position", MODEL, f"the plan does not know that {_excess(worst, run.t)}")]


def not_driven(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """A joint that nothing drives and that the plan cannot keep off its stop, which only MuJoCo has."""
    mechanism, ranges, limits = getattr(problem.dynamics, "mechanism", None), problem.ranges, problem.limits
    if not isinstance(mechanism, Mechanism) or ranges is None or limits is None or not mechanism.nu:
        return []
    if not np.isfinite(plan.xs).all():
        return []
    if getattr(problem.dynamics, "prescribed", ()) or mechanism.couplings or mechanism.loops:
        return []
    beyond, driven = ranges.violation(plan.xs).max(axis=0), np.any(mechanism.actuators.moment, axis=0)
    dofs = ranges.component[: len(ranges.component) - ranges.at_end]
    left = [h for h, dof in enumerate(dofs) if dof < mechanism.nv and not driven[dof] and beyond[h] > limits.tolerance]
    if not left:
        return []
    h = max(left, key=lambda h: beyond[h])
    dof = int(dofs[h])
    why = (
        f"Nothing drives {mechanism.joint_of(dof)}, which leaves its range by {beyond[h]:.3g}: in MuJoCo its stop "
        "holds it, and a plan has no force there; couple it to a driven joint in the file, or write a `start` and a "
        "`goal` in which it is off its stop, by 0.1 rad or more"
    )
    return [no_cure("start", why)]


def left_no_room(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """What to edit in a file whose equalities and ranges together leave a joint one position alone."""
    mechanism = getattr(problem.dynamics, "mechanism", None)
    if proof is None or not isinstance(mechanism, Mechanism) or not mechanism.couplings or not _at_stops(proof):
        return []
    own = mechanism.joint_range
    left = narrowed(mechanism, own)
    stuck = np.flatnonzero((np.ptp(left, axis=1) < NO_ROOM) & (np.ptp(own, axis=1) > NO_ROOM))
    if not len(stuck):
        return []
    coupling = next(one for one in mechanism.couplings if stuck[0] in one.dofs)
    names = ", ".join(mechanism.joint_of(dof) for dof in stuck[:MAX_NAMED])
    more = f" and {len(stuck) - MAX_NAMED} more" if len(stuck) > MAX_NAMED else ""
    why = (
        f"the file leaves {names}{more} one position alone, and MuJoCo's stops act there: {coupling.name} and the "
        "ranges of what it ties contradict each other; widen the ranges of the joints that follow in the file, or "
        'write active="false" for the equality'
    )
    return [no_cure("model", why)]


def wider_margin(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """A margin that is wider by what joints are beyond their ranges, between the knots or in MuJoCo."""
    if proof is None or not _stops_matter(proof) or not _knows_ranges(problem):
        return []
    run, limits, ranges = proof.replay, problem.limits, problem.ranges
    if limits is None or ranges is None or np.any(ranges.violation(plan.xs) > limits.tolerance):
        return []  # its own knots are outside: that is the solve's
    states = np.concatenate([run.qpos, run.qvel, run.act], axis=1)
    found = [*_planned(run), *joints_in(run.compiled.model, states, stopped_dofs(plan))]
    worst = max(found, key=lambda one: one.beyond.max(), default=None)
    if worst is None or worst.beyond.max() <= 0.0 or not np.isfinite(states).all():
        return []
    value = rounded_up(_margin(limits, worst) + ASIDE * float(worst.beyond.max()))
    return [cure(problem, "limits.margin", value, f"{_excess(worst, run.t)}, between the knots or in MuJoCo")]


def _margin(limits: Limits | None, one: Excess) -> float:
    """How far plans stay off the ends of a range now."""
    given = getattr(limits, "margin", 0.0)
    if isinstance(given, Mapping):
        given = next((value for name, value in given.items() if repr(name) in one.name), None)
    if given is None:  # the default of Limits
        given = max(SHARE * float(np.ptp(one.range)), LEAST if one.unit == ANGLE else 0.0)
    return float(given)


def _efforts(plan: Plan, problem: Problem, run: Replay) -> list[Cure]:
    limits = problem.limits
    if limits is not None and limits.control is not None:
        return []
    planned = run.compiled.commands(np.repeat(plan.us, run.substeps, axis=0))
    own = list(efforts_in(run.compiled.model, run.twin.sim_of(run.plan_xs), planned))
    beyond = [one for one in own if one.beyond.max() > ROUNDING * min(np.ptp(one.range), np.abs(one.values).max())]
    if not beyond:
        return []
    worst = max(beyond, key=lambda one: one.beyond.max() / np.ptp(one.range))
    low, high = worst.range
    most = float(worst.values[np.argmax(worst.beyond)])
    why = f"{worst.name} {worst.what}: {most:.3g} of {low:.3g} to {high:.3g}"
    return [cure(problem, "limits.control", MODEL, why)]


def _excess(one: Excess, t: np.ndarray) -> str:
    """The range and how far beyond it a joint goes, for a sentence."""
    last = int(np.argmax(one.beyond))
    side = one.range[0] if one.values[last] < one.range[0] else one.range[1]
    when = t[min(last, len(t) - 1)]
    return f"{one.name} goes {one.beyond.max():.3g} {one.unit} beyond {side:.4g} {one.unit} at t = {when:.3g} s"


def _knows_ranges(problem: Problem) -> bool:
    return problem.limits is not None and problem.limits.position is not None


def _planned(run: Replay) -> list[Excess]:
    return list(joints_in(run.compiled.model, run.twin.sim_of(run.plan_xs), stopped_dofs(run.plan)))


def _at_stops(proof: Proof) -> bool:
    """Whether a step fails in whose replay a joint is at its stop."""
    judged = (proof.your_file, proof.refined_open_loop, proof.refined_feedback)
    reached = [
        one.value for section in judged for one in section.measured if one.name in ("ranges_reached", "unknown_stops")
    ]
    return any(not section.passed for section in judged) and any(reached)


def _stops_matter(proof: Proof) -> bool:
    """Whether a step fails because a joint is beyond its range, and not because a machine on its feet falls."""
    if loses_balance(proof):
        return False
    nearest = proof.refined_feedback if proof.replay.feedback else proof.refined_open_loop
    judged = (nearest,) if proof.mode is None else ()
    failures = [one.name for section in (proof.your_file, *judged) for one in section.failures]
    return "unknown_stops" in failures or "position_range_violation" in failures
