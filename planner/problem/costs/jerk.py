"""Jerk cost: squared differences of the joints' accelerations between stages.

    J = weight/2 sum dt |r_n|^2,     r_n = (a_n - a_{n-1}) / dt,     a_n = (qd after stage n - qd_n) / dt

a_n is the mean acceleration of a stage, which is that of its middle to second order in dt. A machine at rest at its
start has a_{-1} = 0; one at rest at its goal adds a term with a_N = 0. These changes happen at the ends, half a stage
from the middle: jerk is twice as large for half as long, so their terms count twice. If the machine moves at the start
or the end, that first or last term is omitted.

r_n depends on two stages, so SLQ solves the problem with the previous acceleration and its rate as added states:

    y_n = (x_n, a_{n-1}, r_{n-1}),     y_{n+1} = (f(x_n, u_n), a_n, (a_n - a_{n-1}) / dt).

The cost is then quadratic in the state, as any TrackingCost. `with_acceleration` makes that problem. `JerkCost` is the
same cost on the machine's own states, for the resulting plan. Its gradient is exact. A Quadratic cannot hold a Hessian
that couples two stages; the problem's control weights R take its place, so the gains are those of minimum effort along
the minimum-jerk trajectory.

For joints whose acceleration is an input, that acceleration can be the added state, and its derivative the control:

    y = (x, a),     da/dt = u,     a continuous, linear over a stage.

`driven_by_jerk` makes that machine. It is a mechanism like any other, with activations, in kernels and in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import array, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.second_thread import SolveMemory
from planner.kernels.lq.workspace import Workspace
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.prescribed_joints import heavy_joints, in_order, prescribe_joints, twin_of
from planner.model.mjcf.read import read
from planner.model.space import StateSpace
from planner.problem.costs.terms import Cost, Quadratic, SumCost, Term, extended_cost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem


class Accelerations:
    """Mean accelerations of a machine's stages and their exact derivatives."""

    def __init__(self, dynamics: Any) -> None:
        if not isinstance(dynamics, RigidBodyDynamics):
            raise PlannerError(
                f"the machine is {short_repr(dynamics)}, expected RigidBodyDynamics: jerk is that of joints."
            )
        self.dynamics, self.nv = dynamics, dynamics.mechanism.nv
        self._velocities = dynamics.mechanism.velocities

    def __call__(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K, nv) at xs (K, nx) with us (K, nu)."""
        return (self.dynamics.step(xs, us)[:, self._velocities] - xs[:, self._velocities]) / self.dynamics.dt

    def derivatives(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives by a deviation of x (K, nv, ndx), and by u (K, nv, nu)."""
        A, B = self.dynamics.linearize(np.concatenate([xs, xs[:1]]), us)
        rows = slice(self.nv, 2 * self.nv)
        by_x = A[:, rows].copy()
        by_x[:, :, rows] -= np.eye(self.nv)
        return by_x / self.dynamics.dt, B[:, rows] / self.dynamics.dt


class JerkDynamics:
    """A machine with the state (x, a, r): its own, the accelerations (nv,) of the stage before, and their rates (nv,).

    It is compiled as the machine itself is (see planner.dynamics.ResidualDynamics).
    """

    has_slopes, second_order_kernels = False, ()

    def __init__(self, dynamics: RigidBodyDynamics) -> None:
        self.own, self.mechanism, self.prescribed = dynamics, dynamics.mechanism, dynamics.prescribed
        self.capabilities = replace(dynamics.capabilities, exact_hessian=False)
        self.space = augmented(dynamics.space, 2 * self.mechanism.nv)
        self.nx, self.ndx, self.nu, self.dt = self.space.nx, self.space.ndx, dynamics.nu, dynamics.dt
        self.batched = True
        self.kernels, self.structured = dynamics.kernels, dynamics.structured
        # The line search and the residuals are the machine's own; see CompiledDynamics and ResidualDynamics.
        self.search, self.take, self.residuals = dynamics.search, dynamics.take, dynamics.residuals
        self.quadratize_nominal = dynamics.quadratize_nominal
        nv, ndx = self.mechanism.nv, dynamics.ndx
        self.outputs = nv
        self._velocities = slice(nv, 2 * nv)  # rows of A and B
        self._accelerations, self._rates = slice(ndx, ndx + nv), slice(ndx + nv, ndx + 2 * nv)

    def step(self, ys: np.ndarray, us: np.ndarray, dt: np.ndarray | None = None) -> np.ndarray:
        """The ends (K, nx) of K stages from ys (K, nx) with us (K, nu); see Dynamics.step."""
        xs = np.ascontiguousarray(ys[:, : self.own.nx])
        ends = self.own.step(xs, us, dt)
        return self._appended(ys, ends if dt is None else self.own.step(xs, us), ends)

    def _appended(self, ys: np.ndarray, whole: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(K, nx) own ends (K, own.nx) with the accelerations of the whole stages and their rates."""
        v, a = self.mechanism.velocities, self.own.nx
        means = (whole[:, v] - ys[:, v]) / self.dt
        return np.concatenate([ends, means, (means - ys[:, a : a + self.mechanism.nv]) / self.dt], axis=1)

    def linearize(self, ys: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) along ys (N+1, nx), us (N, nu), exact."""
        return self._lifted(*self.own.linearize(np.ascontiguousarray(ys[:, : self.own.nx]), us))

    def _lifted(self, own_A: np.ndarray, own_B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) from those of the machine itself."""
        N, ndx = len(own_A), self.own.ndx
        A, B = np.zeros((N, self.ndx, self.ndx)), np.zeros((N, self.ndx, self.nu))
        A[:, :ndx, :ndx], B[:, :ndx] = own_A, own_B
        self._append_rows(B, A)
        return A, B

    def _append_rows(self, by_u: np.ndarray, by_x: np.ndarray) -> None:
        """Fill the rows of the accelerations and their rates from those of the velocities."""
        k = np.arange(self.mechanism.nv)
        for part in (by_u, by_x):
            np.multiply(part[:, self._velocities], 1.0 / self.dt, out=part[:, self._accelerations])
        by_x[:, self._accelerations.start + k, self._velocities.start + k] -= 1.0 / self.dt
        for part in (by_u, by_x):
            np.multiply(part[:, self._accelerations], 1.0 / self.dt, out=part[:, self._rates])
        by_x[:, self._rates.start + k, self._accelerations.start + k] -= 1.0 / self.dt

    def memory(self, N: int) -> SolveMemory:
        """Scratch memory of a solve of N stages."""
        return self.own.memory(N, appended=2 * self.mechanism.nv)

    def linearize_nominal(self, w: Workspace, memory: SolveMemory) -> None:
        """Fill w.F along w.xs, w.us."""
        own, by_x = self.own, slice(w.first, w.first + self.ndx)
        if self.structured:
            own.linearize_nominal(w, memory)
            return
        B, A = own.linearize_dense(w.xs, w.us, memory)
        w.F[:, : own.ndx, : self.nu], w.F[:, : own.ndx, by_x][:, :, : own.ndx] = B, A
        self._append_rows(w.F[:, :, : self.nu], w.F[:, :, by_x])

    def stage_ends(self, w: Workspace, memory: SolveMemory) -> np.ndarray:
        """The states (N, nx) after one stage from each of w.xs, w.us; prepares linearize_nominal."""
        ends = self.own.stage_ends(w, memory)[:, : self.own.nx]
        return self._appended(w.xs[:-1], ends, ends)

    def nominal_jacobians(self, w: Workspace) -> tuple[np.ndarray, np.ndarray]:
        """A (N, ndx, ndx) and B (N, ndx, nu) of Eq. 35, from the last linearize_nominal."""
        if self.structured:
            return self._lifted(*self.own.nominal_jacobians(w))
        return w.F[:, :, w.first : w.first + self.ndx], w.F[:, :, : self.nu]

    def residual_kernels(self, solids: bool | None) -> tuple[str, ...]:
        """Names of the kernels used with residuals, in place of `kernels`."""
        search, *_, residuals = self.own.residual_kernels(solids)
        return search, *self.kernels[1:], residuals

    def second_order_memory(self) -> Any:
        """PlannerError: there are none."""
        raise PlannerError(
            'hessian="exact" has no second derivatives of accelerations, expected hessian="gauss-newton" for jerk.'
        )

    def second_order_nominal(self, w: Workspace, memory: Any, second: Any) -> None:
        """Never called; see second_order_memory."""


class JerkCost(Term):
    """Jerk cost on a machine's own states; its Hessian omits the coupling of stages, see the module.

    Args:
        dynamics: RigidBodyDynamics.
        horizon: N, number of stages.
        weight: Of the squared jerk / 2, per second; jerk in rad/s^3 or m/s^3.
        R: (N, nu, nu) control weights in place of its Hessian, for the gains; zero by default.
        from_rest: Whether the machine is at rest before the start.
        to_rest: Whether the machine is at rest after the end.

    Raises:
        PlannerError: Other dynamics, a negative weight, or joints whose jerk is the control.
    """

    def __init__(
        self, dynamics: Any, horizon: int, weight: float = 1.0, R: np.ndarray | None = None, *,
        from_rest: bool = True, to_rest: bool = True,
    ) -> None:  # fmt: skip
        self.accelerations = Accelerations(dynamics)
        if driven := heavy_joints(dynamics.mechanism):
            raise PlannerError(
                f"the jerk of {', '.join(driven)} is the control already, expected it to be weighed as such, not as an "
                "objective."
            )
        self.weight, self.dt, self.N = number("the jerk's weight", weight, minimum=0.0), dynamics.dt, horizon
        self.space, self.nu = dynamics.space, dynamics.nu
        self.nx, self.ndx = dynamics.nx, dynamics.ndx
        self.R = np.zeros((horizon, self.nu, self.nu)) if R is None else R
        self.counts = np.ones(horizon + 1)  # (N+1,) factor of r_n
        self.counts[[0, -1]] *= np.sqrt(2.0) * np.array([from_rest, to_rest])

    def weights(self, space: StateSpace) -> np.ndarray:
        """Q (N+1, ndx, ndx) of the same cost on the states (x, a, r) of JerkDynamics, in their space."""
        nv, N = self.accelerations.nv, self.N
        a, r = np.arange(self.ndx, self.ndx + nv), np.arange(self.ndx + nv, space.ndx)
        Q = np.zeros((N + 1, space.ndx, space.ndx))
        Q[1:, r, r] = (self.weight * self.dt * self.counts[:-1] ** 2)[:, None]
        Q[N, a, a] = self.weight * self.counts[-1] ** 2 / self.dt
        return Q

    def jerks(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N+1, nv) r_n by the root of how often each counts, rad/s^3 or m/s^3."""
        a = self.accelerations(xs[: len(us)], us)
        still = np.zeros((1, a.shape[1]))
        return self.counts[:, None] * np.diff(np.concatenate([still, a, still]), axis=0) / self.dt

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        return 0.5 * self.weight * self.dt * float(np.sum(self.jerks(xs, us) ** 2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Exact gradients, with R in place of the Hessian."""
        N, ndx = len(us), self.ndx
        slope = -self.weight * np.diff(self.counts[:, None] * self.jerks(xs, us), axis=0)  # of J with respect to a_n
        by_x, by_u = self.accelerations.derivatives(xs[:N], us)
        q = np.zeros((N + 1, ndx))
        q[:N] = np.einsum("nax,na->nx", by_x, slope)
        r = np.einsum("nau,na->nu", by_u, slope)
        return Quadratic(np.zeros((N + 1, ndx, ndx)), q, self.R, r)


def augmented(space: StateSpace, more: int) -> StateSpace:
    """A state space with `more` vector components appended."""
    return StateSpace(space.nx + more, space.ndx + more, space.quaternions)


def with_acceleration(problem: Problem, **changes: Any) -> Problem:
    """The problem, of RigidBodyDynamics, with the states of JerkDynamics; accelerations and rates start from 0."""
    if not isinstance(problem.dynamics, RigidBodyDynamics):
        raise PlannerError(f"the dynamics are {short_repr(problem.dynamics)}, expected RigidBodyDynamics for jerk.")
    dynamics = JerkDynamics(problem.dynamics)
    x0 = np.concatenate([array("x0", problem.x0, ("nx",)), np.zeros(2 * dynamics.mechanism.nv)])
    return replace(
        problem, dynamics=dynamics, x0=x0, twin=None, requirements=None,
        cost=_with_jerk_weights(problem.cost, problem.dynamics.space, dynamics.space),
        constraints=[replace(one, states=one.states or problem.dynamics.nx) for one in problem.constraints],
        **changes,
    )  # fmt: skip


def _with_jerk_weights(cost: Any, own: StateSpace, space: StateSpace) -> Cost:
    """A cost of states in `own` on those of JerkDynamics: JerkCosts become weights of its TrackingCost."""
    terms = getattr(cost, "costs", (cost,))
    jerk = [term for term in terms if isinstance(term, JerkCost)]
    others = [term for term in terms if not isinstance(term, JerkCost)]
    k = next((k for k, term in enumerate(others) if type(term) is TrackingCost), None)
    if k is None:
        raise PlannerError("the cost has no TrackingCost, expected one for jerk: TrackingCost(...) + your own cost.")
    Q = sum(term.weights(space) for term in jerk)
    track: TrackingCost = others[k]
    costs = [extended_cost(term, own, space) for i, term in enumerate(others) if i != k]
    costs.insert(k, track.augmented(own, space, Q))
    return costs[0] if len(costs) == 1 else SumCost(*costs)


def driven_by_jerk(mechanism: Mechanism, joints: Collection[str]) -> Mechanism:
    """A machine whose controls are the jerks of some of its joints.

    It is MuJoCo's replay model of prescribed joints, with a large armature and motor gear PRESCRIBED_ARMATURE (see
    model.mjcf.prescribed_joints), and motors with integrator dynamics. Other forces on such a joint change its
    acceleration by the force over PRESCRIBED_ARMATURE.

    Args:
        mechanism: Read from an MJCF.
        joints: Names of the joints whose jerk is a control.

    Returns:
        The machine with one more activation for each degree of freedom of the joints, its acceleration, in the order
        of qvel, and after its own actuators one control for each, m/s^3 or rad/s^3.

    Raises:
        PlannerError: No joint, or one that the machine does not have.
        ModelError: As planner.model.mjcf.prescribed_joints.twin_of.
    """
    if not isinstance(mechanism, Mechanism) or not mechanism.mjcf:
        raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism that was read from an MJCF.")
    if isinstance(joints, str) or not isinstance(joints, Collection) or not joints:
        raise PlannerError(f"joints is {short_repr(joints)}, expected names of at least one joint.")
    twin = twin_of(mechanism, joints)
    machine = read(_integrating(twin.mjcf), assets=twin.assets).with_curves(twin.curves)
    if not mechanism.original:
        return machine
    given = compile_model(mechanism.original, mechanism.assets)
    original = prescribe_joints(mechanism.original, mechanism.assets, given, in_order(mechanism, joints))
    return replace(machine, original=_integrating(original))


def _integrating(text: str) -> str:
    """The MJCF text of a twin of prescribed joints, with integrator dynamics at the motors: jerk is the control."""
    root = ElementTree.fromstring(text)
    motors = root.findall("actuator")[-1]  # the section that was added last
    for motor in motors:
        motor.tag = "general"
        motor.attrib.update(dyntype="integrator", gainprm="1", biastype="none", actlimited="false")
    for key in root.iterfind("keyframe/key"):
        if "act" in key.attrib:
            key.set("act", " ".join([key.attrib["act"], *["0"] * len(motors)]))
    return ElementTree.tostring(root, encoding="unicode")
