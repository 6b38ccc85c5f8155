"""Interfaces of dynamics: Dynamics, required of all, and CompiledDynamics, for compiled solves; rollouts of the first.

A rollout has the simulated states of open-loop controls or of feedback.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from planner.kernels.integrators import KNOWN_INTEGRATORS, Integrator
from planner.kernels.lq.workspace import Workspace
from planner.model.space import space_of


def integrator_of(dynamics: Any) -> Integrator:
    """What is known of the integrator of some dynamics, which may be discrete or Python of their own."""
    return KNOWN_INTEGRATORS.get(getattr(dynamics, "integrator", ""), Integrator(None))


class Dynamics(Protocol):
    """Discrete dynamics with a control that is constant over each stage.

    Optional attribute `space`, a StateSpace, for states with unit quaternions: A, B and a plan's gains then act on
    deviations (ndx,). Without it ndx = nx.

    Optional method with_step(dt, integrator): the same dynamics with another step or duration.

    Optional method second_order(xs, us, costates), for solve(hessian="exact"): with costates (N+1, ndx) of
    Eq. 16 the symmetric T (N, ndx+nu, ndx+nu) = sum_k costates[n+1, k] d2 f_k / dz2 in z = (x, u).

    Optional attribute `capabilities` (contacts, loops, friction, exact Hessians); without it the defaults of
    planner.model.capabilities.Capabilities apply.

    Attributes:
        nx: Size of the state.
        nu: Size of the control.
        dt: Length of a stage, s.
    """

    @property
    def nx(self) -> int: ...  # noqa: D102
    @property
    def nu(self) -> int: ...  # noqa: D102
    @property
    def dt(self) -> float: ...  # noqa: D102

    def step(self, xs: np.ndarray, us: np.ndarray, dt: np.ndarray | None = None) -> np.ndarray:
        """The states (K, nx) after one stage from xs (K, nx) with us (K, nu).

        Args:
            xs: (K, nx) initial states.
            us: (K, nu) controls.
            dt: (K,) s, lengths of partial stages; a whole stage by default.
        """
        ...

    def linearize(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) along xs (N+1, nx), us (N, nu).

        A dx + B du is the deviation of the next state for deviations dx of the state and du of the control.
        """
        ...


@runtime_checkable
class CompiledDynamics(Protocol):
    """Dynamics with compiled methods on a Workspace (see kernels).

    Attributes:
        structured: Whether F holds accelerations only (see Workspace).
        outputs: The number of the last state components that the next state does not depend on (see Workspace).
        has_slopes: Whether rollouts return the directional derivatives of the cost that the Wolfe rule needs.
        kernels: Names, in kernels.precompile, of the kernels used by linearize_nominal and search.
        second_order_kernels: Names of the kernels used by second_order_nominal.
        dt: Length of a stage, s.
    """

    @property
    def structured(self) -> bool: ...  # noqa: D102
    @property
    def outputs(self) -> int: ...  # noqa: D102
    @property
    def has_slopes(self) -> bool: ...  # noqa: D102
    @property
    def kernels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def second_order_kernels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def dt(self) -> float: ...  # noqa: D102

    def memory(self, N: int) -> Any:
        """Scratch memory of a solve of N stages, for linearize_nominal and search."""
        ...

    def linearize_nominal(self, w: Workspace, memory: Any) -> None:
        """Fill w.F along w.xs, w.us."""
        ...

    def stage_ends(self, w: Workspace, memory: Any) -> np.ndarray:
        """The states (N, nx) after one stage from each of w.xs, w.us; prepares linearize_nominal, as search does."""
        ...

    def search(
        self, w: Workspace, memory: Any, rule: int, feedback: bool, cost: float, slope: float
    ) -> tuple[float, float]:
        """Line search (see kernels.lq.line_search); updates w.xs, w.us; returns step length (0: none) and cost."""
        ...

    def second_order_memory(self) -> Any:
        """Scratch memory of second_order_nominal; PlannerError if the dynamics have no second derivatives."""
        ...

    def second_order_nominal(self, w: Workspace, memory: Any, second: Any) -> None:
        """Fill w.T along w.xs, w.us for w.costates; after linearize_nominal."""
        ...


@runtime_checkable
class ResidualDynamics(CompiledDynamics, Protocol):
    """Compiled dynamics of a mechanism that support cost residuals in the line search and the backward sweep.

    Attributes:
        mechanism: The mechanism to which the cost terms must refer.
    """

    @property
    def mechanism(self) -> Any: ...  # noqa: D102

    def residual_kernels(self, solids: bool | None) -> tuple[str, ...]:
        """Names of the kernels used with residuals, in place of `kernels`; `solids` as in the residual table."""
        ...

    def residuals(self, measures: Any) -> Any:
        """Kernel table of a planner.problem.costs.residual_arrays.ResidualArrays, for Workspace.use_residuals."""
        ...

    def quadratize_nominal(self, w: Workspace, memory: Any) -> None:
        """Add the residuals' gradients along w.xs to w.l, and store their Hessians for the backward sweep."""
        ...


Control = Callable[[int, np.ndarray], np.ndarray]  # (stage, state (nx,)) -> control (nu,)


def rollout(
    dynamics: Dynamics, x0: np.ndarray, us: np.ndarray, control: Control | None = None, *,
    bounds: Any = None, limit: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """States (N+1, nx) and controls (N, nu) of a trajectory from x0 (nx,).

    Args:
        dynamics: Any dynamics.
        x0: (nx,) initial state.
        us: (N, nu) controls.
        control: Feedback law that replaces us.
        bounds: The ControlBounds that clip each control; None for none.
        limit: Magnitude of a state component at which the rollout ends: the states from there on are NaN, the
            controls unchanged.
    """
    xs, us = np.full((len(us) + 1, dynamics.nx), np.nan), us.copy()
    xs[0] = x0
    for n in range(len(us)):
        if control is not None:
            us[n] = control(n, xs[n])
        if bounds is not None:
            us[n] = bounds.clip(n, us[n], xs[n])
        x = dynamics.step(xs[n : n + 1], us[n : n + 1])[0]
        if not np.all(np.abs(x) < limit):
            break
        xs[n + 1] = x
    return xs, us


def rollout_states(dynamics: Dynamics, x0: np.ndarray, us: np.ndarray) -> np.ndarray:
    """The states (N+1, nx) of controls (N, nu) from x0 (nx,); NaN from the first that is not finite."""
    return rollout(dynamics, x0, us)[0]


def feedback_control(dynamics: Dynamics, xs: np.ndarray, us: np.ndarray, K: np.ndarray) -> Control:
    """Feedback law u = us[n] + K[n] (x - xs[n]) of states (N+1, nx), controls (N, nu) and gains (N, nu, ndx)."""
    space = space_of(dynamics)
    return lambda n, x: us[n] + K[n] @ space.difference(x, xs[n])
