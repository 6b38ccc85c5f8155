"""The paper's gradient for direct methods on differential equations (section 2.2, Eq. 7).

    minimize   J(P) = phi(z(t_f), w(t_f)) + integral of L(z, w) dt     w(t) = D(t) P, a spline and its derivatives
    subject to dz/dt = f(z, w),  z(0) = z0                              (Eq. 1, 2)

The states are integrated forward together with J, the costate backward, and the gradient with it:

    dlambda/dt = -H_z = -(L_z + f_z' lambda),   lambda(t_f) = phi_z     (Eq. 4)
    dJ/dP = phi_w D(t_f) + integral of (L_w + lambda' f_w) D dt         (Eq. 7; phi_w: the end may depend on w)

Both integrations are adaptive (scipy's solve_ivp) to a tolerance. The states of the backward one are interpolated from
the forward one. So the gradient is that of the exact J up to errors of the order of the tolerance, and it is not the
gradient of the J that was computed: what the paper calls its numerical problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from planner.base.arguments import array, choice, number

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

    def __call__(self, P: np.ndarray) -> tuple[float, np.ndarray]:
        """J of amplitudes (n, inputs), infinite where the states run away, and its gradient (n, inputs)."""
        from scipy.integrate import solve_ivp

        system = self._system
        nz, shape = system.nz, (system.orders, system.inputs)
        states = self.forward(P)
        if not states.success or not np.all(np.isfinite(states.y)):
            return np.inf, np.zeros_like(P)
        last = states.y[:, -1]
        phi, phi_z, phi_w = system.final(last[:-1], self.inputs(self._end, P))
        J = float(phi + last[-1])
        if not np.isfinite(J):
            return J, np.zeros_like(P)
        direct = self._D(self._end).T @ phi_w.reshape(shape)

        def backward(t: float, y: np.ndarray) -> np.ndarray:
            D, costate = self._D(t), y[:nz]
            p = system.partials(states.sol(t)[:-1], (D @ P).ravel())
            H_z = p.L_z + costate @ p.f_z  # Eq. 3
            H_w = p.L_w + costate @ p.f_w
            return np.concatenate([-H_z, -(D.T @ H_w.reshape(shape)).ravel()])  # Eq. 4, 7

        end = np.concatenate([phi_z, direct.ravel()])
        found = solve_ivp(backward, (self._end, 0.0), end, **self._options)
        return J, found.y[nz:, -1].reshape(P.shape)
