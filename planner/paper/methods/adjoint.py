"""The paper's gradient for direct methods on differential equations (section 2.2, Eq. 7).

    minimize   J(P) = phi(z(t_f), w(t_f)) + integral of L(z, w) dt     w(t) = D(t) P, a spline and its derivatives
    subject to dz/dt = f(z, w),  z(0) = z0                              (Eq. 1, 2)

The states are integrated forward together with J, the costate backward, and the gradient with it:

    dlambda/dt = -H_z = -(L_z + f_z' lambda),   lambda(t_f) = phi_z     (Eq. 4)
    dJ/dP = phi_w D(t_f) + integral of (L_w + lambda' f_w) D dt         (Eq. 7; phi_w: the end may depend on w)

Both integrations are adaptive (scipy's solve_ivp) to a tolerance. The states of the backward one are interpolated from
the forward one. So the gradient is that of the exact J up to errors of the order of the tolerance, and it is not the
gradient of the J that was computed: what the paper calls its numerical problem.

ContinuousProblem has f and L of a Problem, whose stage weights hold the factor dt (Eq. 8, 9): they are divided by it. A
step of explicit Euler of length one is x + f(x, u), and its Jacobians are I + f_x and f_u: so any dynamics give all
that Eq. 1 and Eq. 4 need.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from planner.base.arguments import array, choice, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.kernels.numba.lanes import padded
from planner.kernels.precompile import announce_named, variant
from planner.kernels.tree import linearize as tree_linearize
from planner.kernels.tree import step as tree_step
from planner.kernels.tree.mechanism_table import Model
from planner.kernels.tree.memory import TreeMemory
from planner.model.space import space_of
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


METHODS = ("RK45", "DOP853")  # of solve_ivp; RK45 is the pair of Matlab's ode45
TIGHTEST = 3e-14  # solve_ivp refuses relative tolerances below 100 units of rounding


@dataclass(frozen=True)
class Integration:
    """Adaptive rule of the integrations of states and costates.

    Attributes:
        tolerance: Relative and absolute. Large ones spoil the gradient near convergence.
        method: "RK45" (Matlab's ode45) or "DOP853".

    Raises:
        PlannerError: A value out of range.
    """

    tolerance: float = 1e-6
    method: str = "RK45"

    def __post_init__(self) -> None:
        number("tolerance", self.tolerance, minimum=TIGHTEST, maximum=1.0)
        choice("method", self.method, METHODS)

    @property
    def options(self) -> dict[str, Any]:
        """For scipy's solve_ivp."""
        return {"rtol": self.tolerance, "atol": self.tolerance, "method": self.method}


class Partials(NamedTuple):
    """Derivatives of f and L at one z, w."""

    f_z: np.ndarray  # (nz, nz)
    f_w: np.ndarray  # (nz, nw)
    L_z: np.ndarray  # (nz,)
    L_w: np.ndarray  # (nw,)


class System(Protocol):
    """Dynamics and cost of states z and inputs w = (b P, b' P, b'' P), the first `orders` of these, (inputs,) each."""

    nz: int
    inputs: int
    orders: int

    def rates(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, float]:
        """dz/dt (nz,) and L."""
        ...

    def partials(self, z: np.ndarray, w: np.ndarray) -> Partials:
        """Derivatives of both."""
        ...

    def final(self, z: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Phi, and its derivatives by z (nz,) and w (nw,)."""
        ...


class AdjointCost:
    """J of amplitudes and its gradient by Eq. 7, from the state z0 (nz,) at t = 0; by default by RK45 to 1e-6."""

    def __init__(self, system: System, basis: BSpline, z0: np.ndarray, integration: Integration | None = None) -> None:
        self._system, self._end, self._options = system, float(basis.t[-1]), (integration or Integration()).options
        self._z0 = array("z0", z0, (system.nz,))
        self._derivatives = [basis.derivative(order) for order in range(system.orders)]

    def _D(self, t: float) -> np.ndarray:
        """D(t), (orders, n)."""
        return np.array([b(t) for b in self._derivatives])

    def inputs(self, t: float, P: np.ndarray) -> np.ndarray:
        """W (orders inputs,) at one time, s."""
        return (self._D(t) @ P).ravel()

    def forward(self, P: np.ndarray, times: np.ndarray | None = None) -> Any:
        """solve_ivp's answer for (z, integral of L), with interpolation; at times (M,) where given."""
        from scipy.integrate import solve_ivp

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            zd, L = self._system.rates(y[:-1], self.inputs(t, P))
            return np.append(zd, L)

        y0 = np.append(self._z0, 0.0)
        return solve_ivp(rates, (0.0, self._end), y0, dense_output=True, t_eval=times, **self._options)

    def __call__(self, amplitudes: np.ndarray) -> tuple[float, np.ndarray]:
        """J of amplitudes, (n, inputs) or in a row, infinite where states run away; and its gradient in their shape."""
        from scipy.integrate import solve_ivp

        system, P = self._system, amplitudes.reshape(-1, self._system.inputs)
        nz, shape = system.nz, (system.orders, system.inputs)
        states = self.forward(P)
        if not states.success or not np.all(np.isfinite(states.y)):
            return np.inf, np.zeros_like(amplitudes)
        last = states.y[:, -1]
        phi, phi_z, phi_w = system.final(last[:-1], self.inputs(self._end, P))
        J = float(phi + last[-1])
        if not np.isfinite(J):
            return J, np.zeros_like(amplitudes)
        direct = self._D(self._end).T @ phi_w.reshape(shape)

        def backward(t: float, y: np.ndarray) -> np.ndarray:
            D, costate = self._D(t), y[:nz]
            p = system.partials(states.sol(t)[:-1], (D @ P).ravel())
            H_z = p.L_z + costate @ p.f_z  # Eq. 3
            H_w = p.L_w + costate @ p.f_w
            return np.concatenate([-H_z, -(D.T @ H_w.reshape(shape)).ravel()])  # Eq. 4, 7

        end = np.concatenate([phi_z, direct.ravel()])
        found = solve_ivp(backward, (self._end, 0.0), end, **self._options)
        return J, found.y[nz:, -1].reshape(amplitudes.shape)


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
        self._memory, self._chained = (TreeMemory(self._model, KNOWN_INTEGRATORS["euler"], N) for N in (0, 1))
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
