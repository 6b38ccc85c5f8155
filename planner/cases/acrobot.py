"""Case 2: swing-up of an underactuated arm, the acrobot (section 2.2, Fig. 4).

The arm of case 1 with the motor of its shoulder disconnected: the elbow pumps energy into the swing until the arm
stands upright.

    number              value    from
    start               q1 = -1.0, at rest              paper, section 2.2
    start "hanging"     q1 = -pi/2, at rest             paper, section 2.2, its first problem
    goal                (pi/2, 0) at rest               paper, sections 2.1 and 2.2
    c1, c2              100      paper, section 2.2 (the objective of Eq. 5): 200 with our factor 1/2
    weight on u^2       1        paper, Eq. 5 (with its 1/2)
    first guess         the elbow held, so that the arm falls like a rigid pendulum     paper, section 2.2
    guess from hanging  u = 0.5 sin(2 pi t)    ours: with the elbow held, or with u = 0, the arm does not move
    t_f                 3 s; from hanging 4 s    ours: the paper has none
    masses, lengths     0.5 kg, 1 m, uniform rods    ours: those of case 1
    g                   9.81     ours: the paper has none
    N, integrator       100 a second, RK4     ours: explicit Euler adds energy, and the plan exploits it
    tolerance of goal   0.1      ours, rad and rad/s: see TOLERANCE

There are many local minima, and small changes decide which one SLQ finds. It reaches a cost of 2.1 at 100 stages a
second and 6.6 at 50 from the paper's guess, 12.5 and 6.6 from u = 0.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from planner.base.arguments import choice
from planner.cases.horizon import stages
from planner.cases.planar_arm import Links, arm_appearance, arm_cost, arm_dynamics
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.dynamics.protocol import rollout_states
from planner.model.mechanism import Mechanism
from planner.model.twin import Twin
from planner.problem.problem import Problem
from planner.problem.problem_parts import Recipe

Start = Literal["paper", "hanging"]
Guess = Literal["paper", "zero", "sine"]

TOLERANCE = 0.1
"""rad and rad/s. At an optimum the miss times the final weight is the effort that one more radian costs. Without a
motor at the shoulder the last radian can cost 15 (at total costs of 3.4, from hanging, and 6.6): a miss of 0.08 rad at
a weight of 200."""


def acrobot(
    start: Start = "paper", duration: float | None = None, horizon: int | None = None, integrator: str = "rk4",
    guess: Guess | None = None,
    mass1: float = 0.5, mass2: float = 0.5, length1: float = 1.0, length2: float = 1.0, gravity: float = 9.81,
    position_weight: float = 200.0, velocity_weight: float = 200.0, effort_weight: float = 1.0,
) -> Problem:  # fmt: skip
    """The paper's arm without a motor at the shoulder (Spong's acrobot): swing up with the elbow alone.

    Args:
        start: "paper" (q1 = -1.0 rad) or "hanging" (q1 = -pi/2), both at rest.
        duration: t_f, s; by default 3, from hanging 4.
        horizon: Number of stages N; by default 100 a second.
        integrator: "euler", "semi-implicit-euler" or "rk4".
        guess: First controls: "paper" (the elbow held, by inverse dynamics), "zero" or "sine" (0.5 sin(2 pi t) N m);
            by default "paper", from hanging "sine".
        mass1: Mass of the upper arm, kg.
        mass2: Mass of the forearm, kg.
        length1: Length of the upper arm, m.
        length2: Length of the forearm, m.
        gravity: g, m/s^2.
        position_weight: Weight on the final |q - q_d|^2 / 2, q in rad; twice the paper's c1 (Eq. 5 has no 1/2 there).
        velocity_weight: Weight on the final |dq|^2 / 2, rad/s; twice the paper's c2.
        effort_weight: Weight on u^2 / 2, torque in N m, times dt.

    Raises:
        PlannerError: A parameter that is not finite or out of range.
    """
    hanging = choice("start", start, get_args(Start)) == "hanging"
    links = Links(mass1, mass2, length1, length2, gravity)
    duration, N = stages((4.0 if hanging else 3.0) if duration is None else duration, horizon)
    dynamics = arm_dynamics("acrobot", links, duration / N, integrator)
    cost = arm_cost(dynamics, N, position_weight, velocity_weight, effort_weight)
    first = choice("guess", guess or ("sine" if hanging else "paper"), get_args(Guess))
    x0 = dynamics.mechanism.keyframe("hanging" if hanging else "start")
    parameters: dict[str, Any] = {
        "start": start, "duration": duration, "horizon": N, "integrator": integrator, "guess": first,
        **vars(links),
        "position_weight": float(position_weight), "velocity_weight": float(velocity_weight),
        "effort_weight": float(effort_weight),
    }  # fmt: skip
    return Problem(
        dynamics, cost, x0=x0, us=_first_controls(first, dynamics, x0, N), twin=Twin.of(dynamics.mechanism),
        recipe=Recipe("acrobot", parameters, acrobot),
        appearance=arm_appearance("Acrobot, to upright", links, ("elbow",), speed=0.5),
        tolerance=TOLERANCE,
    )  # fmt: skip


def _first_controls(guess: str, dynamics: RigidBodyDynamics, x0: np.ndarray, N: int) -> np.ndarray:
    t = dynamics.dt * np.arange(N)[:, None]
    if guess == "paper":
        return _still_elbow_torques(dynamics.mechanism, x0, dynamics.dt, N)
    return 0.5 * np.sin(2.0 * np.pi * t) if guess == "sine" else 0.0 * t


def _still_elbow_torques(mechanism: Mechanism, x0: np.ndarray, dt: float, N: int) -> np.ndarray:
    """Elbow torques (N, 1) for which the arm falls like a rigid pendulum, computed in the middle of each stage."""
    held = RigidBodyDynamics(mechanism, dt, prescribed=("elbow",))
    us = np.zeros((N, held.nu))
    middle = held.step(rollout_states(held, x0, us)[:-1], us, np.full(N, 0.5 * dt))
    q, qd = middle[:, :2], middle[:, 2:]
    return rnea(mechanism, q, qd, held.rates(middle, us)[:, 2:])[:, 1:]
