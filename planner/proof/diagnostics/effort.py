"""Diagnose too short a duration: the actuator forces that the trajectory would need, by inverse dynamics.

The forces of the minimum-jerk trajectory from start to goal in a duration T,

    tau(s; T) = M qdd / T^2 + (Coriolis) / T^2 + (damping) / T + gravity and springs,

fall with T until only gravity is left. The shortest T with all forces, controls and velocities within their ranges is
found by bisection.

Without a minimum-jerk trajectory, or if none fits and the goal pose is statically feasible, a plan that misses its goal
with controls or states at their bounds gets 1.5 times the duration: a machine that must swing up needs time, which no
weight replaces. A repair lengthens it further while it is too short: longer().

It is defined where every joint is a hinge or slide joint with an actuator, and velocities are zero at start and goal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from planner.base.measured import Quantity
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.dynamics.joint_forces import gains_at, passive_forces
from planner.dynamics.quasi_static import quasi_static_controls
from planner.model.actuators import DIRECT
from planner.model.capabilities import capabilities_of, stands_on_ground
from planner.model.coordinates import coordinates_of
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.costs.tracking import tracking_of
from planner.problem.initial_guess import quintic
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.progress import control_at_bound, control_name, sentence_of, state_at_bound, state_outside
from planner.problem.rediscretize import rounded_duration
from planner.problem.thrust import missing_thrust
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, has_searched_duration, no_fix
from planner.proof.verdict import Proof


class MinJerkMotion(NamedTuple):
    """Values at the middle of every stage; forces are those of the actuators."""

    q: np.ndarray  # (N, nq)
    qd: np.ndarray  # (N, nv)
    forces: np.ndarray  # (N, nu)
    bias: np.ndarray  # (N, nu) actuator forces at zero control
    gain: np.ndarray  # (N, nu) actuator forces per control

    @property
    def controls(self) -> np.ndarray:
        """(N, nu) controls that give the forces."""
        return (self.forces - self.bias) / np.where(self.gain == 0.0, np.inf, self.gain)


def machine_of(problem: Problem) -> Mechanism | None:
    """The mechanism of a problem with a minimum-jerk trajectory; else None."""
    dynamics, cost = problem.dynamics, tracking_of(problem.cost)
    if not isinstance(dynamics, RigidBodyDynamics) or dynamics.prescribed or cost is None:
        return None
    machine = dynamics.mechanism
    moving = machine.velocities
    ends = np.concatenate([problem.x0[moving], cost.x_ref[-1][moving]])
    whole = np.all(machine.kind == SCREW) and not np.any(machine.actuators.dynamics != DIRECT)
    if not whole or machine.nq != machine.nv or machine.contacts or machine.body_contacts or np.any(ends):
        return None
    moment = machine.actuators.moment  # of what acts at sites 0: its motion is not worth the poses' moments here
    return machine if np.linalg.matrix_rank(moment) == machine.nv else None


def smooth_motion(problem: Problem, machine: Mechanism, duration: float) -> MinJerkMotion:
    """The minimum-jerk trajectory of this duration, with the problem's number of stages."""
    cost, acts = tracking_of(problem.cost), machine.actuators
    assert cost is not None  # checked by machine_of()
    q, qd, qdd = quintic(problem.x0[: machine.nq], cost.x_ref[-1][: machine.nq], duration, problem.N)
    forces = np.linalg.lstsq(acts.moment.T, rnea(machine, q, qd, qdd).T, rcond=None)[0].T
    lengths, rates = q @ acts.moment.T, qd @ acts.moment.T
    return MinJerkMotion(q, qd, forces, passive_forces(acts, lengths, rates), gains_at(acts, lengths, rates))


MAX_LENGTHENING = 10.0  # upper limit of the new duration, relative
USABLE_SHARE = 0.9  # of a range: the rest is reserved for feedback
TOO_WEAK = 0.1  # of the larger bound, by which the control that holds a pose is beyond one: feet may share a load
LENGTHENING = 1.5  # relative new duration without a minimum-jerk trajectory
STATIC_LENGTHENING = 1e3  # relative duration at which only gravity and springs load the actuators
_STEPS = 30  # iterations of the bisection


class _Need(NamedTuple):
    """The largest relative load of an actuator or joint on the minimum-jerk trajectory."""

    load: float  # over the available range; infeasible above 1
    what: str = "force"  # or "speed"
    values: Mapping[str, Any] = MappingProxyType({})  # of the finding


def passing_duration(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The duration that a relaxation found to pass (see planner.solvers.relaxation)."""
    found = plan.options.get("relaxation", {})
    if plan.status is not Status.INFEASIBLE or "duration" not in found:
        return []
    values = {"duration": Quantity(problem.duration, "s"), "factor": found["factor"]}
    return [_in_time(plan, problem, found["duration"], "infeasible", **values)]


def too_little_thrust(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Thrusters that push less than the machine weighs, of a plan that misses its goals."""
    missing = missing_thrust(problem)
    if missing is None or not (_missed(proof) or plan.missed_goals or not plan.converged):
        return []
    values = {name: Quantity(value, "N") for name, value in missing._asdict().items()}
    return [no_fix("goal", "thrust_below_weight", **values)]


def more_time(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The duration of a feasible minimum-jerk trajectory, for a plan that has not met its goal or its limits.

    Of a search over durations that found none, the longest of them is too short.
    """
    if problem.limits is None or not _short_of_force(plan, problem, proof):
        return []
    if has_searched_duration(plan) and (plan.converged or plan.status in (Status.WORK_LIMIT, Status.TIME_LIMIT)):
        return []
    machine = machine_of(problem)
    if machine is None:
        return _of_bounds(plan, problem, proof)
    duration = _longest(plan, problem)
    now, longest = (_need(problem, machine, T) for T in (duration, MAX_LENGTHENING * duration))
    if now.load <= USABLE_SHARE:  # the duration suffices
        return []
    if longest.load > 1.0:
        if _at_goal(problem, machine).load <= 1.0 and (swinging := _of_bounds(plan, problem, proof)):
            return swinging
        values = {**longest.values, "duration": Quantity(MAX_LENGTHENING * duration, "s")}
        against = "needed" in values and values["needed"].value * values["limit"].value < 0.0
        return [no_fix("goal", "servo_ends" if against else f"{longest.what}_never_enough", **values)]
    low, high = 1.0, MAX_LENGTHENING
    for _ in range(_STEPS):
        middle = (low * high) ** 0.5
        fits = _need(problem, machine, middle * duration).load <= USABLE_SHARE
        low, high = (low, middle) if fits else (middle, high)
    values = {**now.values, "duration": Quantity(duration, "s")}
    value = rounded_duration(problem, high * duration / problem.duration)
    return [_in_time(plan, problem, value, f"too_little_{now.what}", **values)]


def _longest(plan: Plan, problem: Problem) -> float:
    """The duration, s; the longest of those that were searched."""
    return float(plan.options["durations"][1]) if has_searched_duration(plan) else problem.duration


def _in_time(plan: Plan, problem: Problem, duration: float, code: str, /, **values: Any) -> SuggestedFix:
    """A longer duration; for a search, as the longest to try."""
    if has_searched_duration(plan):
        return fix(problem, "durations", [float(plan.options["durations"][0]), duration], code, **values)
    return fix(problem, "duration", duration, code, **values)


def _short_of_force(plan: Plan, problem: Problem, proof: Proof | None) -> bool:
    """Whether the plan missed a goal or limit, or the solve did not converge, though the goal is feasible."""
    if plan.status.cut or plan.status in (Status.OUTSIDE_LIMITS, Status.NO_DESCENT):
        return True
    if plan.status is Status.INFEASIBLE and not passing_duration(plan, problem, proof):
        return True
    if proof is None:
        return False
    return _missed(proof) or any(one.name == "clamped_actuators" for one in proof.your_file.failures)


def longer(problem: Problem, tried: SuggestedFix) -> SuggestedFix:
    """A duration 1.5 times as long as one that was tried and too short."""
    value = rounded_duration(problem, LENGTHENING * tried.value / problem.duration)
    written = fix(problem, "duration", value, tried.code).written
    return replace(tried, value=value, written=written)


def _missed(proof: Proof | None) -> bool:
    """Whether the plan itself misses its goal."""
    return proof is not None and any(one.name.startswith("planned") for one in proof.goal.failures)


def _of_bounds(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The duration that passes if known, else 1.5 times it, for a plan often at its bounds, or that left a range."""
    if passing := passing_duration(plan, problem, proof):
        return passing
    if too_weak := _too_weak_to_stand(problem):
        return too_weak
    misses = not plan.converged or _missed(proof)  # else full use of ranges is fine
    at_bounds = (control_at_bound(problem, plan.xs, plan.us), state_at_bound(problem, plan.xs)) if misses else ()
    found = [one for one in (state_outside(problem, plan.xs, plan.t), *at_bounds) if one is not None]
    values = {"duration": Quantity(problem.duration, "s"), "bounds": ", and ".join(map(sentence_of, found))}
    value = rounded_duration(problem, LENGTHENING * _longest(plan, problem) / problem.duration)
    return [_in_time(plan, problem, value, "at_bounds", **values)] if found else []


def _too_weak_to_stand(problem: Problem) -> list[SuggestedFix]:
    """The actuator that cannot hold the pose at the end of a machine that stands there: no duration helps."""
    machine, cost = capabilities_of(problem.dynamics).mechanism, tracking_of(problem.cost)
    if machine is None or cost is None or problem.bounds is None or not stands_on_ground(machine):
        return []
    x = cost.x_ref[-1]
    if np.any(x[machine.velocities]):
        return []
    needed = quasi_static_controls(problem.dynamics, x)
    lower, upper = (side[-1] for side in problem.bounds.at(slice(None), np.tile(x, (problem.N, 1))))
    with np.errstate(invalid="ignore", divide="ignore"):  # without bounds; a rotor's lower one is 0
        excess = np.maximum(needed - upper, lower - needed) / np.maximum(np.abs(upper), np.abs(lower))
    worst = int(np.argmax(np.nan_to_num(excess, nan=0.0)))
    if not excess[worst] > TOO_WEAK:
        return []
    limit = upper[worst] if needed[worst] > upper[worst] else lower[worst]
    values = {"needed": Quantity(needed[worst]), "limit": Quantity(limit)}
    return [no_fix("goal", "pose_never_held", actuator=control_name(problem, worst), **values)]


def _at_goal(problem: Problem, machine: Mechanism) -> _Need:
    """The largest static load at the end of the minimum-jerk trajectory."""
    motion = smooth_motion(problem, machine, STATIC_LENGTHENING * problem.duration)
    return max(_of_forces(problem, machine, MinJerkMotion(*(part[-1:] for part in motion))), key=lambda one: one.load)


def _need(problem: Problem, machine: Mechanism, duration: float) -> _Need:
    """The largest load along the minimum-jerk trajectory of this duration."""
    motion = smooth_motion(problem, machine, duration)
    needs = [*_of_forces(problem, machine, motion), *_of_velocities(problem, machine, motion.qd)]
    return max(needs, key=lambda one: one.load, default=_Need(0.0))


def _of_forces(problem: Problem, machine: Mechanism, motion: MinJerkMotion) -> list[_Need]:
    """Each actuator's force relative to the limits of forcerange, actuatorfrcrange and control bounds."""
    acts, needs = machine.actuators, []
    for a in range(machine.nu):
        lower, upper = (np.full(len(motion.q), side) for side in acts.force_range[a])
        if problem.bounds is not None and acts.pushes[a]:
            ends = np.array([problem.bounds.lower[:, a].max(), problem.bounds.upper[:, a].min()])
            with np.errstate(invalid="ignore"):  # no gain times no bound
                ends = np.nan_to_num(np.outer(ends, motion.gain[:, a]), nan=0.0, posinf=np.inf, neginf=-np.inf)
            lower = np.maximum(lower, ends.min(axis=0) + motion.bias[:, a])
            upper = np.minimum(upper, ends.max(axis=0) + motion.bias[:, a])
        alone = np.flatnonzero(acts.moment[a])
        if len(alone) == 1 and np.count_nonzero(acts.moment[:, alone[0]]) == 1:
            ends = machine.joint_force_range[alone[0]] / acts.moment[a, alone[0]]
            lower, upper = np.maximum(lower, ends.min()), np.minimum(upper, ends.max())
        needs.append(_of_force(problem, a, motion.forces[:, a], lower, upper, _unit(machine, a)))
    return needs


def _of_force(
    problem: Problem, a: int, force: np.ndarray, lower: np.ndarray, upper: np.ndarray, unit: str
) -> _Need:  # fmt: skip
    with np.errstate(all="ignore"):  # one bound may be infinite
        middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        one_sided = np.isfinite(lower) ^ np.isfinite(upper)
        load = np.where(np.isfinite(half), np.abs(force - middle) / np.maximum(half, 1e-300), 0.0)
        load = np.where(one_sided & ((force > upper) | (force < lower)), 2.0, load)
    worst = int(np.argmax(load))
    limit = upper[worst] if force[worst] > middle[worst] else lower[worst]
    values = {"needed": Quantity(force[worst], unit), "limit": Quantity(limit, unit)}
    return _Need(float(load[worst]), values={"actuator": control_name(problem, a), **values})


def _of_velocities(problem: Problem, machine: Mechanism, qd: np.ndarray) -> list[_Need]:
    """Each joint's velocity relative to its range, if it has one."""
    ranges, needs = problem.ranges, []
    if ranges is None:
        return []
    coordinates, cost = coordinates_of(problem.dynamics), tracking_of(problem.cost)
    assert cost is not None  # checked by machine_of()
    for h in range(len(ranges.component) - ranges.at_end):
        i = int(ranges.component[h]) - machine.nv
        if not 0 <= i < machine.nv:
            continue
        reference = cost.x_ref[1:, machine.nq + i]  # which ranges are relative to
        upper, lower = (ranges.upper[1:, h] + reference).min(), (ranges.lower[1:, h] + reference).max()
        most = qd[np.argmax(np.abs(qd[:, i])), i]
        limit = upper if most > 0.0 else lower
        name, unit = coordinates[machine.nv + i]
        load = abs(most / limit) if np.isfinite(limit) and limit != 0.0 else 0.0
        values = {"joint": name, "needed": Quantity(most, unit), "limit": Quantity(limit, unit)}
        needs.append(_Need(load, "speed", values))
    return needs


def _unit(machine: Mechanism, a: int) -> str:
    joint = int(np.argmax(np.abs(machine.actuators.moment[a])))
    return "N m" if np.any(machine.S[joint, :3] != 0.0) else "N"
