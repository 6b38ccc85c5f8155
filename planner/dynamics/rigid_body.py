"""RigidBodyDynamics: a Mechanism, discretised. The rates are Fig. 2's, the Jacobians exact."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from planner.arguments import array, choice, number
from planner.dynamics.protocol import INTEGRATORS
from planner.errors import PlannerError
from planner.kernels import tree_linearize, tree_solve, tree_step
from planner.kernels.jit import announce
from planner.kernels.lanes import padded
from planner.kernels.model import Model
from planner.kernels.tree_memory import SEMI_IMPLICIT_EULER, TreeMemory
from planner.kernels.workspace import Workspace
from planner.mechanism import Mechanism
from planner.space import StateSpace


class RigidBodyDynamics:
    """Discrete dynamics of a mechanism: x = (qpos, qvel, act), u = the controls, then prescribed accelerations.

    Args:
        mechanism: The machine.
        dt: Length of a stage, s.
        integrator: "euler", "semi-implicit-euler" (velocity first, as MuJoCo's Euler) or "rk4".
        prescribed: Names of joints whose accelerations are inputs (the paper's Cases 2 and 3); their actuators do
            nothing.

    Raises:
        PlannerError: dt is not positive, no such integrator or joint, or nothing drives the mechanism.
    """

    def __init__(
        self, mechanism: Mechanism, dt: float, integrator: str = "rk4", prescribed: Collection[str] = ()
    ) -> None:
        if not isinstance(mechanism, Mechanism):
            raise PlannerError(f"mechanism is {mechanism!r}, expected a Mechanism.")
        self.mechanism, self.dt = mechanism, number("dt", dt, above=0.0)
        self.integrator = choice("integrator", integrator, INTEGRATORS)
        if not isinstance(prescribed, (str, Collection)):
            raise PlannerError(f"prescribed is {prescribed!r}, expected names of joints.")
        self.prescribed = (prescribed,) if isinstance(prescribed, str) else tuple(prescribed)
        driven = np.zeros(mechanism.nv, dtype=bool)
        for name in self.prescribed:
            driven[mechanism.joint(name)] = True
        self.space: StateSpace = mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx
        self._model = Model(mechanism, driven)
        self.nu = self._model.nu
        if self.nu == 0:
            raise PlannerError("the model has no actuators, expected at least one <actuator> or a prescribed joint.")
        self._code = INTEGRATORS.index(self.integrator)
        self.structured = self._code == SEMI_IMPLICIT_EULER and mechanism.na == 0
        self.has_slopes = False

    def _checked(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        us = array("us", us, ("K", self.nu), any_value=True)
        return array("xs", xs, (len(us), self.nx), any_value=True), us

    def step(self, xs: np.ndarray, us: np.ndarray, dt: np.ndarray | None = None) -> np.ndarray:
        """The ends (K, nx) of K stages from xs (K, nx) with us (K, nu); see Dynamics.step."""
        xs, us = self._checked(xs, us)
        lengths = np.full(len(xs), self.dt) if dt is None else array("dt", dt, (len(xs),))
        announce(tree_step.steps)
        ends = np.empty_like(xs)
        memory = TreeMemory(self._model, self._code, 0, linearizing=False)
        tree_step.steps(self._model.table, memory.table, lengths, xs, us, ends)
        return ends

    def rates(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """The rates (qvel, qacc, d act/dt), (K, 2 nv + na), at xs (K, nx) with us (K, nu)."""
        xs, us = self._checked(xs, us)
        announce(tree_step.rates)
        out = np.empty((len(xs), self.ndx))
        memory = TreeMemory(self._model, self._code, 0, linearizing=False)
        tree_step.rates(self._model.table, memory.table, xs, us, out)
        return out

    def linearize(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) along xs (N+1, nx), us (N, nu), exact (Eq. 35)."""
        xs, us = self._checked(np.asarray(xs)[: len(us)], us)
        announce(tree_linearize.linearize_arrays)
        first = padded(self.nu)
        F = np.empty((len(us), self.ndx, first + padded(self.ndx)))
        memory = TreeMemory(self._model, self._code, 0)
        tree_linearize.linearize_arrays(self._model.table, memory.table, self.dt, xs, us, F)
        return F[:, :, first : first + self.ndx].copy(), F[:, :, : self.nu].copy()

    def memory(self, N: int) -> TreeMemory:
        """Scratch of one solve of N stages."""
        return TreeMemory(self._model, self._code, N)

    def start(self, w: Workspace, memory: TreeMemory) -> float:
        """Roll out w.us from w.xs[0]; the cost."""
        announce(tree_solve.iterate)
        return tree_solve.start(w.table, self._model.table, memory.table, w.search, self.dt)

    def iterate(
        self, w: Workspace, memory: TreeMemory, rule: int, feedback: bool, mu: float, fresh: bool, cost: float,
        gradient_tolerance: float, decrease_tolerance: float,
    ) -> int:  # fmt: skip
        """One SLQ iteration; the outcome, with row OUT of w.search filled."""
        return tree_solve.iterate(
            w.table, self._model.table, memory.table, w.search, self.dt, rule, feedback, mu, fresh, cost,
            gradient_tolerance, decrease_tolerance,
        )  # fmt: skip
