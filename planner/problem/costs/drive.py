"""DriveCost: squared forces at prescribed joints for the planned accelerations (Cases 2 and 3).

    J = sum_n dt weight 1/2 (tau_n - reference)^2,     tau = tau_p(x, u) of the paper's hybrid dynamics, Fig. 2

tau_p is the force of motors in place of the prescription. The joints' accelerations are affine in it,

    a_p = a_0(x, u) + G(x) tau_p,     so     tau_p = G^-1 (u_p - a_0),     d tau_p = G^-1 (du_p - d a_p at fixed tau_p)

with G from the exact Jacobian of the machine with motors, by the kernels. The Hessian is Gauss-Newton with its mixed
term. The cost is computed in NumPy, so a problem with it is solved by the NumPy engine.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, array, count, numbers, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, prescribed_dofs, with_force_inputs
from planner.problem.costs.jerk import Accelerations
from planner.problem.costs.terms import Quadratic, Term


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
        self.weight, self.reference = _each("weight", weight, size), _each("reference", reference, size)
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


def _each(name: str, value: Any, size: int) -> np.ndarray:
    """(size,) from a number or an array."""
    given = numbers(name, value)
    return array(name, np.full(size, given) if given.ndim == 0 else given, (size,))
