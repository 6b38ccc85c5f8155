"""DirectionCost: an axis of a frame points somewhere, and the frame may turn about it."""

from __future__ import annotations

from copy import copy

import numpy as np

from planner.dynamics.kinematics import frame_pose, jacobian
from planner.model.mechanism import Mechanism
from planner.model.space import hat
from planner.problem.costs.terms import Quadratic, Term, per_stage


class DirectionCost(Term):
    """1/2 |R(q) axis - to|^2, weighted, summed over the stages: Gauss-Newton. The chord is 2 sin(angle / 2).

    Args:
        mechanism: The machine.
        frame: Name of a site or body.
        axis: (3,) unit vector of the frame.
        to: (3,) unit vector of the world.
        weight: (N+1,) of each stage, per rad^2.
    """

    def __init__(self, mechanism: Mechanism, frame: str, axis: np.ndarray, to: np.ndarray, weight: np.ndarray) -> None:
        self.mechanism, self.frame, self.axis, self.to, self.weight = mechanism, frame, axis, to, weight
        self.space, self.N = mechanism.space, len(weight) - 1
        self.nx, self.ndx = self.space.nx, self.space.ndx

    def resampled(self, parts: int, ratio: float) -> DirectionCost:
        """The same over stages divided into parts, with the weights on the way multiplied by ratio."""
        cost = copy(self)
        cost.weight = np.concatenate([ratio * per_stage(self.weight, parts)[:-1], self.weight[-1:]])
        cost.N = parts * self.N
        return cost

    def _pointing(self, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The stages with a weight, and there q (n, nq) and the axes (n, 3) in the world."""
        stages = np.flatnonzero(self.weight)
        q = xs[stages, : self.mechanism.nq]
        return stages, q, frame_pose(self.mechanism, q, self.frame)[:, :3, :3] @ self.axis

    def final_cost(self, x: np.ndarray) -> float:
        """The part of the value that the end x (nx,) has."""
        axis = frame_pose(self.mechanism, x[: self.mechanism.nq], self.frame)[:3, :3] @ self.axis
        return 0.5 * float(self.weight[-1] * np.sum((axis - self.to) ** 2))

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a candidate that ran away: there is no pose
            return float("inf")
        stages, _, axes = self._pointing(xs)
        return 0.5 * float(self.weight[stages] @ np.sum((axes - self.to) ** 2, axis=1))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradient J'W r and Hessian J'W J; nothing of the control."""
        (N, nu), nv = us.shape, self.mechanism.nv
        model = Quadratic(
            np.zeros((N + 1, self.ndx, self.ndx)), np.zeros((N + 1, self.ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu))
        )
        stages, q, axes = self._pointing(xs)
        J = -hat(axes) @ jacobian(self.mechanism, q, self.frame)[:, 3:]
        WJ = self.weight[stages, None, None] * J
        model.Q[stages, :nv, :nv] = np.swapaxes(J, 1, 2) @ WJ
        model.q[stages, :nv] = np.einsum("nri,nr->ni", WJ, axes - self.to)
        return model
