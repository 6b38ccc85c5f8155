"""What the end of a motion costs a machine that is to stay there: weights of the end as if the motion went on.

Final weights on positions and velocities alone ask for all that they can get of the last stages: gains change there
from one stage to the next, and where the ground is not quite the plan's they move what they should hold. The cost of
staying longer changes nothing: with the weights Q, R of a stage and the dynamics A, B linearized at the goal,

    P(T) = Q,    P(t) = Q + A'P A - A'P B (R + B'P B)^-1 B'P A

for each stage of the time that follows is what a deviation at the end will cost (Eq. 33), and the gains are those of a
machine that stands already. The time is finite, because what nothing reaches (feet do not slide back) costs more the
longer it lasts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.quasi_static import quasi_static_controls
from planner.problem.costs.tracking import TrackingCost

LARGEST = 1e12  # of a weight: more is of a goal from which the machine falls at once


def terminal_holding_cost(dynamics: RigidBodyDynamics, cost: TrackingCost, seconds: Any) -> TrackingCost:
    """A cost with what it costs to stay at its goal for so many seconds added to its final weights.

    Nothing is added for a goal at which the linearized machine runs away.

    Args:
        dynamics: The machine, with actuators.
        cost: Whose last reference is the goal, and whose last stage has the weights of staying.
        seconds: At least 0; 0 gives the cost itself.

    Raises:
        PlannerError: The seconds are less than 0 or no number.
    """
    stages = round(number("hold", seconds, minimum=0.0) / dynamics.dt)
    if not stages:
        return cost
    goal, u = cost.x_ref[-1], quasi_static_controls(dynamics, cost.x_ref[-1])
    A, B = (part[0] for part in dynamics.linearize(np.stack([goal, goal]), u[None]))
    Q, R = cost.Q[-2], cost.R[-1]
    P = Q
    with np.errstate(all="ignore"):
        for _ in range(stages):
            PA, PB = P @ A, P @ B
            H, S = R + B.T @ PB, B.T @ PA
            if not (np.isfinite(H).all() and np.abs(P).max() < LARGEST):
                return cost
            P = Q + A.T @ PA - S.T @ np.linalg.solve(H, S)
            P = 0.5 * (P + P.T)
    return TrackingCost(
        np.concatenate([cost.Q[:-1], [cost.Q[-1] + P]]), cost.R, cost.x_ref, cost.u_ref, cost.space
    )  # fmt: skip
