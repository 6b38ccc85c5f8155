"""RigidBodyDynamics: discrete dynamics of a Mechanism by the recursions of Fig. 2, with exact Jacobians."""

from __future__ import annotations

import math
from collections.abc import Collection
from threading import local
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.second_thread import SolveMemory
from planner.kernels.integrators import KNOWN_INTEGRATORS, LEAPFROG, ROSENBROCK, SEMI_IMPLICIT_EULER
from planner.kernels.lq.workspace import Workspace
from planner.kernels.numba.lanes import padded
from planner.kernels.precompile import announce_named, variant
from planner.kernels.tree import linearize as tree_linearize
from planner.kernels.tree import step as tree_step
from planner.kernels.tree import tree_line_search as tree_search
from planner.kernels.tree import tree_second_order as tree_second
from planner.kernels.tree.mechanism_table import Model
from planner.kernels.tree.memory import TreeMemory
from planner.kernels.tree.residuals.evaluate import quadratize_residuals
from planner.kernels.tree.residuals.motor_work import works
from planner.kernels.tree.residuals.table import ResidualTable
from planner.model.capabilities import Capabilities
from planner.model.mechanism import Mechanism
from planner.model.passive_forces import damped_implicitly, damped_later
from planner.model.space import StateSpace

MAX_SUBSTEPS = 16  # largest number in a stage; shorter stages should replace more
ROUNDING = 1e-9  # relative tolerance of a ratio of lengths


class RigidBodyDynamics:
    """Discrete dynamics of a mechanism: x = (qpos, qvel, act), u = the controls, then prescribed accelerations.

    Args:
        mechanism: The machine.
        dt: Length of a stage, s.
        integrator: "euler", "semi-implicit-euler" (velocity first, as MuJoCo's Euler), "rk4", "leapfrog", with
            one evaluation a step (kernels.tree.leapfrog), or with implicit damping, for damping too stiff
            for RK4, "rosenbrock", of second order (kernels.tree.rosenbrock), and "implicitfast", of first order,
            MuJoCo's, for damping of single joints.
        prescribed: Names of joints whose accelerations are inputs (the paper's Cases 2 and 3); their actuators have
            no effect.
        substeps: Equal integration steps of a stage, 1 to 16, of "rk4", "leapfrog" and "rosenbrock", for stability (see
            planner.dynamics.step_stability). The control is constant over all of them.

    Raises:
        PlannerError: dt is not positive, the integrator or a joint is unknown, there is no control, an Euler integrator
            or "implicitfast" has substeps, a prescribed joint is coupled, "rosenbrock" or "leapfrog" with closed
            chains, or "implicitfast" or "leapfrog" with damping that couples joints.
    """

    def __init__(
        self, mechanism: Mechanism, dt: float, integrator: str = "rk4", prescribed: Collection[str] = (),
        substeps: int = 1,
    ) -> None:  # fmt: skip
        if not isinstance(mechanism, Mechanism):
            raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism.")
        mechanism = mechanism.without_lead_stops() if prescribed else mechanism
        self.mechanism, self.dt = mechanism, number("dt", dt, greater_than=0.0)
        self.integrator = choice("integrator", integrator, KNOWN_INTEGRATORS)
        self.substeps = count("substeps", substeps, maximum=MAX_SUBSTEPS)
        known = KNOWN_INTEGRATORS[self.integrator]
        if self.substeps > 1 and not known.has_substeps:
            able = " or ".join(f'"{name}"' for name, one in KNOWN_INTEGRATORS.items() if one.has_substeps)
            raise PlannerError(
                f"substeps is {self.substeps} and the integrator {self.integrator!r}, expected integrator = "
                f"{able}, or substeps = 1."
            )
        if not isinstance(prescribed, (str, Collection)):
            raise PlannerError(f"prescribed is {short_repr(prescribed)}, expected names of joints.")
        self.prescribed = (prescribed,) if isinstance(prescribed, str) else tuple(prescribed)
        self.space: StateSpace = mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx
        self._one_stage = np.full(1, self.dt)
        self._known, self._heavier = known, (known.implicit and known.form != ROSENBROCK) or known.form == LEAPFROG
        self._make_tables()
        self.nu = self._model.nu
        if self.nu == 0:
            raise PlannerError("the model has no actuators, expected at least one <actuator> or a prescribed joint.")
        self.structured = known.form == SEMI_IMPLICIT_EULER and mechanism.na == 0
        self.outputs, self.has_slopes = 0, False
        self.dense_kernels = tuple(variant(name, self._model) for name in ("tree search", "tree dense"))
        search, dense = self.dense_kernels
        self.kernels = (search, variant("tree structured", self._model) if self.structured else dense)
        self.second_order_kernels = ("tree second order", "costates")

    def _make_tables(self) -> None:
        """Create the kernel table of the mechanism, and thread-local storage for scratch memory."""
        driven = np.zeros(self.mechanism.nv, dtype=bool)
        for name in self.prescribed:
            driven[self.mechanism.joint(name)] = True
        for coupling in self.mechanism.couplings:
            if np.any(driven[list(coupling.dofs)]):
                names = " and ".join(sorted({self.mechanism.joint_of(dof) for dof in coupling.dofs}))
                raise PlannerError(
                    f"{coupling.name} couples {names} and one of them is prescribed, expected prescribed joints that "
                    "no equality couples."
                )
        implicit = self._known.form in (ROSENBROCK, LEAPFROG)
        if implicit and self.mechanism.has_closed_chains:
            raise PlannerError(
                f'the integrator "{self.integrator}" keeps no closed chains and this machine has some, expected "rk4", '
                "or less damping."
            )
        self._driven, self._steps = driven, local()
        self._model = self._model_of(self.dt)
        self.capabilities = Capabilities.of_mechanism(self.mechanism, driven, exact_hessian=not implicit)

    def _model_of(self, h: float) -> Model:
        """The kernel table for steps of h s."""
        return Model(self.stepped_mechanism(h), self._driven, implicit=self._known.form == ROSENBROCK)

    def stepped_mechanism(self, h: float) -> Mechanism:
        """The mechanism whose accelerations are those of steps of a stage of h s, with its damping in its armatures."""
        if self._known.form == LEAPFROG:
            return damped_later(self.mechanism, 0.5 * h / self.substeps)
        return damped_implicitly(self.mechanism, h) if self._heavier else self.mechanism

    def __getstate__(self) -> dict[str, Any]:
        """All attributes but the tables, whose addresses are valid in this process only."""
        return {name: part for name, part in vars(self).items() if name not in ("_model", "_steps")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_tables()

    def __repr__(self) -> str:
        n = len(self.mechanism.joint_names)
        joints = "1 joint" if n == 1 else f"{n} joints"
        substeps = "" if self.substeps == 1 else f" in {self.substeps} substeps"
        return f"{type(self).__name__}({joints}, {self.integrator}, dt {self.dt:g}{substeps})"

    def with_step(self, dt: float, integrator: str) -> RigidBodyDynamics:
        """The same machine with another length of a stage, s, and integrator; substeps become no longer.

        Raises:
            PlannerError: A subclass does not override with_step, or the stage needs more than 16 substeps.
        """
        if type(self) is not RigidBodyDynamics:  # its constructor may differ
            raise PlannerError(
                f"the dynamics are of the type {type(self).__name__}, expected RigidBodyDynamics, or a class with "
                "with_step(dt, integrator) of its own."
            )
        substeps = 1
        able = integrator in KNOWN_INTEGRATORS and KNOWN_INTEGRATORS[integrator].has_substeps
        if self.substeps > 1 and able:
            substeps = max(math.ceil(self.substeps * dt / self.dt - ROUNDING), 1)
            if substeps > MAX_SUBSTEPS:
                raise PlannerError(
                    f"a stage of {dt:.4g} s needs {substeps} substeps as long as those of {self.dt:.4g} s, expected at "
                    f"most {MAX_SUBSTEPS}: stages of at most {MAX_SUBSTEPS * self.dt / self.substeps:.4g} s."
                )
        return RigidBodyDynamics(self.mechanism, dt, integrator, self.prescribed, substeps)

    def with_mechanism(self, mechanism: Mechanism) -> RigidBodyDynamics:
        """The same stages and prescribed joints of another mechanism."""
        return RigidBodyDynamics(mechanism, self.dt, self.integrator, self.prescribed, self.substeps)

    def _checked(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ready = _are_floats(xs) and _are_floats(us) and us.ndim == 2
        if ready and us.shape[1] == self.nu and xs.shape == (len(us), self.nx):
            return xs, us  # without the copies that take as long as a step
        us = array("us", us, ("K", self.nu), any_value=True)
        return array("xs", xs, (len(us), self.nx), any_value=True), us

    def step(self, xs: np.ndarray, us: np.ndarray, dt: np.ndarray | None = None) -> np.ndarray:
        """The states (K, nx) after one stage from xs (K, nx) with us (K, nu); see Dynamics.step."""
        xs, us = self._checked(xs, us)
        if dt is None:
            lengths = self._one_stage if len(xs) == 1 else np.full(len(xs), self.dt)
        else:
            lengths = array("dt", dt, (len(xs),))
        announce_named(variant("tree steps", self._model))
        ends, memory = np.empty_like(xs), self._scratch()
        if dt is not None and self._heavier:  # partial stages, each with the armatures of its length
            shares, group = np.unique(np.round(lengths / self.dt, 10), return_inverse=True)
            for k, share in enumerate(shares):
                m, rows = self._model_of(share * self.dt), group == k
                some = np.empty_like(xs[rows])
                tree_step.steps(m.table, memory.table, lengths[rows], xs[rows], us[rows], some, False, m.external)
                ends[rows] = some
            return ends
        tree_step.steps(self._model.table, memory.table, lengths, xs, us, ends, False, self._model.external)
        return ends

    def _scratch(self) -> TreeMemory:
        """Scratch memory of single steps, one per thread, since allocation takes longer than a step."""
        if not hasattr(self._steps, "memory"):
            self._steps.memory = TreeMemory(self._model, self._known, 0, False, self.substeps)
        return self._steps.memory

    def rates(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """State derivatives (qvel, qacc, d act/dt), (K, 2 nv + na), at xs (K, nx) with us (K, nu)."""
        xs, us = self._checked(xs, us)
        announce_named(variant("tree rates", self._model))
        out, memory = np.empty((len(xs), self.ndx)), self._scratch()
        m = self._model_of(0.0) if self._heavier else self._model
        tree_step.rates(m.table, memory.table, xs, us, out, m.external)
        return out

    def linearize(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) along xs (N+1, nx), us (N, nu), exact (Eq. 35)."""
        xs, us = self._checked(np.asarray(xs)[: len(us)], us)
        announce_named(variant("tree steps", self._model))
        N, m, memory = len(us), self._model.table, self.memory(len(us))
        tree_step.steps(m, memory.table, np.full(N, self.dt), xs, us, np.empty_like(xs), True, self._model.external)
        if self.structured:
            F, transport = self._derivative_rows(N, self.mechanism.nv), np.zeros((N, len(self.space.quaternions), 18))
            tree_linearize.linearize_structured(m, memory.table, self.dt, xs, us, F, transport, self._model.external)
            by_u, by_x = self._blocks(F)
            return self._semi_implicit(by_x, by_u, transport)
        B, A = self.linearize_dense(xs, us, memory)
        return A.copy(), B.copy()

    def linearize_dense(self, xs: np.ndarray, us: np.ndarray, memory: TreeMemory) -> tuple[np.ndarray, np.ndarray]:
        """B (N, ndx, nu) and A (N, ndx, ndx) along states and controls whose accelerations are in the memory."""
        F = self._derivative_rows(len(us), self.ndx)
        tree_linearize.linearize_dense(self._model.table, memory.table, self.dt, xs, us, F, self._model.external)
        return self._blocks(F)

    def _derivative_rows(self, N: int, rows: int) -> np.ndarray:
        return np.empty((N, rows, padded(self.nu) + padded(self.ndx)))

    def _blocks(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The columns of u and of x."""
        first = padded(self.nu)
        return F[:, :, : self.nu], F[:, :, first : first + self.ndx]

    def second_order(self, xs: np.ndarray, us: np.ndarray, costates: np.ndarray) -> np.ndarray:
        """T (N, ndx+nu, ndx+nu) = sum_k costate_k d2 f_k / dz2 with z = (x, u), exact; see Dynamics.second_order.

        Raises:
            PlannerError: No second derivatives, e.g. a ball or free joint; see second_order_memory.
        """
        xs, us = self._checked(np.asarray(xs)[: len(us)], us)
        N, ndx, first = len(us), self.ndx, padded(self.nu)
        padding = ((0, 0), (first, padded(ndx) - ndx))
        costates = np.pad(array("costates", costates, (N + 1, ndx)), padding)
        T, memory, second = np.zeros((N, *[first + padded(ndx)] * 2)), self.memory(N), self.second_order_memory()
        m, external = self._model.table, self._model.external
        tree_step.steps(m, memory.table, np.full(N, self.dt), xs, us, np.empty_like(xs), True, external)
        tree_second.second_order(m, memory.table, second.table, self.dt, xs, us, costates, T)
        order = np.r_[first : first + ndx, : self.nu]
        return (np.triu(T) + np.triu(T, 1).swapaxes(1, 2))[:, order[:, None], order]

    def _semi_implicit(
        self, by_x: np.ndarray, by_u: np.ndarray, transport: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A and B from the derivatives of the accelerations; dq+ = T dq + dt J dv+, both 1 except for quaternions."""
        nv = self.mechanism.nv
        T, J = (np.tile(np.eye(nv), (len(transport), 1, 1)) for _ in range(2))
        for b, (_, i) in enumerate(self.space.quaternions):
            T[:, i : i + 3, i : i + 3] = transport[:, b, :9].reshape(-1, 3, 3)
            J[:, i : i + 3, i : i + 3] = transport[:, b, 9:].reshape(-1, 3, 3)
        rate, rate_by_u = self.dt * by_x, self.dt * by_u
        rate[:, :, nv:] += np.eye(nv)
        place = self.dt * (J @ rate)
        place[:, :, :nv] += T
        A = np.concatenate([place, rate], axis=1)
        return A, np.concatenate([self.dt * (J @ rate_by_u), rate_by_u], axis=1)

    def memory(self, N: int, appended: int = 0) -> SolveMemory:
        """Scratch memory of a solve of N stages, of states with `appended` components behind the machine's own."""
        return SolveMemory(self._model, self._known, N, substeps=self.substeps, appended=appended)

    def second_order_memory(self) -> tree_second.SecondOrderMemory:
        """Scratch memory of second_order_nominal; PlannerError for features without second derivatives."""
        m, of = self.mechanism, "has no second derivatives of"
        refusals = (
            (self.substeps > 1, f"{of} substeps and a stage has {self.substeps}"),
            (self._known.form in (ROSENBROCK, LEAPFROG), f'{of} the integrator "{self.integrator}"'),
            (self.space.quaternions, "is for machines of hinges and slides and this one has a ball or free joint"),
            (m.contacts or m.body_contacts or m.stops, f"{of} contacts and stops and this machine has some"),
            *((True, f"{of} coupled joints and this machine has {coupling.name}") for coupling in m.couplings),
            (m.has_closed_chains, f"{of} closed chains and this machine has some"),
            (m.curves, f"{of} exponential torques and this machine has some"),
            (
                self._model.external,
                f"{of} friction loss, tendons, gravity compensation, drag, actuators at sites and force laws, and this "
                "machine has some",
            ),
        )
        for applies, reason in refusals:
            if applies:
                stages = f", or stages of dt = {self.dt / self.substeps:.3g} and substeps=1"
                instead = stages if self.substeps > 1 else ""
                raise PlannerError(f'hessian="exact" {reason}, expected hessian="gauss-newton"{instead}.')
        return tree_second.SecondOrderMemory(self._model, self._known)

    def linearize_nominal(self, w: Workspace, memory: SolveMemory) -> None:
        """Fill w.F along w.xs, w.us."""
        m, external, dt = self._model.table, self._model.external, self.dt

        def part(first: int, end: int) -> None:
            r = memory.table_of(first)
            xs, us, F = w.xs[first:], w.us[first:end], w.F[first:end]
            if self.structured:
                tree_linearize.linearize_structured(m, r, dt, xs, us, F, w.transport[first:end], external)
            else:
                tree_linearize.linearize_dense(m, r, dt, xs, us, F, external)

        memory.in_halves("linearize", part, len(w.us))

    def stage_ends(self, w: Workspace, memory: SolveMemory) -> np.ndarray:
        """The states (N, nx) after one stage from each of w.xs, w.us; prepares linearize_nominal."""
        announce_named(variant("tree steps", self._model))
        lengths, ends, m = np.full(len(w.us), self.dt), np.empty_like(w.xs[:-1]), self._model

        def part(first: int, end: int) -> None:
            stages, r = slice(first, end), memory.table_of(first)
            tree_step.steps(m.table, r, lengths[stages], w.xs[stages], w.us[stages], ends[stages], True, m.external)

        memory.in_halves("steps", part, len(w.us))
        return ends

    def search(
        self, w: Workspace, memory: TreeMemory, rule: int, feedback: bool, cost: float, slope: float
    ) -> tuple[float, float]:
        """Line search from w.xs, w.us; see CompiledDynamics.search."""
        w.given[0], w.given[1], w.given[2] = cost, slope, self.dt
        residuals = None if w.residuals is None else w.residuals.table
        model, external = self._model.table, self._model.external
        solids = None if w.residuals is None else w.residuals.solids
        return tree_search.search_step(
            w.table, model, memory.table, w.search, rule, feedback, external, residuals, solids
        )  # fmt: skip

    def residual_kernels(self, solids: bool | None) -> tuple[str, ...]:
        """Names of the kernels used with residuals; `solids`: whether some are distances of two solids."""
        search, residuals = variant("tree search", self._model, True), "residuals"
        names = (f"{search} solids", f"{residuals} solids") if solids else (search, residuals)
        return names[0], *self.kernels[1:], names[1]

    def take(self, w: Workspace, memory: TreeMemory, lane: int) -> None:
        """Make candidate `lane` of a rejected line search the nominal trajectory."""
        w.take(lane)
        memory.take(lane)

    def nominal_jacobians(self, w: Workspace) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) of Eq. 35, from the last linearize_nominal."""
        by_u, by_x = w.F[:, :, : self.nu], w.F[:, :, w.first : w.first + self.ndx]
        if self.structured:
            return self._semi_implicit(by_x, by_u, w.transport)
        return by_x, by_u

    def residuals(self, measures: Any) -> ResidualTable:
        """Kernel table of the cost residuals in a problem.costs.residual_arrays.ResidualArrays."""
        return ResidualTable(self._model, measures)

    def quadratize_nominal(self, w: Workspace, memory: TreeMemory) -> None:
        """Add the residuals' gradients along w.xs to w.l, and store their Hessians for the backward sweep."""
        quadratize_residuals(w.table, self._model.table, memory.table, w.residuals.table, w.residuals.solids)

    def works_nominal(self, w: Workspace, memory: TreeMemory, found: np.ndarray) -> None:
        """The work of each motor in each stage along w.xs, w.us into found (N, nu), J; w has a cost of work."""
        works(w.table, self._model.table, memory.table, w.residuals.table, found)

    def second_order_nominal(self, w: Workspace, memory: TreeMemory, second: tree_second.SecondOrderMemory) -> None:
        """Fill w.T along w.xs, w.us for w.costates."""
        tree_second.second_order(
            self._model.table, memory.table, second.table, self.dt, w.xs, w.us, w.costates, w.T[:-1]
        )


def _are_floats(a: Any) -> bool:
    """Whether kernels can read it as it is."""
    return type(a) is np.ndarray and a.dtype == np.float64 and a.flags.c_contiguous
