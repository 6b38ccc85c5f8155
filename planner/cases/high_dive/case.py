"""High dive: somersaults and a twist in flight, from a tower to a straight vertical entry, hands first.

The paper mentions a human high dive (its ref. [16]) beside its four cases and gives no numbers: all of these are ours.
A diver of 10 bodies and 14 motors leaves the tower with a given angular momentum, which stays constant in flight
(dynamics.kinematics). By changing his moments of inertia he must turn the right number of times before he reaches the
water; unequal motions of the arms make the twist, because he takes off without one.

    number                  value    why (all ours)
    tower                   10 m     the highest of the Olympic ones
    take-off                straight, arms overhead, at 4 rad/s forward, no twist: a stiff body would turn 1.1 times
    t_f                     1.75 s   from the fall, until the hands touch the water
    goal                    1 1/2 somersaults, 1 twist, straight, hands first; joints at rest
    final weights           1e4 on angles of pelvis and joints, 1e2 on joint rates; none on the path of the fall
    effort_weight           0.01     on u^2 / 2, torque in N m
    posture, calm weights   20, 0.05: see POSTURE
    tolerance of goal       0.05     rad, and 0.5 rad/s of the joints: a straight line to the eye

At the entry he still turns at 4 rad/s, the rate of a straight body with this angular momentum.

flight.py describes how the first guess gets the number of turns.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.arguments import choice, number
from planner.base.errors import PlannerError
from planner.base.measured import Measurement, Section
from planner.cases.high_dive.flight import Dive, Diver, Weights
from planner.cases.horizon import LARGEST, stages
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.dynamics.kinematics import angular_momentum
from planner.model.space import conjugate, log_quaternion, product
from planner.model.twin import Twin
from planner.problem.appearance import Appearance, Panel, Readout
from planner.problem.problem import Problem, Requirements
from planner.problem.problem_parts import Recipe

if TYPE_CHECKING:
    from planner.model.mechanism import Mechanism
    from planner.proof.replays.replaying import Replay

POSTURE, CALM = 20.0, 0.05
"""Weights per s, with a factor 1/2: POSTURE on the squared distance of a joint from the middle of its range over half
the range, CALM on its squared rate, (rad/s)^2. Effort alone swings the limbs through the body, beyond the ranges of the
joints, and spins stretched arms about themselves; these weights keep every joint in its range. The posture weight grows
after take-off and fades before the entry, where the body must be straight."""

TOLERANCE, RATE_TOLERANCE = 0.05, 0.5  # rad, rad/s
DRIFT_BOUND = 1e-3  # of the angular momentum, relative
ENTRY = np.radians(10.0)  # success of a perturbed diver: largest angle from the vertical and of each joint
MAX_TURNS = 4.5


def high_dive(
    somersaults: float = 1.5, twists: float = 1.0, tower: float = 10.0, mass: float = 70.0, height: float = 1.75,
    take_off_speed: float = 3.0, forward_speed: float = 1.5, somersault_rate: float = 4.0,
    duration: float | None = None, horizon: int | None = None, integrator: str = "rk4", gravity: float = 9.81,
    final_weight: float = 1e4, rate_weight: float = 1e2, effort_weight: float = 0.01, posture_weight: float = POSTURE,
    calm_weight: float = CALM,
) -> Problem:  # fmt: skip
    """A diver's somersaults and twists from a tower to a straight vertical entry, with least effort.

    Args:
        somersaults: Turns over the head, a half more than a whole number: the hands come first; negative is backward.
        twists: Turns about the long axis, a multiple of a half; negative to the right.
        tower: Height of the platform above the water, m.
        mass: Mass of the diver, kg.
        height: Height of the diver, m.
        take_off_speed: Upward speed of the centre of mass at take-off, m/s.
        forward_speed: Speed of the centre of mass away from the tower at take-off, m/s.
        somersault_rate: Rate of the straight body at take-off, rad/s; it sets the angular momentum.
        duration: t_f, s; by default the time of the fall until the hands touch the water.
        horizon: Number of stages N; by default 120 a second.
        integrator: "euler", "semi-implicit-euler" or "rk4".
        gravity: g, m/s^2.
        final_weight: Weight on the squared final angles of pelvis and joints / 2.
        rate_weight: Weight on the squared final rates of the joints / 2.
        effort_weight: Weight on u^2 / 2, torque in N m, times dt.
        posture_weight: Weight on (angle - middle)^2 / 2 over half the joint's range squared, times dt.
        calm_weight: Weight on the squared rates of the joints on the way / 2, times dt.

    Raises:
        PlannerError: A parameter that is not finite or out of range.
    """
    diver = Diver(mass, height, tower, gravity)
    somersaults = _turns("somersaults", somersaults, 0.5, "a half more than a whole number")
    twists = _turns("twists", twists, 0.0, "a multiple of a half")
    up = number("take_off_speed", take_off_speed, minimum=0.0, maximum=LARGEST)
    ahead = number("forward_speed", forward_speed, minimum=-LARGEST, maximum=LARGEST)
    rate = number("somersault_rate", somersault_rate, minimum=0.0, maximum=1e3)
    duration, N = stages(diver.flight(up) if duration is None else duration, horizon, per_second=120.0)
    choice("integrator", integrator, INTEGRATORS)
    weights = Weights(
        number("final_weight", final_weight, minimum=0.0, maximum=LARGEST),
        number("rate_weight", rate_weight, minimum=0.0, maximum=LARGEST),
        number("effort_weight", effort_weight, greater_than=0.0, maximum=LARGEST),
        number("posture_weight", posture_weight, minimum=0.0, maximum=LARGEST),
        number("calm_weight", calm_weight, minimum=0.0, maximum=LARGEST),
    )
    signed = float(np.copysign(rate, somersaults))
    dive = Dive(diver, up, ahead, signed, duration, somersaults, twists, weights)
    dynamics = RigidBodyDynamics(diver.mechanism, duration / N, integrator)
    parameters: dict[str, Any] = {
        "somersaults": somersaults, "twists": twists, **asdict(diver), "take_off_speed": up, "forward_speed": ahead,
        "somersault_rate": rate, "duration": duration, "horizon": N, "integrator": integrator,
        **{f"{name}_weight": weight for name, weight in asdict(weights).items()},
    }  # fmt: skip
    return Problem(
        dynamics, dive.cost(dynamics, N), x0=dive.start, us=dive.first_controls(dynamics, N),
        twin=Twin.of(diver.mechanism), appearance=_appearance(dive), recipe=Recipe("high-dive", parameters, high_dive),
        requirements=Requirements(
            goal=partial(judge_entry, entry=dive.entry()), success=partial(enters, entry=dive.entry())
        ),
    )  # fmt: skip


def _turns(name: str, value: Any, beyond: float, expected: str) -> float:
    """The checked number of turns: `beyond` plus a whole number, or a multiple of a half where `beyond` is 0."""
    turns = number(name, value, minimum=-MAX_TURNS, maximum=MAX_TURNS)
    multiple = (turns - beyond) if beyond else 2.0 * turns
    if multiple != round(multiple):
        raise PlannerError(f"{name} is {turns:g}, expected {expected}.")
    return turns


def judge_entry(replay: Replay, entry: np.ndarray) -> Section:
    """Check that the plan and MuJoCo's replay enter straight and hands first, with a constant angular momentum."""
    mechanism = replay.plan.problem.dynamics.mechanism  # type: ignore[union-attr]
    measured = []
    for who, xs, whose in (("planned", replay.plan.xs, "the plan's"), ("replayed", replay.xs, "MuJoCo's")):
        turn, angle, rate = (float(values[0]) for values in misses(xs[-1:], entry))
        measured += [
            Measurement(f"{who}_turn_miss", turn, "rad", TOLERANCE, f"{whose} pelvis from its goal at the entry"),
            Measurement(f"{who}_joint_miss", angle, "rad", TOLERANCE, f"{whose} joints from straight, the largest"),
            Measurement(f"{who}_joint_rate", rate, "rad/s", RATE_TOLERANCE, f"{whose} joints from rest, the largest"),
            Measurement(f"{who}_momentum_drift", momentum_drift(mechanism, xs), "", DRIFT_BOUND,
                     f"largest change of {whose} angular momentum about the centre of mass, over that at take-off"),
        ]  # fmt: skip
    return Section("goal", tuple(measured))


def misses(xs: np.ndarray, entry: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances of states (K, nx) from the entry (nx,): turn of the pelvis, largest joint angle and rate; (K,) each."""
    nq = (len(entry) + 1) // 2
    turn = np.linalg.norm(log_quaternion(product(conjugate(entry[3:7]), xs[:, 3:7])), axis=1)
    angle = np.abs(xs[:, 7:nq] - entry[7:nq]).max(axis=1)
    return turn, angle, np.abs(xs[:, nq + 6 :] - entry[nq + 6 :]).max(axis=1)


def momentum_drift(mechanism: Mechanism, xs: np.ndarray) -> float:
    """Largest change of the angular momentum along states (K, nx), relative to its first value."""
    nq = mechanism.nq
    if not np.isfinite(xs).all():
        return float("inf")  # the replay diverged
    L = angular_momentum(mechanism, xs[:, :nq], xs[:, nq:])
    return float(np.linalg.norm(L - L[0], axis=1).max() / max(np.linalg.norm(L[0]), np.finfo(float).tiny))


def enters(ends: np.ndarray, entry: np.ndarray) -> np.ndarray:
    """Which of the perturbed ends (K, nx) are straight and vertical to 10 degrees, with any heading: (K,)."""
    down = rotated_up(ends[:, 3:7])[:, 2] < -np.cos(ENTRY)
    return down & (misses(ends, entry)[1] < ENTRY)


def rotated_up(quaternions: np.ndarray) -> np.ndarray:
    """Directions (K, 3) of the long axis of a body turned by quaternions (K, 4)."""
    up = np.array([0.0, 0.0, 0.0, 1.0])
    return product(product(quaternions, np.broadcast_to(up, quaternions.shape)), conjugate(quaternions))[:, 1:]


def _appearance(dive: Dive) -> Appearance:
    """The diver stays in the middle of the picture; tower and water move past him."""
    height, joints = dive.diver.height, dive.diver.mechanism.joint_names[1:]
    nq = dive.diver.mechanism.nq

    def curves(offset: int, *names: str) -> tuple[tuple[int, str], ...]:
        return tuple((offset + joints.index(name), name.replace("_", " ")) for name in names)

    arms = ("left_shoulder", "left_shoulder_side", "right_shoulder", "right_shoulder_side", "left_elbow", "right_elbow")
    legs = ("waist", "waist_side", "left_hip", "right_hip", "left_knee", "right_knee")
    return Appearance(
        title=f"High dive: somersaults {dive.somersaults:g}, twists {dive.twists:g}",
        readouts=(Readout("height of hips", 2, "m"), Readout("fall", nq + 2, "m/s")),
        accompany=(0, 1, 2), distance=4.5 * height, azimuth=90.0, elevation=-6.0, speed=0.5,
        plots=(
            Panel("Arms", "angle, rad", states=curves(7, *arms)),
            Panel("Trunk and legs", "angle, rad", states=curves(7, *legs)),
            Panel("Rates of the pelvis, its own axes", "rad/s",
                  states=tuple((nq + 3 + i, f"about {axis}") for i, axis in enumerate(("x ahead", "y left", "z up")))),
            Panel("Torques of arms", "torque, N m", controls=curves(0, *arms)),
            Panel("Torques of trunk and legs", "torque, N m", controls=curves(0, *legs)),
        ),
    )  # fmt: skip
