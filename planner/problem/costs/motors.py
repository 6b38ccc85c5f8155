"""Costs of motors: EnergyCost, their mechanical work, and DriveCost, forces at prescribed joints.

EnergyCost has the work of either sign, smoothed where it changes sign:

    J = weight sum dt sum_j e(p_j),     e(p) = sqrt(p^2 + s^2) - s,     p_j = f_j d_j / dt,

p_j the mean power of actuator j over a stage, W: force f_j times displacement d_j, over dt. Negative work costs as much
as positive: no energy is recovered. For forces constant over a stage this is their exact work, so the cost is at least
the energy that the motion gains; power at the knots would let an optimizer concentrate force where the speed crosses
zero. A force that depends on the state is the mean of both ends of the stage.

SLQ needs a quadratic model. The gradient is e'(p) dp, and the Hessian is replaced by

    e'(p)/p dp dp',     e'(p)/p = 1 / sqrt(p^2 + s^2):

the curvature of the parabola that has the value and slope of e at p and is an upper bound of e (concave in p^2). dp is
the power linearized along the dynamics, since it depends on both ends of a stage; force times speed gives a mixed term
S. Kernels do all of it (kernels.tree.residuals.motor_work).

DriveCost has squared forces at prescribed joints for the planned accelerations (Cases 2 and 3):

    J = sum_n dt weight 1/2 (tau_n - reference)^2,     tau = tau_p(x, u) of the paper's hybrid dynamics, Fig. 2

tau_p is the force of motors in place of the prescription. The joints' accelerations are affine in it,

    a_p = a_0(x, u) + G(x) tau_p,     so     tau_p = G^-1 (u_p - a_0),     d tau_p = G^-1 (du_p - d a_p at fixed tau_p)

with G from the exact Jacobian of the machine with motors, by the kernels. The Hessian is Gauss-Newton with its mixed
term. DriveCost is computed in NumPy, beside compiled costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, count, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.kernels.lq.workspace import Workspace
from planner.model.coordinates import Coordinate
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, heavy_joints, prescribed_dofs, with_force_inputs
from planner.model.space import StateSpace
from planner.problem.costs.jerk import Accelerations
from planner.problem.costs.residual_arrays import ResidualArrays, ResidualList
from planner.problem.costs.terms import GoalSpec, Quadratic, Term
from planner.problem.costs.tracking import NoTracking, one_each

SMOOTHING_SHARE = 0.02
"""Of the mean power along a motion, s of a plan that starts from it: a minimum then takes at most this share of that
motion's work above the least nearby; the built-in two-link 0.2 %. Less takes more iterations."""
TINY = np.finfo(float).tiny  # in place of 0 in a denominator
WITHOUT_POWER = 1.0  # W, s along a motion that takes no power, or runs away: any other would do as well


class EnergyCost(Term):
    """Mechanical work of the actuators, sum dt sum_j |power_j|, smoothed; see the module.

    It has no curvature in the control of a motor at rest, so it is one term of a cost: TrackingCost(...) +
    EnergyCost(...).

    Args:
        dynamics: RigidBodyDynamics without prescribed joints.
        weight: Per J.
        smoothing: s, W: a power p = s costs 0.41 s, a large power p - s. None for the work itself, as a measure; solves
            need one (see smoothing_along), which those of an objective find.

    Raises:
        PlannerError: Other dynamics, prescribed joints, actuators at sites, a negative weight, or a smoothing that is
            not above 0; and none, where derivatives are asked for.
    """

    def __init__(self, dynamics: Any, weight: float = 1.0, smoothing: float | None = None) -> None:
        if not isinstance(dynamics, RigidBodyDynamics):
            expected = "expected RigidBodyDynamics: energy is the work of actuators"
            raise PlannerError(f"the machine is {short_repr(dynamics)}, {expected}.")
        if given := dynamics.prescribed or heavy_joints(dynamics.mechanism):
            expected = "expected a machine that its actuators alone move: energy is their work"
            raise PlannerError(f"the acceleration of {', '.join(given)} is prescribed, {expected}.")
        if dynamics.mechanism.actuators.wrenches:
            raise PlannerError(
                "an actuator acts at a site, expected actuators of joints and fixed tendons: energy is their work."
            )
        self.dynamics, self.mechanism, self.dt = dynamics, dynamics.mechanism, dynamics.dt
        self.weight = number("the energy's weight", weight, minimum=0.0)
        self.smoothing = None if smoothing is None else number("the energy's smoothing", smoothing, greater_than=0.0)
        self.space, self.nx, self.ndx, self.nu = dynamics.space, dynamics.nx, dynamics.ndx, dynamics.nu

    def residual_arrays_for(self, N: int) -> ResidualArrays:
        """What the kernels of solves of N stages read."""
        if self.smoothing is None:
            raise PlannerError(
                "the energy has no smoothing, expected one in W, e.g. that of EnergyCost(...).smoothing_along(xs, us)."
            )
        return self._arrays(N, self.smoothing)

    def augmented(self, own: StateSpace, space: StateSpace) -> EnergyCost:
        """The same cost on a state with appended components."""
        cost = copy(self)
        cost.space, cost.nx, cost.ndx = space, space.nx, space.ndx
        return cost

    def power(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N, nu) W, the mean power of each actuator over each stage of xs (N+1, nx), us (N, nu)."""
        w, memory, found = *self._workspace(xs, us, self._arrays(len(us), 0.0)), np.empty((len(us), self.nu))
        self.dynamics.works_nominal(w, memory, found)
        return found / self.dt

    def work(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The work in J, neither weighted nor smoothed: |p_j| summed over actuators and, times dt, over stages."""
        return self.dt * float(np.abs(self.power(xs, us)).sum())

    def smoothing_along(self, xs: np.ndarray, us: np.ndarray) -> float:
        """Smoothing for motions like xs (N+1, nx), us (N, nu): SMOOTHING_SHARE of the mean power of an actuator, W."""
        mean = float(np.abs(self.power(xs, us)).mean())
        return SMOOTHING_SHARE * mean if 0.0 < mean < np.inf else WITHOUT_POWER

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        p, s = self.power(xs, us), self.smoothing or 0.0
        return self.weight * self.dt * float(np.sum(p * p / np.maximum(np.sqrt(p * p + s * s) + s, TINY)))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Exact gradients along any xs (N+1, nx), us (N, nu); the approximate Hessian of the module."""
        w, memory = self._workspace(xs, us, self.residual_arrays_for(len(us)))
        self.dynamics.stage_ends(w, memory)
        self.dynamics.linearize_nominal(w, memory)
        self.dynamics.quadratize_nominal(w, memory)
        own, nu, x = self.dynamics.ndx, self.nu, slice(w.first, w.first + self.dynamics.ndx)
        Q, q = np.zeros((len(xs), self.ndx, self.ndx)), np.zeros((len(xs), self.ndx))
        S = np.zeros((len(us), nu, self.ndx))
        by_u, by_x, q[:, :own] = w.rows[:, :, :nu], w.rows[:, :, x], w.l[:, x]
        Q[:-1, :own, :own], S[:, :, :own] = by_x.mT @ by_x, by_u.mT @ by_x
        return Quadratic(Q, q, by_u.mT @ by_u, w.l[:-1, :nu].copy(), S)

    def goal_specs(self, _: Sequence[Coordinate]) -> tuple[GoalSpec, ...]:
        """No goals: the end of the last stage is where its work ends, and nothing is asked of it."""
        return ()

    def _arrays(self, N: int, smoothing: float) -> ResidualArrays:
        return replace(ResidualList(N).arrays(), work=np.array([[self.weight, smoothing, self.dt]]))

    def _workspace(self, xs: np.ndarray, us: np.ndarray, arrays: ResidualArrays) -> tuple[Workspace, Any]:
        """What kernels read of a trajectory, and their scratch memory."""
        N, dynamics = len(us), self.dynamics
        w = Workspace(NoTracking(N, dynamics.space, self.nu), dynamics.space, dynamics.structured)
        w.xs[:], w.us[:] = xs[:, : dynamics.nx], us
        w.use_residuals(dynamics.residuals(arrays))
        return w, dynamics.memory(N)


class DriveCost(Term):
    """Squared forces and moments at prescribed joints; one term of a cost: TrackingCost(...) + DriveCost(...).

    Args:
        dynamics: RigidBodyDynamics with prescribed joints, whose p degrees of freedom move masses.
        horizon: N, number of stages.
        weight: (p,) weights, in the order of qvel, per second.
        reference: (p,) N or N m, forces without cost, e.g. the weight of a load.

    Raises:
        PlannerError: No prescribed joints, or a wrong shape or sign of weight or reference.
    """

    def __init__(self, dynamics: Any, horizon: int, weight: Any, reference: Any = 0.0) -> None:
        if not isinstance(dynamics, RigidBodyDynamics) or not dynamics.prescribed:
            raise PlannerError(
                f"the machine is {short_repr(dynamics)}, expected RigidBodyDynamics with prescribed joints."
            )
        self.N = count("horizon", horizon, maximum=LONGEST_HORIZON)
        self.space, self.nu, self.dt = dynamics.space, dynamics.nu, dynamics.dt
        self.nx, self.ndx = dynamics.nx, dynamics.ndx
        m = dynamics.mechanism
        self.dofs = prescribed_dofs(m, dynamics.prescribed)
        size = len(self.dofs)
        self.weight, self.reference = one_each("weight", weight, size), one_each("reference", reference, size)
        if self.weight.min() < 0.0:
            raise PlannerError(f"weight of a drive's force is {self.weight.min():g}, expected at least 0.")
        # Stops of prescribed joints have no effect on the motion.
        joint_stops = tuple(stop for stop in m.stops if stop.dof not in self.dofs)
        with_motors = replace(with_force_inputs(m, dynamics.prescribed), contacts=m.contacts, stops=joint_stops)
        self._accelerations = Accelerations(RigidBodyDynamics(with_motors, dynamics.dt, "euler"))

    def resampled(self, parts: int, ratio: float) -> DriveCost:
        """The same cost over stages divided into parts, with the length of a stage multiplied by ratio."""
        cost = copy(self)
        cost.N, cost.dt = parts * self.N, ratio * self.dt
        return cost

    def forces(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """tau_p (K, p), N or N m, at xs (K, nx) under us (K, nu)."""
        return self._forces(xs, us)[0]

    def _forces(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """tau_p, and us with the controls of the motors in place of accelerations."""
        first_control = self.nu - len(self.dofs)
        controls = us.copy()
        controls[:, first_control:] = 0.0
        lacking = us[:, first_control:] - self._accelerations(xs, controls)[:, self.dofs]
        G = self._accelerations.derivatives(xs, controls)[1][:, self.dofs, first_control:]
        controls[:, first_control:] = np.linalg.solve(G, lacking[..., None])[..., 0]
        return PRESCRIBED_ARMATURE * controls[:, first_control:], controls  # the gear of the motors

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a rollout that diverged
            return float("inf")
        away = self.forces(xs[: len(us)], us) - self.reference
        return 0.5 * self.dt * float(np.sum(self.weight * away**2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradients, and the Hessian of the linearized forces with its mixed part."""
        N, ndx, first = len(us), self.ndx, self.nu - len(self.dofs)
        forces, controls = self._forces(xs[:N], us)
        by_x, by_u = (part[:, self.dofs] for part in self._accelerations.derivatives(xs[:N], controls))
        G, right = by_u[:, :, first:], np.concatenate([-by_x, -by_u], axis=2)
        right[:, :, ndx + first :] = np.eye(len(self.dofs))
        J = PRESCRIBED_ARMATURE * np.linalg.solve(G, right)  # d tau_p / d(x, u)
        weighted = self.dt * self.weight[:, None] * J
        H = np.swapaxes(weighted, 1, 2) @ J
        gradient = np.einsum("naz,na->nz", weighted, forces - self.reference)
        Q, q = np.zeros((N + 1, ndx, ndx)), np.zeros((N + 1, ndx))
        Q[:N], q[:N] = H[:, :ndx, :ndx], gradient[:, :ndx]
        return Quadratic(Q, q, H[:, ndx:, ndx:], gradient[:, ndx:], H[:, ndx:, :ndx])
