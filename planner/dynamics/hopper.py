"""HopperDynamics: the paper's hopping machine (section 2.4), compiled. x = (height, velocity, piston), u = flow."""

from __future__ import annotations

import numpy as np

from planner.base.arguments import array, choice, number
from planner.kernels.hopper import second as hopper_second
from planner.kernels.hopper import step as kernel
from planner.kernels.integrators import INTEGRATORS
from planner.kernels.lq.workspace import Workspace
from planner.kernels.numba.lanes import WIDTH, lane_array
from planner.model.capabilities import Capabilities


class HopperDynamics:
    """A mass on a pneumatic spring that can leave the ground, in inches and seconds.

    Args:
        dt: Length of a stage, s.
        integrator: One of INTEGRATORS.
        stiffness: k/m, 1/s^2 (the paper's 100).
        smoothing: alpha of section 2.4, the compression over which the spring engages, in.
        gravity: g, in/s^2 (the paper's 386.4).

    Raises:
        PlannerError: A parameter that is not finite or not positive.
    """

    nx = 3
    nu = 1
    coordinates = (("height", "in"), ("velocity of height", "in/s"), ("piston", "in"))
    structured, outputs = False, 0
    has_slopes = True
    capabilities = Capabilities(contacts=True, exact_hessian=True)
    has_ranges = False  # its compiled rollout has no cost of state ranges: solves with these use NumPy
    kernels = ("hopper search", "hopper linearize")
    second_order_kernels = ("hopper second order", "costates")

    def __init__(
        self, dt: float, integrator: str = "rk4", *, stiffness: float = 100.0, smoothing: float = 0.1,
        gravity: float = 386.4,
    ) -> None:  # fmt: skip
        self.dt = number("dt", dt, greater_than=0.0)
        self.integrator = choice("integrator", integrator, INTEGRATORS)
        self.stiffness = number("stiffness", stiffness, greater_than=0.0, maximum=1e9)
        self.smoothing = number("smoothing", smoothing, greater_than=0.0, maximum=1e9)
        self.gravity = number("gravity", gravity, greater_than=0.0, maximum=1e9)
        self._code = INTEGRATORS.index(self.integrator)
        self._parameters = np.array([self.stiffness, self.smoothing, self.gravity])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.integrator}, dt {self.dt:g})"

    def with_step(self, dt: float, integrator: str) -> HopperDynamics:
        """The same hopper with another length of a stage, s, and integrator."""
        return HopperDynamics(dt, integrator, stiffness=self.stiffness, smoothing=self.smoothing, gravity=self.gravity)

    def step(self, xs: np.ndarray, us: np.ndarray, dt: np.ndarray | None = None) -> np.ndarray:
        """The states (K, 3) after one stage from xs (K, 3) with us (K, 1); see Dynamics.step."""
        xs = array("xs", xs, ("K", 3), any_value=True)
        us = array("us", us, (len(xs), 1), any_value=True)
        dt = np.full(len(xs), self.dt) if dt is None else array("dt", dt, (len(xs),))
        ends = np.empty_like(xs)
        kernel.steps(self._code, self._parameters, xs, us, dt, ends)
        return ends

    def rates(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """dx/dt (K, 3) at xs (K, 3) with us (K, 1), section 2.4."""
        xs = array("xs", xs, ("K", 3), any_value=True)
        us = array("us", us, (len(xs), 1), any_value=True)
        rates = np.empty_like(xs)
        kernel.rates(self._parameters, xs, us, rates)
        return rates

    def linearize(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Exact A (N, 3, 3) and B (N, 3, 1) along xs (N+1, 3), us (N, 1)."""
        us = array("us", us, ("N", 1), any_value=True)
        xs = array("xs", xs, (len(us) + 1, 3), any_value=True)
        F = np.empty((len(us), 3, WIDTH))
        kernel.linearize_arrays(self._code, self.dt, self._parameters, xs, us, F, lane_array(7, WIDTH))
        return F[:, :, 1:4].copy(), F[:, :, :1].copy()

    def second_order(self, xs: np.ndarray, us: np.ndarray, costates: np.ndarray) -> np.ndarray:
        """T (N, 4, 4) = sum_k costate_k d2 f_k / dz2 with z = (x, u); see Dynamics.second_order.

        The spring force has a constant second derivative over the smoothing, zero elsewhere, with jumps between them.
        """
        us = array("us", us, ("N", 1), any_value=True)
        xs = array("xs", xs, (len(us) + 1, 3), any_value=True)
        costates = np.pad(array("costates", costates, xs.shape, any_value=True), ((0, 0), (WIDTH, WIDTH - 3)))
        T = np.zeros((len(us), 2 * WIDTH, 2 * WIDTH))
        hopper_second.second_order(self._code, self.dt, self._parameters, xs, us, costates, T)
        order = np.array([WIDTH, WIDTH + 1, WIDTH + 2, 0])
        return (np.triu(T) + np.triu(T, 1).swapaxes(1, 2))[:, order[:, None], order]

    def memory(self, N: int) -> None:
        """Scratch memory of a solve of N stages: none."""

    def second_order_memory(self) -> None:
        """Scratch memory of second_order_nominal: none."""

    def second_order_nominal(self, w: Workspace, memory: None, second: None) -> None:
        """Fill w.T along w.xs, w.us for w.costates."""
        hopper_second.second_order(self._code, self.dt, self._parameters, w.xs, w.us, w.costates, w.T)

    def linearize_nominal(self, w: Workspace, memory: None) -> None:
        """Fill w.F along w.xs, w.us."""
        kernel.linearize_nominal(self._code, self.dt, self._parameters, w.table)

    def stage_ends(self, w: Workspace, memory: None) -> np.ndarray:
        """The states (N, nx) after one stage from each of w.xs, w.us."""
        return self.step(w.xs[:-1], w.us)

    def search(
        self, w: Workspace, memory: None, rule: int, feedback: bool, cost: float, slope: float
    ) -> tuple[float, float]:
        """Line search from w.xs, w.us; see CompiledDynamics.search."""
        w.given[0], w.given[1] = cost, slope
        return kernel.search_step(self._code, self.dt, self._parameters, w.table, w.search, rule, feedback)
