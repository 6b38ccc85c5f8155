"""Weightlifting with a Puma: minimum effort from hanging to upright with a load in the hand (reference [20]).

The paper says of [20], Wang, Timoszyk and Bobrow: "we tripled the payload above the manufacturers specifications". A
slow lift must hold the load everywhere on its path, so the outstretched arm limits it; a swing need not.

    number              value    from
    arm                 a 560 of 1.25 m reach         ../mjcf/puma: a 762's inertias are not published
    rated payload       20 kg    the manufacturer's figure for the 762, whose reach is 1.25 m
    torque limits       the 560's (97.6, 186.4, 89.4, 24.2, 20.1, 21.3 N m: Armstrong, Khatib, Burdick 1986) times one
                        factor, 2.63     ours: it lets the motors just hold the rated payload along the straight lift
    payload             iron ball, its centre 0.22 m beyond the wrist       ours
    start, goal         hanging and upright, arm straight, at rest          ours: [20] has other poses
    t_f                 2.5 s    ours
    cost                1/2 sum of (torque over its limit)^2, integrated    the paper's effort, scaled per motor
    bounds              every torque within its limit, exactly              [20] has soft ones
    first guess         the straight lift with the elbow tucked in, by inverse dynamics     ours
    tolerance of goal   0.01     ours, rad and rad/s: see TOLERANCE

Limits of joint speeds, which [20] has, are an option (speed_limit): we do not know those of a 762, and without them a
swing is faster than the real arm. The model has no friction.

Heavy loads need a first guess near their lift: planner.paper.largest_payload approaches them from lighter ones.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.polynomial import Polynomial

from planner.base.arguments import choice, number
from planner.base.measured import Measurement, Section
from planner.cases.horizon import LARGEST, stages
from planner.cases.planar_arm import end_misses, ends_of
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.dynamics.algorithms import bias
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, model_path, model_text, written
from planner.model.twin import Twin
from planner.problem.appearance import Appearance, Panel, Readout
from planner.problem.costs.tracking import TrackingCost
from planner.problem.initial_guess import inverse_dynamics_controls, quintic
from planner.problem.limits import Limits
from planner.problem.problem import Problem, Requirements
from planner.problem.problem_parts import Recipe

if TYPE_CHECKING:
    from planner.proof.replays.replaying import Replay

Style = Literal["straight", "tucked", "swung", "swung-tucked"]
Torques = Literal["bounded", "free"]

RATED = 20.0  # kg, the manufacturer's figure for the Puma 762
LIGHTEST, HEAVIEST = 0.1, 1000.0  # kg, of a payload
IRON = 7870.0  # kg/m^3
JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_bend", "hand_roll")
PEAK_560 = np.array([97.6, 186.4, 89.4, 24.2, 20.1, 21.3])  # N m at the joints, Armstrong, Khatib, Burdick 1986

TOLERANCE = 0.01
"""rad and rad/s. At an optimum the miss times the final weight is the cost of one more radian: with a weight of 1e4
0.01 means 100 per rad, about a hundred times the cost of the whole lift. An impossible lift misses by far more."""

ROUNDING = 1e-12  # relative, of a torque at its limit

_BULGES: dict[str, dict[str, float]] = {  # rad, distance of a first guess from the straight lift, in its middle
    "straight": {}, "tucked": {"elbow": -2.0}, "swung": {"shoulder": -1.5},
    "swung-tucked": {"shoulder": -1.5, "elbow": 1.5},
}  # fmt: skip


def puma(
    payload: float = 60.0, duration: float = 2.5, horizon: int | None = None, integrator: str = "rk4",
    guess: Style = "tucked", rated: float = RATED,
    position_weight: float = 1e4, velocity_weight: float = 1e4, effort_weight: float = 1.0,
    wrist_weight: float = 0.05, torques: Torques = "bounded", speed_limit: float | None = None,
) -> Problem:  # fmt: skip
    """Lift a load with a Puma-like arm, from hanging to upright, with least effort of its motors.

    Args:
        payload: Mass in the hand, kg.
        duration: Duration t_f, s.
        horizon: Number of stages N; by default 100 a second.
        integrator: "euler", "semi-implicit-euler" or "rk4".
        guess: First controls, by inverse dynamics: "straight" (every joint smoothly along the straight line), "tucked"
            (elbow bent on the way), "swung" (back first), or "swung-tucked".
        rated: Payload, kg, that the torque limits can just hold everywhere along the straight lift.
        position_weight: Weight on the final |q - q_d|^2 / 2, q in rad.
        velocity_weight: Weight on the final |dq|^2 / 2, rad/s.
        effort_weight: Weight on |torque over its limit|^2 / 2, times dt.
        wrist_weight: Weight on |q|^2 / 2 of the three wrist joints on the way, rad, times dt, against winding up.
        torques: "bounded" (every motor within its limit) or "free" (the limits only scale the effort).
        speed_limit: Largest speed of every joint, rad/s; by default none.

    Raises:
        PlannerError: A parameter that is not finite or out of range.
    """
    payload, rated = (
        number(k, v, minimum=LIGHTEST, maximum=HEAVIEST) for k, v in (("payload", payload), ("rated", rated))
    )
    duration, N = stages(duration, horizon)
    mechanism = puma_mechanism(payload)
    limits = torque_limits(rated)
    dynamics = RigidBodyDynamics(mechanism, duration / N, choice("integrator", integrator, INTEGRATORS))
    weights = {
        "position_weight": number("position_weight", position_weight, minimum=0.0, maximum=LARGEST),
        "velocity_weight": number("velocity_weight", velocity_weight, minimum=0.0, maximum=LARGEST),
        "effort_weight": number("effort_weight", effort_weight, greater_than=0.0, maximum=LARGEST),
        "wrist_weight": number("wrist_weight", wrist_weight, minimum=0.0, maximum=LARGEST),
    }
    start, goal = mechanism.keyframe("start"), mechanism.keyframe("goal")
    cost = TrackingCost.joints(
        dynamics, goal, N, final_position=weights["position_weight"], final_velocity=weights["velocity_weight"],
        effort=weights["effort_weight"] / limits**2,
        position=dict.fromkeys(JOINTS[3:], weights["wrist_weight"]),
    )  # fmt: skip
    us = first_lift(mechanism, choice("guess", guess, get_args(Style)), duration, N)
    parameters: dict[str, Any] = {
        "payload": payload, "duration": duration, "horizon": N, "integrator": integrator, "guess": guess,
        "rated": rated, **weights, "torques": torques, "speed_limit": speed_limit,
    }  # fmt: skip
    bounds = (-limits, limits) if choice("torques", torques, get_args(Torques)) == "bounded" else None
    if speed_limit is not None:
        speed_limit = number("speed_limit", speed_limit, greater_than=0.0)
    limited = bounds is not None or speed_limit is not None
    return Problem(
        dynamics, cost, x0=start, us=us, twin=Twin.of(mechanism), appearance=_appearance(payload),
        recipe=Recipe("puma", parameters, puma),
        requirements=Requirements(goal=partial(judge_lift, goal=goal, limits=limits)),
        limits=Limits(control=bounds, velocity=speed_limit) if limited else None,
    )  # fmt: skip


def puma_mechanism(payload: float) -> Mechanism:
    """The arm with a payload in kg in its hand, read from the same text that the replay uses."""
    radius = ball_radius(payload)
    inertia = written(*[0.4 * payload * radius**2] * 3)
    edits = {
        ".//body[@name='payload']/inertial": {"mass": written(payload), "diaginertia": inertia},
        ".//geom[@name='payload']": {"size": written(radius)},
        ".//site[@name='target']": {"size": written(1.25 * radius)},
    }
    return Mechanism.from_mjcf(edited(model_text(model_path("puma") / "scene.xml"), edits))


def ball_radius(mass: float) -> float:
    """Radius of an iron ball of a mass in kg, m."""
    return float(np.cbrt(0.75 * mass / (np.pi * IRON)))


def straight_lift(poses: int = 721) -> np.ndarray:
    """Joint angles (poses, 6) of the slow lift along the straight line from start to goal, rad."""
    mechanism = puma_mechanism(RATED)
    start, goal = mechanism.keyframe("start")[:6], mechanism.keyframe("goal")[:6]
    return start + np.linspace(0.0, 1.0, poses)[:, None] * (goal - start)


def torque_limits(rated: float = RATED) -> np.ndarray:
    """Torque limits (6,), N m: those of the 560 times the factor for which the rated payload is lifted statically."""
    path = straight_lift()
    static = np.abs(bias(puma_mechanism(rated), path, np.zeros_like(path)))
    return PEAK_560 * float(np.max(static / PEAK_560))


def first_lift(mechanism: Mechanism, style: str, duration: float, N: int) -> np.ndarray:
    """Torques (N, 6) of the straight lift with a detour in its middle, by inverse dynamics."""
    q, qd, qdd = quintic(mechanism.keyframe("start")[:6], mechanism.keyframe("goal")[:6], duration, N)
    s = (np.arange(N)[:, None] + 0.5) / N
    bulge = Polynomial([0.0, 0.0, 0.0, 64.0, -192.0, 192.0, -64.0])  # (4 s (1 - s))^3: at rest at both ends
    size = np.array([_BULGES[style].get(joint, 0.0) for joint in JOINTS])
    return inverse_dynamics_controls(
        mechanism, q + bulge(s) * size, qd + bulge.deriv()(s) * size / duration,
        qdd + bulge.deriv(2)(s) * size / duration**2,
    )  # fmt: skip


def judge_lift(replay: Replay, goal: np.ndarray, limits: np.ndarray) -> Section:
    """Check that the arm ends at the goal (12,) at rest, and that no torque exceeds the limits (6,)."""
    why = "an impossible lift misses by far more"
    measured = []
    for (who, x), us in zip(ends_of(replay).items(), (replay.plan.us, replay.ctrl), strict=True):
        share = np.max(np.abs(us) / limits, axis=0)
        note = f"largest torque over its limit, at the {JOINTS[int(np.argmax(share))]}"
        measured += end_misses(who, x, goal, TOLERANCE, why)
        measured.append(Measurement(f"{who}_torque_share", float(share.max()), "", 1.0 + ROUNDING, note))
    return Section("goal", tuple(measured))


def _appearance(payload: float) -> Appearance:
    """Plan and replay side by side, the path of the payload, and a line at its goal."""
    arm, wrist = tuple(enumerate(JOINTS[:3])), tuple((i + 3, name) for i, name in enumerate(JOINTS[3:]))
    return Appearance(
        title=f"Puma-like arm lifts {payload:.3g} kg (rated {RATED:g})",
        readouts=(Readout("shoulder", 1, "rad"), Readout("elbow", 2, "rad"), Readout("wrist", 4, "rad")),
        ghost_offset=(-2.6, 0.0, 0.0), azimuth=90.0, elevation=-5.0, speed=0.5,
        goal_line=((-0.3, -0.217, 1.47), (0.3, -0.217, 1.47)), goal_label="goal", trail="tip",
        plots=(
            Panel("Arm", "angle, rad", states=arm),
            Panel("Wrist", "angle, rad", states=wrist),
            Panel("Motors of the arm", "torque, N m", controls=arm),
            Panel("Motors of the wrist", "torque, N m", controls=wrist),
        ),
    )  # fmt: skip
