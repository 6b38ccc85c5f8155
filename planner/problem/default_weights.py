"""Default cost weights for reaching a goal, from the machine's limits, the displacement and the duration.

Every weight makes its term dimensionless and about 1:

    effort          1 / limit^2 of each control, the limit of the model or, without one, the force that balances
                    gravity and accelerates the inertia over the displacement in half of the time. For standing
                    machines at most the force that corrects STANCE_TOLERANCES at MAX_CORRECTION_RATE, with the larger
                    of the joint's inertias in the air and with fixed feet; of velocity servos of wheels how they roll
    velocity        1 / v^2 of each joint, v = 2 displacement / duration (peak of a triangle), at least MIN_SPEED;
                    only for fully actuated or standing machines: others need to swing. VELOCITY_SHARE of it where
                    an objective is named
    position        1 / (STANCE_TOLERANCES tolerances)^2 of the distance from the straight line to the goal, for
                    machines that stand on the ground; none for others
    final_position  4 / tolerance^2, so that an error of the tolerance costs 2, more than the whole effort
    final_velocity  10 / tolerance^2; both times the cost of the minimum-jerk motion, where jerk is the objective. None
                    of both for translations of a free base that nothing from outside can stop, and for joints of
                    closed chains that lean on a stop: they are where the driven ones take them
    hold            for standing machines, in place of these two: the cost of staying at the goal for HOLD_SECONDS
    rest            share of the duration, at the end, in which a machine whose feet have to move is to be at its goal.
                    Before, positions have no weight and velocities WAY_SHARE of theirs: it may hop, step or crawl. Its
                    effort is at least that at which the gains of the position weight are GAIN_SHARE of the stiffness
                    of its contacts: a foot that lands early or late meets gains that its ground bears
    slip            1 / SLIP_SPEED^2 of the speed of feet along the ground, or close to it, where feet have to move:
                    they are lifted, not dragged (problem.costs.frame)

Velocities refer to a minimum-jerk motion where every joint has an actuator: relative to rest, a joint with much damping
and little inertia would move at constant velocity, and start and stop within a stage. The effort of machines that stand
or fly is relative to the static control at the goal. That of servos, whose control is a position or a velocity, is
relative to the controls of that motion, or of a gait (reaching_cost.servo_reference): what costs is the force that a
servo exerts beyond it, not the position that it is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import bias, mass_matrix
from planner.dynamics.assembly import closed_chains, feasible_directions
from planner.dynamics.joint_forces import actuator_lengths, actuator_moments, force_slopes, gains_at
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.rest_on_stops import leaning_dofs
from planner.dynamics.statics import (
    carriers,
    contact_stiffness,
    feet_move,
    rolling_speeds,
    stance_inertia,
    stands_somewhere,
)
from planner.model.capabilities import ballistic_dofs, flies, rolling_radii, stands_on_ground, stationary_object_dofs
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.costs.terms import checked_tolerance
from planner.problem.goals import MIN_TOLERANCES, tolerance_share
from planner.problem.objective import VELOCITY_SHARE

MIN_SPEED = {"rad": 0.5, "m": 0.1}  # rad/s, m/s: speed of a joint without displacement whose cost is 1
MIN_DISPLACEMENT = {"rad": 0.25, "m": 0.05}  # rad, m: lower limit in the force of a motor without limits
STANCE_TOLERANCES = 2.0  # in tolerances of the goal: position error along the plan whose cost is 1
HOLD_SECONDS = 1.0  # s: longer than a standing machine takes to come to rest
MAX_CORRECTION_RATE = 60.0  # 1/s: faster gains amplify errors of the ground model and of stages of 10 ms
GAIN_SHARE = 1.0 / 3.0  # of the stiffness of the contacts: the gains' limit where feet land
POSITION, VELOCITY = 4.0, 10.0  # final weights times the squared tolerance of the goal
SLIP_SPEED = 0.05  # m/s: of a foot on the ground, whose cost is 1; it slips by STRIDE in a second
STILL = 1e-6  # rad: a wheel that no goal turns
MIN_EFFORT = 1e-12  # lower limit of an effort weight: very large limits still leave it positive definite


MOVING_SHARE = 0.75  # of the duration, in which the reference of a standing machine moves; it rests afterwards
WAY_SHARE = 0.01  # of the velocity weights, while feet that have to move are on the way


@dataclass(frozen=True, eq=False)
class DefaultWeights:
    """Weights by arguments of TrackingCost.joints, and the reason of each as text."""

    # effort (nu,), control (nu,), position, velocity, final ones (nv,); hold, rest, slip ()
    weights: dict[str, np.ndarray]
    reasons: dict[str, str]


def default_weights(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, duration: float, *,
    tolerance: float | Mapping[str, float] | None = None, named: bool = False, stays: bool = True,
    displacement: np.ndarray | None = None, max_control: np.ndarray | None = None, jerk: float = 0.0,
    way: np.ndarray | None = None, last_share: float = 1.0, carried_along: np.ndarray | None = None,
) -> DefaultWeights:  # fmt: skip
    """Weights for reaching a goal (nx,) from x0 (nx,) within a duration, s.

    Args:
        dynamics: The machine.
        x0: (nx,) start.
        goal: (nx,) end.
        duration: s.
        tolerance: Of the goal, as of Problem; smaller ones make the weights larger.
        named: Whether an objective is named, which has VELOCITY_SHARE of the running weight of velocities.
        stays: Whether a standing machine has weights for the straight line and for staying at the goal.
        displacement: (nv,) rad or m of each degree of freedom; by default from x0 to the goal.
        max_control: (nu,) max magnitude of each control where the model has no limit; infinite or None for none.
        jerk: The weight of jerk in the objective.
        way: (E, nq) configurations from the start to the goal, where more than these two are known.
        last_share: Share of the duration after the last goal before the end.
        carried_along: (nv,) bool, degrees of freedom that may end anywhere; by default none.
    """
    mechanism = dynamics.mechanism
    nv = mechanism.nv
    units = [one.unit for one in coordinates_of_mechanism(mechanism)[: 2 * nv]]
    displacement = np.abs(mechanism.space.difference(x0, goal)[:nv]) if displacement is None else displacement
    radii = np.where(displacement < STILL, rolling_radii(mechanism), 0.0)  # of wheels, which turn as far as they like
    speed = np.maximum(2.0 * displacement / duration, [MIN_SPEED[unit] for unit in units[:nv]])
    velocity = np.zeros(nv)
    both = np.stack([x0, goal])
    actuated, decided = fully_actuated(dynamics, both), _decided_by_stops(mechanism, both)
    carried = stands_somewhere(mechanism, both)
    between = both[:, : mechanism.nq] if way is None else way
    steps = carried and (stays or way is not None) and feet_move(mechanism, between)
    stands = carried and (stays or steps)
    if actuated or carried:
        velocity = (VELOCITY_SHARE if named else 1.0) * ~decided / speed**2
    share = tolerance_share(zip(displacement.tolist(), units, strict=False))
    position, rate = _tolerances(mechanism, [share * MIN_TOLERANCES[unit] for unit in units], tolerance)
    stance_error = STANCE_TOLERANCES * position if stands else None
    gained = 1.0 / (STANCE_TOLERANCES * position) ** 2 if steps else None
    rolling = rolling_speeds(mechanism, x0[: mechanism.nq], radii, speed)
    effort, control, known = _effort(
        dynamics, x0, goal, duration, displacement, stance_error, max_control, gained, rolling
    )
    stationary = stationary_object_dofs(mechanism) & (displacement == 0.0) & (x0[mechanism.velocities] == 0.0)
    jerk_cost = max(1.0, jerk * min_jerk_cost(displacement, duration))
    falling = ballistic_dofs(mechanism, x0)
    ends = jerk_cost * (not stands) * ~stationary * ~falling * ~decided
    placed = np.ones(nv) if carried_along is None else 1.0 * ~carried_along
    weights = {
        "effort": effort, **({} if control is None else {"control": control}), "velocity": velocity,
        "position": stands * (~stationary & (radii == 0.0)) / (STANCE_TOLERANCES * position) ** 2,
        "final_position": ends * placed * POSITION / position**2, "final_velocity": ends * VELOCITY / rate**2,
        "hold": np.array(HOLD_SECONDS * stands),
        **({"rest": np.array((1.0 - MOVING_SHARE) * last_share), "slip": np.array(SLIP_SPEED**-2)} if steps else {}),
    }  # fmt: skip
    held = "none: the weight is that of staying at the goal"
    falls = ", none where the machine falls or drifts freely" if falling.any() else ""
    follows = "" if np.all(placed) else ", none of a base that no goal names and nothing holds"
    leans = ", none of closed chains that lean on a stop" if decided.any() else ""
    times = f", times {jerk_cost:.3g}, the cost of the minimum-jerk motion" if jerk_cost > 1.0 else ""
    return DefaultWeights(weights, {
        "effort": "1 / limit^2 of each control" + ("" if all(known) else ", where the model has no limit from the "
                  "force that balances gravity and accelerates the inertia") + (
                  f", at most what corrects {STANCE_TOLERANCES:g} tolerances within 1 / {MAX_CORRECTION_RATE:g} s" if
                  stands else "") + (f", at least that of gains of {GAIN_SHARE:.2g} of the contacts' stiffness" if
                  steps else ""),
        "velocity": (f"{VELOCITY_SHARE:g}, beside the objective, of " if named else "")
                    + "1 / v^2 of each joint from a minimum-jerk motion, v = 2 displacement / duration" if
                    np.any(velocity) else
                    "none: not every joint has an actuator, and a swing must be free",
        "position": f"1 / ({STANCE_TOLERANCES:g} tolerances)^2 from the straight line: the machine stands"
                    if stands else "none on the way",
        "final_position": held if stands else f"{POSITION:g} / tolerance^2{times}{falls}{follows}{leans}",
        "final_velocity": held if stands else f"{VELOCITY:g} / tolerance^2{times}{falls}{leans}",
        "hold": f"the cost of staying at the goal for {HOLD_SECONDS:g} s" if stands else
                "none: the machine does not stand",
        **({"rest": f"feet have to move: the machine is at its goal for the last {1.0 - MOVING_SHARE:g} of the time "
            f"to it; before, positions have no weight and velocities {WAY_SHARE:g} of theirs",
            "slip": f"1 / ({SLIP_SPEED:g} m/s)^2: feet are lifted rather than dragged"} if steps else {}),
    })  # fmt: skip


def min_jerk_cost(displacement: np.ndarray, duration: float) -> float:
    """Half the integrated squared jerk of the minimum-jerk trajectory over a displacement (nv,): 360 d^2 / T^5.

    It is the minimum over all trajectories from rest to rest (Flash and Hogan 1985).
    """
    return 360.0 * float(np.sum(displacement**2)) / duration**5


def _decided_by_stops(mechanism: Mechanism, xs: np.ndarray) -> np.ndarray:
    """(nv,) bool, undriven degrees of freedom of the closed chains that lean on a stop at all states xs (K, nx)."""
    pressed, found = leaning_dofs(mechanism, xs), np.zeros(mechanism.nv, dtype=bool)
    for chain in closed_chains(mechanism) if pressed.any() else ():
        found |= chain & (pressed & chain).any()
    return found & ~mechanism.directly_actuated


def fully_actuated(dynamics: RigidBodyDynamics, xs: np.ndarray) -> bool:
    """Whether actuators, prescribed joints and the stops of _decided_by_stops decide every acceleration."""
    mechanism, prescribed = dynamics.mechanism, prescribed_dofs_of(dynamics)
    gain = gains_at(mechanism.actuators, actuator_lengths(mechanism, mechanism.qpos0))
    moment = actuator_moments(mechanism, mechanism.qpos0) * (gain[:, None] != 0.0)
    pressed = leaning_dofs(mechanism, xs) & _decided_by_stops(mechanism, xs)
    given = np.isin(np.arange(mechanism.nv), prescribed) | pressed
    own, Z = np.eye(mechanism.nv)[given], feasible_directions(mechanism, mechanism.qpos0)[0]
    lies = stationary_object_dofs(mechanism)  # separate from the machine, and needs no actuator
    Z = Z[:, ~np.any(Z[lies], axis=0)]
    return bool(np.linalg.matrix_rank(np.vstack([moment, own]) @ Z) == Z.shape[1])


def _effort(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, duration: float, displacement: np.ndarray,
    stance_error: np.ndarray | None, max_control: np.ndarray | None, gained: np.ndarray | None, rolling: np.ndarray,
) -> tuple[np.ndarray, np.ndarray | None, list[bool]]:  # fmt: skip
    """Weights and reference of the controls (nu,), and whether each has a limit in the model or in `max_control`.

    The reference is None where servos follow a motion.

    `stance_error` (nv,): position errors, rad or m, that a standing machine corrects at MAX_CORRECTION_RATE; else None.
    `gained` (nv,): position weights whose gains GAIN_SHARE of the stiffness of the contacts limits; else None.
    `rolling` (nv,): rad/s of wheels that may turn as far as they like, which their velocity servos are told; else 0.
    """
    mechanism, prescribed = dynamics.mechanism, prescribed_dofs_of(dynamics)
    actuators, nq = mechanism.actuators, mechanism.nq
    units = [one.unit for one in coordinates_of_mechanism(mechanism)[: mechanism.nv]]
    acceleration = (
        4.0 * np.maximum(displacement, [MIN_DISPLACEMENT[unit] for unit in units]) / duration**2
    )  # triangular velocity profile
    still = np.zeros(mechanism.nv)
    held = np.maximum(*(np.abs(bias(mechanism, x[:nq], still)) for x in (x0, goal)))
    inertia = np.diagonal(mass_matrix(mechanism, x0[:nq]))
    force = held + inertia * acceleration
    if dynamics.capabilities.loops:  # independent joints of a closed chain carry the dependent ones
        Z, leading = feasible_directions(mechanism, x0[:nq])
        carried = np.abs(Z).T @ (held + np.abs(mass_matrix(mechanism, x0[:nq])) @ acceleration)
        force[leading] = np.maximum(force[leading], carried)
    correction = np.full(mechanism.nv, np.inf)
    if stance_error is not None:
        correction = np.maximum(inertia, stance_inertia(mechanism, goal[:nq])) * MAX_CORRECTION_RATE**2 * stance_error
    borne = np.zeros(mechanism.nv)  # N or N m: the control whose weight 1 / u^2 has the gain sqrt(Q / R) in the limit
    if gained is not None:
        borne = GAIN_SHARE * contact_stiffness(mechanism, goal[:nq]) / np.sqrt(gained)
    swings = not (fully_actuated(dynamics, np.stack([x0, goal])) or stands_on_ground(mechanism))
    steers = carriers(mechanism, rolling > 0.0)
    swing = np.minimum([MIN_DISPLACEMENT[unit] for unit in units], 0.5 * np.ptp(mechanism.joint_range, axis=1))
    limits, known, moment = np.empty(dynamics.nu), [], actuator_moments(mechanism, x0[:nq])
    slopes = force_slopes(actuators, np.zeros(mechanism.nu), actuator_lengths(mechanism, x0[:nq]))
    servo, gain = slopes.by_length != 0.0, np.abs(slopes.gain)
    for a in range(mechanism.nu):
        push = gain[a] * np.abs(moment[a])
        limit = _limit(mechanism, a, bool(servo[a]), gain[a])
        if max_control is not None and not np.isfinite(limit) and not servo[a]:
            limit = float(max_control[a])
        known.append(np.isfinite(limit))
        if not known[-1]:
            limit = float(np.max(force[push > 0.0] / push[push > 0.0], initial=0.0)) or 1.0
        told = 0.0  # to a servo, where no reference says it: that is no force beyond one
        if servo[a] and (swings or np.all(steers[push > 0.0])):
            told = float(np.min(swing[push > 0.0] / np.abs(moment[a, push > 0.0]), initial=np.inf))
        elif slopes.by_rate[a] != 0.0:
            told = float(np.max(rolling * np.abs(moment[a])))
        if told > 0.0:
            limits[a] = max(limit, told)
            continue
        limits[a] = min(limit, float(np.max(correction[push > 0.0] / push[push > 0.0], initial=0.0)) or limit)
        bears = (push > 0.0) & (borne > 0.0)
        limits[a] = min(limits[a], float(np.min(borne[bears] / push[bears], initial=np.inf)))
    limits[mechanism.nu :] = acceleration[prescribed]
    control = None if servos_of(dynamics).any() else np.zeros(dynamics.nu)
    if stance_error is not None or (control is not None and flies(mechanism)):
        control = np.zeros(dynamics.nu)
        control[: mechanism.nu] = quasi_static_controls(dynamics, goal)[: mechanism.nu]
    return np.maximum(1.0 / limits**2, MIN_EFFORT), control, known


def _limit(mechanism: Mechanism, a: int, servo: bool, gain: float) -> float:
    """Max magnitude of a control by the model's control and force limits; infinite without one."""
    actuators = mechanism.actuators
    low, high = actuators.control_range[a]
    found = [0.5 * (high - low) if servo else max(abs(low), abs(high))]
    if gain > 0.0:
        found.append(np.abs(actuators.force_range[a]).max() / gain)
        for i in np.flatnonzero(actuators.moment[a]):
            found.append(np.abs(mechanism.joint_force_range[i]).max() / (gain * abs(actuators.moment[a, i])))
    found = [one for one in found if 0.0 < one < np.inf]
    return float(min(found, default=np.inf))


def _tolerances(
    mechanism: Mechanism, usual: list[float], tolerance: float | Mapping[str, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Tolerances of positions (nv,) and velocities (nv,): as given, at most the default ones."""
    coordinates, asked, known = coordinates_of_mechanism(mechanism), np.array(usual), checked_tolerance(tolerance)
    for i, (name, unit) in enumerate(coordinates[: len(usual)]):
        kind = "velocity" if unit.endswith("/s") else "position"
        given = known.get(name, known.get(kind)) if isinstance(known, Mapping) else known
        if given is not None:
            asked[i] = min(asked[i], given)
    return asked[: mechanism.nv], asked[mechanism.nv :]


def servos_of(dynamics: RigidBodyDynamics) -> np.ndarray:
    """(nu,) whether the force of each control depends on the state: position and velocity servos."""
    found = np.zeros(dynamics.nu, dtype=bool)
    found[: dynamics.mechanism.nu] = dynamics.mechanism.actuators.depends_on_state
    return found
