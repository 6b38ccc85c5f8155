"""The continuous-time problem behind a Problem: dx/dt = f(x, u) and the running cost whose sum over stages it is.

    J = phi(x(t_f)) + integral of L(x, u) dt                            (Eq. 2)

A Problem's stage weights hold the factor dt (Eq. 8, 9); here it is taken out again.
"""

from __future__ import annotations

import numpy as np

from planner.base.errors import PlannerError
from planner.paper.methods.adjoint import Partials
from planner.paper.methods.continuous_dynamics import ContinuousDynamics
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem


class ContinuousProblem:
    """f, L and phi of a Problem with constant weights on the way, for Eq. 1 to 4; its input is the control.

    Raises:
        PlannerError: A cost that is not a TrackingCost, one whose weights or references change on the way, or
            dynamics without rates.
    """

    orders = 1  # the control alone is the input, without derivatives

    def __init__(self, problem: Problem) -> None:
        cost = problem.cost
        if not isinstance(cost, TrackingCost):
            raise PlannerError(f"the cost is a {type(cost).__name__}, expected a TrackingCost.")
        for name, values in (("Q", cost.Q[:-1]), ("R", cost.R), ("x_ref", cost.x_ref[:-1]), ("u_ref", cost.u_ref)):
            if np.ptp(values, axis=0).max(initial=0.0) > 0.0:
                raise PlannerError(f"{name} changes on the way, expected the same at every stage.")
        dt = problem.dynamics.dt
        self.f = ContinuousDynamics(problem.dynamics)
        self.nz, self.inputs = self.f.nx, self.f.nu
        self.x0, self.duration = problem.x0, problem.duration
        self.Q, self.R = cost.Q[0] / dt, cost.R[0] / dt  # (nx, nx), (nu, nu) weights on the way, per second
        self.x_ref, self.u_ref = cost.x_ref[0], cost.u_ref[0]
        self._Q_end, self._x_end = cost.Q[-1], cost.x_ref[-1]

    def rates(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, float]:
        """dx/dt (nx,) and L."""
        ex, eu = z - self.x_ref, w - self.u_ref
        return self.f(z, w), 0.5 * float(ex @ self.Q @ ex + eu @ self.R @ eu)

    def partials(self, z: np.ndarray, w: np.ndarray) -> Partials:
        """Derivatives of both."""
        f_x, f_u = self.f.partials(z, w)
        return Partials(f_x, f_u, self.Q @ (z - self.x_ref), self.R @ (w - self.u_ref))

    def final(self, z: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Phi, and its derivatives by x (nx,) and by u, which are zero."""
        miss = z - self._x_end
        return 0.5 * float(miss @ self._Q_end @ miss), self._Q_end @ miss, np.zeros(len(w))
