"""Continuous-time dynamics dx/dt = f(x, u) of a machine, one state at a time, with exact partial derivatives.

A step of explicit Euler of length one is x + f(x, u), and its Jacobians are I + f_x and f_u: so what every machine has
already says all that Eq. 1 and Eq. 4 need.
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
