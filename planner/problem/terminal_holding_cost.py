"""Final weights of a machine that stays at its goal: the cost-to-go of a finite time after the end.

Large final weights on positions and velocities make the gains vary strongly over the last stages, which amplifies
errors of the ground model. The cost-to-go of staying at the goal avoids this: with the weights Q, R of a stage and the
dynamics A, B linearized at the goal,

    P(T) = Q,    P(t) = Q + A'P A - A'P B (R + B'P B)^-1 B'P A

for each stage after the end gives the cost-to-go of a deviation at the end (Eq. 33), and the gains are those of a
machine at rest at the goal. The time is finite because the cost of uncontrollable directions (feet do not slide back)
grows with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.quasi_static import quasi_static_controls
from planner.problem.costs.tracking import TrackingCost

LARGEST = 1e12  # upper limit of the entries of P; above it the cost is returned unchanged


def terminal_holding_cost(dynamics: RigidBodyDynamics, cost: TrackingCost, seconds: Any) -> TrackingCost:
    """A cost whose final weights include the cost-to-go of staying at its goal for a time.

    The cost is unchanged if the cost-to-go of the linearized machine diverges.

    Args:
        dynamics: The machine, with actuators.
        cost: Its last reference is the goal; its last running weights are those of staying.
        seconds: Time at the goal, s, at least 0; 0 gives the cost itself.

    Raises:
        PlannerError: seconds is negative or no number.
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
    rounding = np.abs(np.diagonal(P)) < np.finfo(float).eps * np.abs(P).max()  # of where a wheel is
    P[rounding] = P[:, rounding] = 0.0
    return TrackingCost(
        np.concatenate([cost.Q[:-1], [cost.Q[-1] + P]]), cost.R, cost.x_ref, cost.u_ref, cost.space
    )  # fmt: skip
