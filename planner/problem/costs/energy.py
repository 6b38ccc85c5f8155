"""EnergyCost: the mechanical work of the motors, of either sign, smoothed where it changes sign.

    J = weight sum dt sum_j e(p_j),     e(p) = sqrt(p^2 + s^2) - s,     p_j = f_j d_j / dt,

p_j the mean power of actuator j over a stage, W: force f_j times displacement d_j, over dt. Negative work costs as much
as positive: no energy is recovered. For forces constant over a stage this is their exact work, so the cost is at least
the energy that the motion gains; power at the knots would let an optimizer concentrate force where the speed crosses
zero. A force that depends on the state is the mean of both ends of the stage.

SLQ needs a quadratic model. The gradient is e'(p) dp, and the Hessian is replaced by

    e'(p)/p dp dp',     e'(p)/p = 1 / sqrt(p^2 + s^2):

the curvature of the parabola that has the value and slope of e at p and is an upper bound of e (concave in p^2). dp is
the power linearized along the dynamics, since it depends on both ends of a stage; force times speed gives a mixed term
S.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.joint_forces import force_derivatives_at, forces_at
from planner.model.mjcf.prescribed_joints import heavy_joints
from planner.problem.costs.terms import Quadratic, Term

SMOOTHING = 1.0
"""Smoothing s, W; the built-in arms need a few to some tens of W. A tenth of it reduces the two-link's work from 1.6 to
0.5 % above the minimum, in more than three times the iterations."""


class EnergyCost(Term):
    """Mechanical work of the actuators, sum dt sum_j |power_j|, smoothed; see the module.

    It has no curvature in the control of a motor at rest, so it is one term of a cost: TrackingCost(...) +
    EnergyCost(...).

    Args:
        dynamics: RigidBodyDynamics without prescribed joints.
        weight: Per J.
        smoothing: s, W: a power p = s costs 0.41 s, a large power p - s.

    Raises:
        PlannerError: Other dynamics, prescribed joints, actuators at sites, a negative weight, or a smoothing that is
            not above 0.
    """

    def __init__(self, dynamics: Any, weight: float = 1.0, smoothing: float = SMOOTHING) -> None:
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
        self.smoothing = number("the energy's smoothing", smoothing, greater_than=0.0)
        self.space, self.nx, self.ndx, self.nu = dynamics.space, dynamics.nx, dynamics.ndx, dynamics.nu

    def power(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N, nu) W, the mean power of each actuator over each stage of xs (N+1, nx), us (N, nu)."""
        force, way, _ = self._parts(xs, us)
        return force * way / self.dt

    def work(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The work in J, neither weighted nor smoothed: |p_j| summed over actuators and, times dt, over stages."""
        return self.dt * float(np.abs(self.power(xs, us)).sum())

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        p, s = self.power(xs, us), self.smoothing
        return self.weight * self.dt * float(np.sum(p * p / (np.sqrt(p * p + s * s) + s)))  # without cancellation

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Exact gradients along any xs (N+1, nx), us (N, nu); the approximate Hessian of the module."""
        N, (by_x, by_end, by_u) = len(us), self._derivatives(xs, us)
        p = self.power(xs, us)
        curvature = self.weight * self.dt / np.sqrt(p * p + self.smoothing**2)  # e'(p)/p
        q = np.zeros((N + 1, self.ndx))
        q[:N] = np.einsum("nji,nj->ni", by_x, curvature * p)
        q[1:] += np.einsum("nji,nj->ni", by_end, curvature * p)
        r = np.einsum("njk,nj->nk", by_u, curvature * p)
        A, B = self.dynamics.linearize(xs, us)
        by_x, by_u = by_x + by_end @ A, by_u + by_end @ B
        Q = np.zeros((N + 1, self.ndx, self.ndx))
        Q[:N] = np.swapaxes(by_x, 1, 2) @ (curvature[:, :, None] * by_x)
        weighted = np.swapaxes(curvature[:, :, None] * by_u, 1, 2)
        return Quadratic(Q, q, weighted @ by_u, r, weighted @ by_x)

    def _parts(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean forces f (N, nu), displacements d (N, nu), and deviations (N, ndx) from one knot to the next."""
        move = self.space.difference(xs[1:], xs[:-1])
        force = 0.5 * forces_at(self.mechanism, *_both_ends(xs, us)).reshape(2, *us.shape).sum(axis=0)
        return force, move[:, : self.mechanism.nv] @ self.mechanism.actuators.moment.T, move

    def _derivatives(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the power by both ends (N, nu, ndx) of each stage, and by its controls (N, nu, nu)."""
        acts, nv = self.mechanism.actuators, self.mechanism.nv
        force, way, move = self._parts(xs, us)
        along = np.zeros((len(acts.moment), self.ndx))
        along[:, :nv] = acts.moment
        by_end = force[:, :, None] * (along @ self.space.difference_jacobian(move))
        by_x = -force[:, :, None] * (along @ self.space.difference_jacobian(-move))
        of_x, of_u = force_derivatives_at(self.mechanism, *_both_ends(xs, us))
        by_x += 0.5 * way[:, :, None] * of_x[: len(us)]
        by_end += 0.5 * way[:, :, None] * of_x[len(us) :]
        by_u = 0.5 * (way * (of_u[: len(us)] + of_u[len(us) :]))[:, :, None] * np.eye(self.nu)
        return by_x / self.dt, by_end / self.dt, by_u / self.dt


def _both_ends(xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (2N, nx) at the start of each stage, then at its end, and their controls (2N, nu)."""
    return np.concatenate([xs[:-1], xs[1:]]), np.concatenate([us, us])
