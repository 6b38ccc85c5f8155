"""Costs: J = phi(x(N)) + sum of L(x(n), u(n), n) (Eq. 9), and their quadratic models.

A factor 1/2 stands on every quadratic term, also on the control's: Eq. 11 as printed has none there, but Eq. 16
and 18 imply it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from planner.arguments import array, count, number
from planner.errors import PlannerError


class Quadratic(NamedTuple):
    """Hessians and gradients of the stage costs; the last of Q and q belong to the end."""

    Q: np.ndarray  # (N+1, nx, nx)
    q: np.ndarray  # (N+1, nx)
    R: np.ndarray  # (N, nu, nu)
    r: np.ndarray  # (N, nu)


class Cost(Protocol):
    """What a user's own cost must offer."""

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        ...

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradients and positive semidefinite Hessians (R positive definite) along a trajectory."""
        ...


def _weights(name: str, value: Any, stages: int, size: int) -> np.ndarray:
    """(stages, size, size) from a number, a diagonal (size,), a matrix, or one of these per stage."""
    given = _numbers(name, value)
    if given.ndim == 0:
        given = np.full(size, given)
    if given.ndim == 1:
        given = np.diag(array(name, given, (size,)))
    if given.ndim == 2 and given.shape == (stages, size) and stages != size:
        given = np.einsum("ni,ij->nij", given, np.eye(size))
    if given.ndim == 2:
        given = np.broadcast_to(given, (stages, *given.shape))
    return array(name, given, (stages, size, size))


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise PlannerError(f"{name} is {value!r}, expected numbers.") from None


def _references(name: str, value: Any, stages: int, size: int) -> np.ndarray:
    given = _numbers(name, value)
    if given.ndim <= 1:
        given = np.broadcast_to(given, (stages, size))
    return array(name, given, (stages, size))


class TrackingCost:
    """The paper's quadratic cost (Eq. 11, 12): 1/2 |x - x_ref|^2_Q + 1/2 |u - u_ref|^2_R, summed over the stages.

    Weights are per stage: what approximates an integral must hold the factor dt.

    Args:
        Q: (N+1, nx, nx) state weights, symmetric positive semidefinite; the last is the final one.
        R: (N, nu, nu) control weights, symmetric positive definite.
        x_ref: (N+1, nx), (nx,) or a number.
        u_ref: (N, nu), (nu,) or a number.

    Raises:
        PlannerError: A wrong shape, or a weight that is not symmetric or not (semi)definite.
    """

    def __init__(self, Q: Any, R: Any, x_ref: Any = 0.0, u_ref: Any = 0.0) -> None:
        self.Q, self.R = array("Q", Q, ("N+1", "nx", "nx")), array("R", R, ("N", "nu", "nu"))
        self.N, self.nx, self.nu = count("N, the number of stages in R", len(self.R)), self.Q.shape[1], self.R.shape[1]
        array("Q", self.Q, (self.N + 1, self.nx, self.nx))
        array("R", self.R, (self.N, self.nu, self.nu))
        self.x_ref = _references("x_ref", x_ref, self.N + 1, self.nx)
        self.u_ref = _references("u_ref", u_ref, self.N, self.nu)
        for name, weight in (("Q", self.Q), ("R", self.R)):
            if not np.allclose(weight, np.swapaxes(weight, 1, 2), rtol=1e-12, atol=0.0):
                raise PlannerError(f"{name} is not symmetric, expected symmetric weights.")
        smallest = np.linalg.eigvalsh(self.R).min()
        if smallest <= 0.0:
            raise PlannerError(f"R has the eigenvalue {smallest:.3g}, expected positive definite control weights.")
        largest = np.abs(self.Q).max()
        if np.linalg.eigvalsh(self.Q).min() < -1e-10 * largest:
            raise PlannerError("Q has a negative eigenvalue, expected positive semidefinite state weights.")
        for fixed in (self.Q, self.R, self.x_ref, self.u_ref):  # solves keep copies of their own
            fixed.flags.writeable = False

    @classmethod
    def reach(
        cls, goal: Any, horizon: int, *, final: Any, effort: Any, running: Any = 0.0, dt: float = 1.0,
        nu: int | None = None,
    ) -> TrackingCost:  # fmt: skip
        """Reach a goal state at the end with little effort.

        Args:
            goal: (nx,) the state to reach.
            horizon: N, number of stages.
            final: Weight at the end: a number, a diagonal (nx,) or a matrix (nx, nx).
            effort: Weight of the control: a number, a diagonal (nu,) or a matrix (nu, nu).
            running: Weight of the distance to the goal on the way.
            dt: s; the running and effort weights are multiplied by it.
            nu: Size of the control; needed when effort is a number and nu is not 1.
        """
        N = count("horizon", horizon)
        x_ref = array("goal", goal, ("nx",))
        number("dt", dt, above=0.0)
        nx = len(x_ref)
        size = nu if nu is not None else (np.asarray(effort).shape[0] if np.ndim(effort) else 1)
        Q = dt * _weights("running", running, N + 1, nx)
        Q[N] = _weights("final", final, 1, nx)[0]
        return cls(Q, dt * _weights("effort", effort, N, size), x_ref, 0.0)

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        ex, eu = xs - self.x_ref, us - self.u_ref
        state = np.einsum("ni,nij,nj->", ex, self.Q, ex)
        return 0.5 * float(state + np.einsum("ni,nij,nj->", eu, self.R, eu))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """The weights themselves, and q = Q (x - x_ref), r = R (u - u_ref)."""
        q = np.einsum("nij,nj->ni", self.Q, xs - self.x_ref)
        return Quadratic(self.Q, q, self.R, np.einsum("nij,nj->ni", self.R, us - self.u_ref))
