"""Weights that need no tuning: of a motion to a goal, from the machine's own limits, its way and its duration.

Every weight makes its term a number without unit that is about 1:

    effort          1 / limit^2 of each control, the limit being what the model says; where it says none, what holds the
                    machine and moves its inertia over the way in half of the time; of machines that stand no more
                    than what corrects an error that is kept to within 1 / SWIFT, of what a joint moves in the air or,
                    if that is more, of what it moves while the feet stay: an ankle carries the machine
    velocity        1 / v^2 of each joint, v = 2 way / duration (a triangle's peak) but never less than MIN_SPEED;
                    only of machines whose actuators reach every joint: another one needs its swing
    position        1 / (KEPT tolerances)^2 beside the straight line to the goal, of machines that stand on the ground:
                    their gains must hold a pose all along; none for others, which find their own way
    final_position  4 / tolerance^2, so that an error of the tolerance costs 2, more than the whole effort
    final_velocity  10 / tolerance^2; both times what the least jerk of the way costs, where jerk is the objective
    hold            of machines that stand, in place of the two: what it costs to stay at the goal for HOLD

The effort of a servo, whose control is a position, and of machines that stand is counted from the control that holds
the goal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import bias, mass_matrix
from planner.dynamics.assembly import feasible_directions
from planner.dynamics.stance import stance_inertia
from planner.model.capabilities import stationary_object_dofs
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.costs.tracking import TrackingCost
from planner.problem.goals import MIN_TOLERANCES, least_share
from planner.problem.initial_guess import quasi_static_controls
from planner.problem.terminal_holding_cost import terminal_holding_cost

MIN_SPEED = {"rad": 0.5, "m": 0.1}  # rad/s, m/s: a joint that stays may move so fast at the price of one that goes
MIN_WAY = {"rad": 0.25, "m": 0.05}  # rad, m: what a motor without limits is taken to move at least
MOVING = 0.75  # of the duration: in the rest a machine that stands comes to rest on a ground that is not the plan's
STANCE_TOLERANCES = 2.0  # tolerances of the goal: 0.04 rad, 10 mm
HOLD_SECONDS = 1.0  # s: longer than what a machine that stands takes to come to rest
MAX_CORRECTION_RATE = (
    60.0  # 1/s: gains that correct faster wrestle with a ground that is not the plan's, and with stages of 10 ms
)
POSITION, VELOCITY = 4.0, 10.0  # over the square of a goal's tolerance
SOFTEST_EFFORT = 1e-12  # a limit of a million of its unit, or one that means none, still leaves a definite weight


@dataclass(frozen=True, eq=False)
class DefaultWeights:
    """Weights by the arguments of TrackingCost.joints, and the reason of each in a sentence."""

    weights: dict[str, np.ndarray]  # effort (nu,), control (nu,), position, velocity, final ones (nv,), hold ()
    reasons: dict[str, str]


def default_weights(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, duration: float, *,
    tolerance: float | Mapping[str, float] | None = None, effort_alone: bool = False, stays: bool = True,
    displacement: np.ndarray | None = None, most: np.ndarray | None = None, jerk: float = 0.0,
) -> DefaultWeights:  # fmt: skip
    """The weights of a motion from x0 (nx,) to a goal (nx,) within a duration, s.

    Args:
        dynamics: The machine.
        x0: (nx,) start.
        goal: (nx,) end.
        duration: s.
        tolerance: How far from the goal the end may be, as Problem has it; finer ones make the goal tighter.
        effort_alone: Whether velocities on the way are free.
        stays: Whether a machine on the ground is kept beside the straight line, and its end weighed by staying there.
        way: (nv,) how far each degree of freedom goes; by default that from x0 to the goal.
        most: (nu,) how large each control may be where the model says nothing; infinite or None for no bound.
        jerk: The weight of jerk in the objective.
    """
    mechanism = dynamics.mechanism
    nv = mechanism.nv
    units = [one.unit for one in coordinates_of_mechanism(mechanism)[: 2 * nv]]
    displacement = np.abs(mechanism.space.difference(x0, goal)[:nv]) if displacement is None else displacement
    speed = np.maximum(2.0 * displacement / duration, [MIN_SPEED[unit] for unit in units[:nv]])
    velocity = np.zeros(nv)
    reach = fully_actuated(dynamics)
    stands = bool(mechanism.contacts) and stays and not effort_alone
    if (reach or bool(mechanism.contacts)) and not effort_alone:
        velocity = 1.0 / speed**2
    share = least_share(zip(displacement.tolist(), units, strict=False))
    position, rate = _tolerances(mechanism, [share * MIN_TOLERANCES[unit] for unit in units], tolerance)
    kept = STANCE_TOLERANCES * position if stands else None
    effort, control, known = _effort(dynamics, x0, goal, duration, displacement, kept, most)
    stays_put = (
        stationary_object_dofs(mechanism) & (displacement == 0.0) & (x0[mechanism.nq : mechanism.nq + nv] == 0.0)
    )
    dear = max(1.0, jerk * min_jerk_cost(displacement, duration))
    ends = dear * (not stands) * ~stays_put
    weights = {
        "effort": effort, "control": control, "velocity": velocity,
        "position": stands * ~stays_put / (STANCE_TOLERANCES * position) ** 2,
        "final_position": ends * POSITION / position**2, "final_velocity": ends * VELOCITY / rate**2,
        "hold": np.array(HOLD_SECONDS * stands),
    }  # fmt: skip
    staying = "none: the weight is that of staying at the goal"
    times = f", times {dear:.3g}, which the least jerk of the way costs" if dear > 1.0 else ""
    return DefaultWeights(weights, {
        "effort": "1 / limit^2 of each control" + ("" if all(known) else ", where the model has no limit from the "
                  "force that holds the machine and moves its inertia") + (
                  f", at most what corrects {STANCE_TOLERANCES:g} tolerances within 1 / {MAX_CORRECTION_RATE:g} s" if
                  stands else ""),
        "velocity": "1 / v^2 of each joint, v = 2 way / duration" if np.any(velocity) else
                    "none: the objective is named" if reach else "none: not every joint has an actuator, and a swing "
                    "must be free",
        "position": f"1 / ({STANCE_TOLERANCES:g} tolerances)^2 beside the straight line: the machine stands on the ground"
                    if stands else "none on the way",
        "final_position": staying if stands else f"{POSITION:g} / tolerance^2{times}",
        "final_velocity": staying if stands else f"{VELOCITY:g} / tolerance^2{times}",
        "hold": f"what it costs to stay at the goal for {HOLD_SECONDS:g} s" if stands else "none: the machine need not stand",
    })  # fmt: skip


def min_jerk_cost(displacement: np.ndarray, duration: float) -> float:
    """Half the integral of the squared jerk of a quintic from rest to rest over a way (nv,): 360 way^2 / T^5.

    No motion from rest to rest has less (Flash and Hogan 1985).
    """
    return 360.0 * float(np.sum(displacement**2)) / duration**5


def default_cost(
    dynamics: RigidBodyDynamics, x0: Any, goal: Any, horizon: int, *,
    tolerance: float | Mapping[str, float] | None = None, **weights: Any,
) -> TrackingCost:  # fmt: skip
    """A cost that brings a machine from x0 (nx,) to a goal (nx,), with weights that need no tuning.

    Args:
        dynamics: The machine.
        x0: (nx,) start.
        goal: (nx,) end.
        horizon: N, number of stages.
        tolerance: How far from the goal the end may be, as Problem has it.
        **weights: Arguments of TrackingCost.joints in place of the default ones.

    Raises:
        PlannerError: As TrackingCost.joints.
    """
    x0, goal = np.asarray(x0, dtype=float), np.asarray(goal, dtype=float)
    chosen: dict[str, Any] = default_weights(dynamics, x0, goal, horizon * dynamics.dt, tolerance=tolerance).weights
    return weighed(dynamics, x0, goal, horizon, chosen | weights, straight=bool(dynamics.mechanism.contacts))


def weighed(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, horizon: int, weights: Mapping[str, Any], *,
    straight: bool,
) -> TrackingCost:  # fmt: skip
    """The cost from x0 (nx,) to a goal (nx,), with weights by the arguments of TrackingCost.joints, and hold.

    `straight` tells whether the weights on the way refer to straight_reference, else to the goal.

    Raises:
        PlannerError: As TrackingCost.joints and staying.
    """
    chosen = dict(weights)
    hold = chosen.pop("hold", 0.0)
    if straight:
        chosen.setdefault("reference", straight_reference(dynamics, x0, goal, horizon))
    return terminal_holding_cost(dynamics, TrackingCost.joints(dynamics, goal, horizon, **chosen), hold)


def straight_reference(dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, N: int) -> np.ndarray:
    """The states (N+1, nx) of the straight line from x0 to a goal, both (nx,), reached after MOVING of the N stages."""
    mechanism, space = dynamics.mechanism, dynamics.space
    nq, nv = mechanism.nq, mechanism.nv
    rest = [x.copy() for x in (x0, goal)]
    for x in rest:
        x[nq : nq + nv] = 0.0
    way, s = space.difference(rest[1], rest[0]), np.minimum(np.arange(N + 1) / (MOVING * N), 1.0)
    places = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    xs = space.integrate(np.tile(rest[0], (N + 1, 1)), places[:, None] * way)
    xs[:, nq : nq + nv] = (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4)[:, None] * way[:nv] / (MOVING * N * dynamics.dt)
    xs[0], xs[N] = x0, goal
    return xs


def fully_actuated(dynamics: RigidBodyDynamics) -> bool:
    """Whether actuators and prescribed joints can accelerate every joint as they like."""
    mechanism, driven = dynamics.mechanism, prescribed_dofs_of(dynamics)
    moment = mechanism.actuators.moment * (mechanism.actuators.gain[:, None] != 0.0)
    own, Z = np.eye(mechanism.nv)[driven], feasible_directions(mechanism, mechanism.qpos0)[0]
    Z = Z[:, ~np.any(Z[stationary_object_dofs(mechanism)], axis=0)]  # an object beside it need not be moved
    return bool(np.linalg.matrix_rank(np.vstack([moment, own]) @ Z) == Z.shape[1])


def _effort(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, duration: float, displacement: np.ndarray,
    kept: np.ndarray | None, most: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, list[bool]]:  # fmt: skip
    """Weights and zero of the controls (nu,), and whether the model limits each.

    `kept` (nv,) are the errors that a machine that stands corrects within 1 / SWIFT; None for any other machine.
    """
    mechanism, driven = dynamics.mechanism, prescribed_dofs_of(dynamics)
    actuators, nq = mechanism.actuators, mechanism.nq
    units = [one.unit for one in coordinates_of_mechanism(mechanism)[: mechanism.nv]]
    swift = 4.0 * np.maximum(displacement, [MIN_WAY[unit] for unit in units]) / duration**2  # of a triangle of speed
    still = np.zeros(mechanism.nv)
    held = np.maximum(*(np.abs(bias(mechanism, x[:nq], still)) for x in (x0, goal)))
    inertia = np.diagonal(mass_matrix(mechanism, x0[:nq]))
    force = held + inertia * swift
    if mechanism.loops or mechanism.polynomial_couplings:  # what leads a chain carries what follows
        Z, leading = feasible_directions(mechanism, x0[:nq])
        carried = np.abs(Z).T @ (held + np.abs(mass_matrix(mechanism, x0[:nq])) @ swift)
        force[leading] = np.maximum(force[leading], carried)
    corrects = np.full(mechanism.nv, np.inf)
    if kept is not None:
        corrects = np.maximum(inertia, stance_inertia(mechanism, goal[:nq])) * MAX_CORRECTION_RATE**2 * kept
    limits, known = np.empty(dynamics.nu), []
    servo = actuators.bias[:, 1] != 0.0
    for a in range(mechanism.nu):
        push = np.abs(actuators.gain[a] * actuators.moment[a])
        limit = _limit(mechanism, a, bool(servo[a]))
        if most is not None and not np.isfinite(limit) and not servo[a]:
            limit = float(most[a])
        known.append(np.isfinite(limit))
        if not known[-1]:
            limit = float(np.max(force[push > 0.0] / push[push > 0.0], initial=0.0)) or 1.0
        limits[a] = min(limit, float(np.max(corrects[push > 0.0] / push[push > 0.0], initial=0.0)) or limit)
    limits[mechanism.nu :] = swift[driven]
    control = np.zeros(dynamics.nu)
    if np.any(servo) or kept is not None:
        control[: mechanism.nu] = np.where(servo | (kept is not None), quasi_static_controls(mechanism, goal), 0.0)
    return np.maximum(1.0 / limits**2, SOFTEST_EFFORT), control, known


def _limit(mechanism: Mechanism, a: int, servo: bool) -> float:
    """How large a control can usefully be, by the model; infinite where it says nothing."""
    actuators = mechanism.actuators
    low, high = actuators.control_range[a]
    found = [0.5 * (high - low) if servo else max(abs(low), abs(high))]
    gain = abs(actuators.gain[a])
    if gain > 0.0:
        found.append(np.abs(actuators.force_range[a]).max() / gain)
        for i in np.flatnonzero(actuators.moment[a]):
            found.append(np.abs(mechanism.joint_force_range[i]).max() / (gain * abs(actuators.moment[a, i])))
    found = [one for one in found if 0.0 < one < np.inf]
    return float(min(found, default=np.inf))


def _tolerances(
    mechanism: Mechanism, usual: list[float], tolerance: float | Mapping[str, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Of positions and velocities (nv,): those that are asked for, where finite; never more than a proof's least."""
    coordinates, asked = coordinates_of_mechanism(mechanism), np.array(usual)
    for i, (name, unit) in enumerate(coordinates[: len(usual)]):
        kind = "velocity" if unit.endswith("/s") else "position"
        given = tolerance.get(name, tolerance.get(kind)) if isinstance(tolerance, Mapping) else tolerance
        if given is not None:
            asked[i] = min(asked[i], given)
    return asked[: mechanism.nv], asked[mechanism.nv :]
