"""Case 1: minimum effort of a fully actuated planar arm of two links (section 2.1, Eq. 5, Fig. 3).

From horizontal and outstretched to upright in two seconds. In the paper's minimum the arm first swings down while the
forearm folds, then swings up.

    number              value    from
    start, goal         (0, 0), (pi/2, 0) at rest       paper, section 2.1
    t_f                 2 s      paper, section 2.1
    c1, c2              100      paper, section 2.1; Eq. 5 has no 1/2 on these terms, so with ours they are 200
    weight on |u|^2     1        paper, Eq. 5 (with its 1/2)
    first guess         q2 = 0, q1 smooth, by inverse dynamics     paper, section 2.1; a quintic is ours
    masses, lengths     0.5 kg, 1 m, uniform rods    ours, see planar_arm.py
    g                   9.81     ours: the paper has none
    N, integrator       100 a second, RK4     ours: the paper's is adaptive
    tolerance of goal   0.05     ours, rad and rad/s: see TOLERANCE

The paper's minimum has an effort of 9.9. From the paper's first guess SLQ ends in another local minimum, at 17.8; the
best of eight starts (`--starts 8`) has 5.5. There are many local minima; the paper calls its own one of them.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from planner.base.arguments import choice
from planner.cases.horizon import stages
from planner.cases.planar_arm import UPRIGHT, Links, arm_appearance, arm_cost, arm_dynamics
from planner.model.twin import Twin
from planner.problem.initial_guess import inverse_dynamics_controls, quintic
from planner.problem.problem import Problem
from planner.problem.problem_parts import Recipe

Guess = Literal["paper", "zero"]

TOLERANCE = 0.05
"""rad and rad/s. At an optimum the miss times the final weight is the effort that one more radian costs: the default
misses by 0.02 rad at a weight of 200, which is 4 per rad. Twice that, rounded up, leaves room for other guesses."""


def two_link(
    duration: float = 2.0, horizon: int | None = None, integrator: str = "rk4", guess: Guess = "paper",
    mass1: float = 0.5, mass2: float = 0.5, length1: float = 1.0, length2: float = 1.0, gravity: float = 9.81,
    position_weight: float = 200.0, velocity_weight: float = 200.0, effort_weight: float = 1.0,
) -> Problem:  # fmt: skip
    """The paper's arm of two links and two motors: from horizontal to upright with least effort.

    Args:
        duration: Duration t_f, s.
        horizon: Number of stages N; by default 100 a second.
        integrator: "euler", "semi-implicit-euler" or "rk4".
        guess: First controls: "paper" (forearm straight, upper arm smoothly up, by inverse dynamics) or "zero".
        mass1: Mass of the upper arm, kg.
        mass2: Mass of the forearm, kg.
        length1: Length of the upper arm, m.
        length2: Length of the forearm, m.
        gravity: g, m/s^2.
        position_weight: Weight on the final |q - q_d|^2 / 2, q in rad; twice the paper's c1 (Eq. 5 has no 1/2 there).
        velocity_weight: Weight on the final |dq|^2 / 2, rad/s; twice the paper's c2.
        effort_weight: Weight on |u|^2 / 2, torques in N m, times dt.

    Raises:
        PlannerError: A parameter that is not finite or out of range.
    """
    links = Links(mass1, mass2, length1, length2, gravity)
    duration, N = stages(duration, horizon)
    choice("guess", guess, get_args(Guess))
    dynamics = arm_dynamics("two_link", links, duration / N, integrator)
    cost = arm_cost(dynamics, N, position_weight, velocity_weight, effort_weight)
    us = (
        inverse_dynamics_controls(dynamics.mechanism, *quintic(np.zeros(2), UPRIGHT, duration, N))
        if guess == "paper"
        else None
    )
    parameters: dict[str, Any] = {
        "duration": duration, "horizon": N, "integrator": integrator, "guess": guess, **vars(links),
        "position_weight": float(position_weight), "velocity_weight": float(velocity_weight),
        "effort_weight": float(effort_weight),
    }  # fmt: skip
    return Problem(
        dynamics, cost, x0=np.zeros(4), us=us, twin=Twin.of(dynamics.mechanism),
        recipe=Recipe("two-link", parameters, two_link),
        appearance=arm_appearance("Two-link arm, to upright", links, ("shoulder", "elbow"), speed=0.5),
        tolerance=TOLERANCE,
    )  # fmt: skip
