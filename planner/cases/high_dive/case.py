"""High dive: somersaults and a twist in flight, from a tower to a straight vertical entry, hands first.

The paper names a human high dive (its ref. [16]) beside its four cases and gives no numbers: all of these are ours.
A diver of 10 bodies and 14 motors leaves the tower with a given angular momentum, which nothing he does can change
(dynamics.momentum); with what he does to his moments of inertia he must turn the right number of times in the time that
the fall leaves, and twist by moving his arms unequally, since he takes off without any twist.

    number                  value    why
    tower                   10 m     the highest of the Olympic ones
    take-off                straight, arms overhead, at 4 rad/s forward, no twist: a stiff body would turn 1.1 times
    t_f                     1.75 s   from the fall, until the hands touch the water
    goal                    1 1/2 somersaults, 1 twist, straight, hands first; joints at rest
    final weights           1e4 on angles of pelvis and joints, 1e2 on joint rates; none on what flies by itself
    effort_weight           0.01     on u^2 / 2, torque in N m
    posture, calm weights   20, 0.05: see POSTURE
    tolerance of goal       0.05     rad, and 0.5 rad/s of the joints: a straight line to the eye

He still turns when he enters: the angular momentum is there, and a straight body turns with it at 4 rad/s.

How the first guess gets the number of turns is told in dive.py.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.arguments import choice, count, number
from planner.base.errors import PlannerError
from planner.base.measured import Measured, Section
from planner.cases.high_dive.dive import Dive, Weights
from planner.cases.high_dive.diver import Diver
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.dynamics.momentum import angular_momentum
from planner.model.space import conjugate, log_quaternion, product
from planner.model.twin import Twin
from planner.problem.appearance import Appearance, Panel, Readout
from planner.problem.problem import Problem, Requirements
from planner.problem.recipe import Recipe

if TYPE_CHECKING:
    from planner.model.mechanism import Mechanism
    from planner.proof.replaying import Replay

POSTURE, CALM = 20.0, 0.05
"""Per s, weights with a factor 1/2: of a joint's distance from the middle of its range, over half that range, squared;
of its rate squared, (rad/s)^2. Effort alone swings the limbs like pendulums through the body, beyond what joints can,
and spins stretched arms about themselves; with these every joint stays in its range. The first fades in after take-off
and out before the entry, where the body is to be straight."""

TOLERANCE, RATE_TOLERANCE = 0.05, 0.5  # rad, rad/s
DRIFT_BOUND = 1e-3  # of the angular momentum, relative
ENTRY = np.radians(10.0)  # from the vertical, and of each joint: what counts as arrived for a perturbed diver
MOST_TURNS, MOST_STAGES, LARGEST = 4.5, 100_000, 1e6


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
        mass: Of the diver, kg.
        height: Of the diver, m.
        take_off_speed: Of the centre of mass upwards at take-off, m/s.
        forward_speed: The same, away from the tower.
        somersault_rate: Of the straight body at take-off, rad/s; with its inertia the angular momentum.
        duration: t_f, s; by default that of the fall, until the hands touch the water.
        horizon: N, stages; by default 120 a second.
        integrator: "euler", "semi-implicit-euler" or "rk4".
        gravity: g, m/s^2.
        final_weight: On the final angles of pelvis and joints, squared, times 1/2.
        rate_weight: On the final rates of the joints, squared, times 1/2.
        effort_weight: On u^2 / 2, torque in N m, times dt.
        posture_weight: On (angle - middle)^2 / 2 over half the joint's range squared, times dt.
        calm_weight: On the rates of the joints on the way, squared, times dt/2.

    Raises:
        PlannerError: A parameter that is not finite or out of range.
    """
    diver = Diver(mass, height, tower, gravity)
    somersaults = _turns("somersaults", somersaults, 0.5, "a half more than a whole number")
    twists = _turns("twists", twists, 0.0, "a multiple of a half")
    up = number("take_off_speed", take_off_speed, least=0.0, most=LARGEST)
    ahead = number("forward_speed", forward_speed, least=-LARGEST, most=LARGEST)
    rate = number("somersault_rate", somersault_rate, least=0.0, most=1e3)
    duration = diver.flight(up) if duration is None else number("duration", duration, above=0.0, most=1e3)
    N = max(1, round(120.0 * duration)) if horizon is None else count("horizon", horizon, most=MOST_STAGES)
    choice("integrator", integrator, INTEGRATORS)
    weights = Weights(
        number("final_weight", final_weight, least=0.0, most=LARGEST),
        number("rate_weight", rate_weight, least=0.0, most=LARGEST),
        number("effort_weight", effort_weight, above=0.0, most=LARGEST),
        number("posture_weight", posture_weight, least=0.0, most=LARGEST),
        number("calm_weight", calm_weight, least=0.0, most=LARGEST),
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
            goal=lambda replay: judge_entry(replay, dive.entry()), success=lambda ends: enters(ends, dive.entry())
        ),
    )  # fmt: skip


def _turns(name: str, value: Any, beyond: float, expected: str) -> float:
    """A checked number of turns: a multiple of a half, or of one after `beyond`."""
    turns = number(name, value, least=-MOST_TURNS, most=MOST_TURNS)
    multiple = (turns - beyond) if beyond else 2.0 * turns
    if multiple != round(multiple):
        raise PlannerError(f"{name} is {turns:g}, expected {expected}.")
    return turns


def judge_entry(replay: Replay, entry: np.ndarray) -> Section:
    """Whether the plan, and MuJoCo with it, enter straight and hands first, and whether the angular momentum stayed."""
    mechanism = replay.plan.problem.dynamics.mechanism  # type: ignore[union-attr]
    measured = []
    for who, xs, whose in (("planned", replay.plan.xs, "the plan's"), ("replayed", replay.xs, "MuJoCo's")):
        turn, angle, rate = (float(values[0]) for values in misses(xs[-1:], entry))
        measured += [
            Measured(f"{who}_turn_miss", turn, "rad", TOLERANCE, f"{whose} pelvis from where it should point at entry"),
            Measured(f"{who}_joint_miss", angle, "rad", TOLERANCE, f"{whose} joints from straight, the largest"),
            Measured(f"{who}_joint_rate", rate, "rad/s", RATE_TOLERANCE, f"{whose} joints from rest, the largest"),
            Measured(
                f"{who}_momentum_drift", momentum_drift(mechanism, xs), "", DRIFT_BOUND,
                f"largest change of {whose} angular momentum about the centre of mass, over what it was at take-off",
            ),
        ]  # fmt: skip
    return Section("goal", tuple(measured))


def misses(xs: np.ndarray, entry: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K,) each, of states (K, nx) from the entry: turn of the pelvis; largest joint angle and rate; rad, rad/s."""
    nq = (len(entry) + 1) // 2
    turn = np.linalg.norm(log_quaternion(product(conjugate(entry[3:7]), xs[:, 3:7])), axis=1)
    angle = np.abs(xs[:, 7:nq] - entry[7:nq]).max(axis=1)
    return turn, angle, np.abs(xs[:, nq + 6 :] - entry[nq + 6 :]).max(axis=1)


def momentum_drift(mechanism: Mechanism, xs: np.ndarray) -> float:
    """Largest change of the angular momentum along states (K, nx), relative to what it was at first."""
    nq = mechanism.nq
    if not np.isfinite(xs).all():
        return float("inf")  # the replay ran away
    L = angular_momentum(mechanism, xs[:, :nq], xs[:, nq:])
    return float(np.linalg.norm(L - L[0], axis=1).max() / max(np.linalg.norm(L[0]), np.finfo(float).tiny))


def enters(ends: np.ndarray, entry: np.ndarray) -> np.ndarray:
    """Whether perturbed ends (K, nx) are a straight vertical entry, to 10 degrees: (K,). The heading is not asked."""
    down = rotated_up(ends[:, 3:7])[:, 2] < -np.cos(ENTRY)
    return down & (misses(ends, entry)[1] < ENTRY)


def rotated_up(quaternions: np.ndarray) -> np.ndarray:
    """(K, 3) where the long axis of a body turned by quaternions (K, 4) points."""
    up = np.array([0.0, 0.0, 0.0, 1.0])
    return product(product(quaternions, np.broadcast_to(up, quaternions.shape)), conjugate(quaternions))[:, 1:]


def _appearance(dive: Dive) -> Appearance:
    """The diver in the middle of the picture, tower and water moving past him."""
    height, joints = dive.diver.height, dive.diver.mechanism.joint_names[1:]
    nq = dive.diver.mechanism.nq

    def curves(offset: int, *names: str) -> tuple[tuple[int, str], ...]:
        return tuple((offset + joints.index(name), name.replace("_", " ")) for name in names)

    arms = ("left_shoulder", "left_shoulder_side", "right_shoulder", "right_shoulder_side", "left_elbow", "right_elbow")
    legs = ("waist", "waist_side", "left_hip", "right_hip", "left_knee", "right_knee")
    return Appearance(
        title=f"High dive: somersaults {dive.somersaults:g}, twists {dive.twists:g}",
        readouts=(Readout("height of hips", 2, "m"), Readout("fall", nq + 2, "m/s")),
        accompany=(0, 1, 2),
        distance=4.5 * height,
        azimuth=90.0,
        elevation=-6.0,
        speed=0.5,
        plots=(
            Panel("Arms", "angle, rad", states=curves(7, *arms)),
            Panel("Trunk and legs", "angle, rad", states=curves(7, *legs)),
            Panel("Rates of the pelvis, its own axes", "rad/s",
                  states=tuple((nq + 3 + i, f"about {axis}") for i, axis in enumerate(("x ahead", "y left", "z up")))),
            Panel("Torques of arms", "torque, N m", controls=curves(0, *arms)),
            Panel("Torques of trunk and legs", "torque, N m", controls=curves(0, *legs)),
        ),
    )  # fmt: skip
