"""The two faces of a machine: Dynamics, which every machine has, and CompiledDynamics, which fast ones have too."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from planner.kernels.integrators import INTEGRATORS
from planner.kernels.lq.workspace import Workspace

__all__ = ["INTEGRATORS", "CompiledDynamics", "Dynamics", "ResidualDynamics"]


class Dynamics(Protocol):
    """Discrete dynamics with a control that is held over each stage.

    States that are not plain vectors (orientations as unit quaternions) come with one more attribute, `space`, a
    StateSpace: then A, B and a plan's gains act on its deviations, ndx numbers. Without it ndx is nx.

    For a finer step, or another duration, they have one more method, with_step(dt, integrator).

    For solve(hessian="exact") they have one more method, second_order(xs, us, costates): with costates (N+1, ndx) of
    Eq. 16 the symmetric T (N, ndx+nu, ndx+nu) = sum_k costates[n+1, k] d2 f_k / dz2 in z = (x, u).

    What a machine has (contacts, loops, friction, exact Hessians) is in one more attribute, `capabilities`; without it
    the defaults of planner.model.capabilities.Capabilities hold.

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
        """The ends (K, nx) of K stages from xs (K, nx) with us (K, nu).

        Args:
            xs: (K, nx).
            us: (K, nu).
            dt: (K,) s, for parts of a stage; a whole stage by default.
        """
        ...

    def linearize(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) along xs (N+1, nx), us (N, nu).

        The deviation of the end of a stage is A dx + B du for a deviation dx of its start and du of the control.
        """
        ...


@runtime_checkable
class CompiledDynamics(Protocol):
    """Dynamics that work on a Workspace (see kernels).

    Attributes:
        structured: Whether F holds accelerations only (see Workspace).
        has_slopes: Whether rollouts give the slopes that the Wolfe rule needs.
        kernels: Names in kernels.precompile of the kernels that it calls.
        second_order_kernels: Those that second_order_nominal calls.
        dt: Length of a stage, s.
    """

    @property
    def structured(self) -> bool: ...  # noqa: D102
    @property
    def has_slopes(self) -> bool: ...  # noqa: D102
    @property
    def kernels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def second_order_kernels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def dt(self) -> float: ...  # noqa: D102

    def memory(self, N: int) -> Any:
        """Scratch of one solve of N stages, for linearize_nominal and search."""
        ...

    def linearize_nominal(self, w: Workspace, memory: Any) -> None:
        """Fill w.F along w.xs, w.us."""
        ...

    def stage_ends(self, w: Workspace, memory: Any) -> np.ndarray:
        """The ends (N, nx) of the stages from w.xs, w.us; linearize_nominal may follow, as after a search."""
        ...

    def search(
        self, w: Workspace, memory: Any, rule: int, feedback: bool, cost: float, slope: float
    ) -> tuple[float, float]:
        """Line search (see kernels.lq.line_search) from w.xs, w.us; takes the step there; (step or 0, cost after)."""
        ...

    def second_order_memory(self) -> Any:
        """Scratch of second_order_nominal. Raises PlannerError where there are no second-order terms."""
        ...

    def second_order_nominal(self, w: Workspace, memory: Any, second: Any) -> None:
        """Fill w.T along w.xs, w.us for w.costates; after linearize_nominal."""
        ...


@runtime_checkable
class ResidualDynamics(CompiledDynamics, Protocol):
    """Compiled dynamics of a mechanism, whose search and sweep can have residuals in them.

    Attributes:
        mechanism: That the terms must be of.
    """

    @property
    def mechanism(self) -> Any: ...  # noqa: D102

    def residual_kernels(self, solids: bool | None) -> tuple[str, ...]:
        """Kernels that it calls then in place of `kernels`; `solids` as the table of residuals has it."""
        ...

    def residuals(self, measures: Any) -> Any:
        """The kernels' table of planner.problem.costs.residuals.arrays.ResidualArrays, for Workspace.use_residuals."""
        ...

    def quadratize_nominal(self, w: Workspace, memory: Any) -> None:
        """Add the residuals' gradients along w.xs to w.l, and leave their Hessians for the sweep."""
        ...
