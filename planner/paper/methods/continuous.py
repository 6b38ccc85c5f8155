"""The continuous-time problem behind a Problem: dx/dt = f(x, u) and the running cost L.

    J = phi(x(t_f)) + integral of L(x, u) dt                            (Eq. 2)

A Problem's stage weights hold the factor dt (Eq. 8, 9); here they are divided by it. A step of explicit Euler of length
one is x + f(x, u), and its Jacobians are I + f_x and f_u: so any dynamics give all that Eq. 1 and Eq. 4 need.
"""

from __future__ import annotations

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics
from planner.kernels.integrators import EULER
from planner.kernels.numba.lanes import padded
from planner.kernels.precompile import announce_named, variant
from planner.kernels.tree import linearize as tree_linearize
from planner.kernels.tree import step as tree_step
from planner.kernels.tree.mechanism_table import Model
from planner.kernels.tree.memory import TreeMemory
from planner.model.space import space_of
from planner.paper.methods.adjoint import Partials
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


class ContinuousDynamics:
    """f of Eq. 1 and its partial derivatives, of dynamics of any integrator and stage whose states are plain vectors.

    Raises:
        PlannerError: Dynamics of another kind, a discrete map, or states with quaternions.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        self.nx, self.nu = int(dynamics.nx), int(dynamics.nu)
        if space_of(dynamics).quaternions:
            raise PlannerError("the states have quaternions, expected plain vectors: hinges and slides alone.")
        if isinstance(dynamics, RigidBodyDynamics):
            self._own = _Tree(dynamics)
        else:
            remake = getattr(dynamics, "with_step", None)
            if remake is None:
                raise PlannerError(
                    f"dynamics is {short_repr(dynamics)}, expected a machine with rates dx/dt = f(x, u)."
                )
            self._own = _Stepped(remake(1.0, "euler"))

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dx/dt (nx,) at x (nx,) with u (nu,)."""
        return self._own.rates(x, u)

    def partials(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f_x (nx, nx) and f_u (nx, nu)."""
        return self._own.partials(x, u)


class _Stepped:
    """By steps of explicit Euler of length one."""

    def __init__(self, dynamics: Dynamics) -> None:
        self._dynamics, self._eye = dynamics, np.eye(dynamics.nx)

    def rates(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        rates = getattr(self._dynamics, "rates", None)  # without the rounding of x + f - x, where there are any
        return (self._dynamics.step(x[None], u[None]) - x if rates is None else rates(x[None], u[None]))[0]

    def partials(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A, B = self._dynamics.linearize(np.stack([x, x]), u[None])
        return A[0] - self._eye, B[0]


class _Tree:
    """The same with the kernels' scratch kept: an integration asks for thousands of single states."""

    def __init__(self, dynamics: RigidBodyDynamics) -> None:
        mechanism = dynamics.mechanism
        driven = np.zeros(mechanism.nv, dtype=bool)
        for name in dynamics.prescribed:
            driven[mechanism.joint(name)] = True
        self._model = Model(mechanism, driven)
        self._memory, self._chained = TreeMemory(self._model, EULER, 0), TreeMemory(self._model, EULER, 1)
        self.nx, self.nu, self._first = dynamics.nx, dynamics.nu, padded(dynamics.nu)
        self._eye, self._one = np.eye(self.nx), np.ones(1)
        for name in ("tree rates", "tree steps", "tree dense"):
            announce_named(variant(name, self._model))

    def rates(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        out = np.empty((1, self.nx))
        tree_step.rates(self._model.table, self._memory.table, _row(x), _row(u), out, self._model.external)
        return out[0]

    def partials(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        m, r, xs, us = self._model.table, self._chained.table, _row(x), _row(u)
        F = np.empty((1, self.nx, self._first + padded(self.nx)))
        tree_step.steps(m, r, self._one, xs, us, np.empty_like(xs), True, self._model.external)
        tree_linearize.linearize_dense(m, r, 1.0, xs, us, F, self._model.external)
        return F[0, :, self._first : self._first + self.nx] - self._eye, F[0, :, : self.nu].copy()


def _row(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)[None]
