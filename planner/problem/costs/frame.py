"""FrameCost: targets for the position and orientation of a frame of a machine (its hand, its foot, its trunk)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import Any

import numpy as np

from planner.base.arguments import array, numbers, shown
from planner.base.errors import PlannerError
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.model.coordinates import Coordinate
from planner.model.mechanism import Frame
from planner.model.space import conjugate, log_jacobian, log_quaternion, product
from planner.problem.costs.terms import Quadratic, Term, per_stage
from planner.problem.costs.tracking import mechanism_and_step
from planner.problem.costs.wanted import Wanted


class FrameCost(Term):
    """1/2 |p(q) - position|^2 + 1/2 |log(R_ref' R(q))|^2, weighted, summed over the stages: Gauss-Newton.

    It says nothing of the control, so it is one term of a cost: TrackingCost(...) + FrameCost(...). Each weight is a
    number, one per axis (3,), or one per stage and axis (N+1, 3): of the world for positions, per m^2, and of the
    frame as it should be for rotations, per rad^2. Weights on the way are multiplied by dt, final ones are not.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        frame: Name of a site or body, or a Frame.
        position: (3,) or (N+1, 3) m, in the world.
        orientation: (4,) or (N+1, 4) quaternion, w first; normalised.
        position_weight: On the way.
        final_position_weight: At the end; by default that of the way.
        orientation_weight: On the way.
        final_orientation_weight: At the end; by default that of the way.
        dt: s; that of the dynamics by default.

    Raises:
        PlannerError: No such frame, a wrong shape, a negative weight, a target without weight or the other way round.
    """

    def __init__(
        self, machine: Any, frame: str | Frame, *, position: Any = None, orientation: Any = None,
        position_weight: Any = 0.0, final_position_weight: Any = None, orientation_weight: Any = 0.0,
        final_orientation_weight: Any = None, dt: float | None = None,
    ) -> None:  # fmt: skip
        self.mechanism, dt = mechanism_and_step(machine, dt)
        if not isinstance(frame, (str, Frame)):
            raise PlannerError(f"frame is {shown(frame)}, expected a Frame or the name of a site or body.")
        self.frame = self.mechanism.frame(frame) if isinstance(frame, str) else frame
        self._name = frame if isinstance(frame, str) else "the frame"
        self.space = self.mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx
        self.N: int | None = None  # any horizon, unless something is given per stage
        # (1 or N+1, 3 or 4) each; weights of what has no target are zero
        self._position = self._target("position", position, 3)
        self._orientation = self._target("orientation", orientation, 4)
        length = np.linalg.norm(self._orientation, axis=1, keepdims=True)
        if length.min() < 1e-12:
            raise PlannerError("orientation has length zero, expected a quaternion, e.g. 1, 0, 0, 0.")
        self._orientation /= length
        if position is None and orientation is None:
            raise PlannerError("position and orientation are None, expected a target for the frame.")
        weights = [
            self._weights("position", position, position_weight, final_position_weight, dt),
            self._weights("orientation", orientation, orientation_weight, final_orientation_weight, dt),
        ]
        # (2,) whether the end asks for a position and for an orientation; what is only weighed on the way is no goal
        self._asked = (final_position_weight is not None, final_orientation_weight is not None)
        self._running, self._final = (_side_by_side(*parts) for parts in zip(*weights, strict=True))

    def resampled(self, parts: int, ratio: float) -> FrameCost:
        """The same over stages divided into parts, with the weights on the way multiplied by ratio."""
        cost = copy(self)
        cost.N = None if self.N is None else parts * self.N
        cost._position, cost._orientation = per_stage(self._position, parts), per_stage(self._orientation, parts)
        cost._running = ratio * per_stage(self._running, parts)
        return cost

    def _per_stage(self, name: str, given: np.ndarray) -> None:
        if given.ndim == 2:
            if self.N is not None and len(given) != self.N + 1:
                raise PlannerError(f"{name} has {len(given)} rows, expected N+1 = {self.N + 1} as the others.")
            self.N = len(given) - 1

    def _target(self, name: str, value: Any, size: int) -> np.ndarray:
        if value is None:
            return np.eye(1, size)
        given = numbers(name, value)
        given = array(name, given, ("N+1", size) if given.ndim == 2 else (size,))
        self._per_stage(name, given)
        return np.atleast_2d(given)

    def _weights(self, name: str, target: Any, way: Any, final: Any, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(1 or N+1, 3) on the way and (1, 3) at the end."""
        name = f"{name}_weight"
        given = [numbers(name, way), numbers(f"final_{name}", 0.0 if final is None else final)]
        for label, value in zip((name, f"final_{name}"), given, strict=True):
            if value.ndim == 2 and label == name:
                array(label, value, ("N+1", 3))
                self._per_stage(label, value)
            elif value.ndim:
                array(label, value, (3,))
            if not (np.isfinite(value).all() and value.min() >= 0.0):
                raise PlannerError(f"{label} is {value.tolist()}, expected finite weights of at least 0.")
        running, end = (np.atleast_2d(np.broadcast_to(v, v.shape if v.ndim else (3,))) for v in given)
        end = dt * running[-1:] if final is None else end
        weighs = bool(running.any() or end.any())
        if weighs != (target is not None):
            what = name.removesuffix("_weight")
            missing = f"{what} has no weight, expected {name} or final_{name} above 0"
            raise PlannerError(f"{missing}." if not weighs else f"{name} has no target, expected {what}=.")
        return dt * running, end

    def _residuals(self, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The stages with any weight, there the residuals r (n, 6) and weights (n, 6), and q (n, nq)."""
        weights = np.array(np.broadcast_to(self._running, (len(xs), 6)))
        weights[-1] = self._final[0]
        stages = np.flatnonzero(weights.any(axis=1))
        q = xs[stages, : self.mechanism.nq]
        target, turned = (one if len(one) == 1 else one[stages] for one in (self._position, self._orientation))
        r = self._residual(q, target, turned)
        return stages, r, weights[stages], q

    def wanted(self, _: Sequence[Coordinate]) -> tuple[Wanted, ...]:
        """The frame's position and orientation at the end, each where it has a final weight of its own."""
        parts = (("position", "m", slice(0, 3)), ("orientation", "rad", slice(3, 6)))
        return tuple(
            Wanted(f"{what} of {self._name}", unit, partial(self._missed, part))
            for (what, unit, part), asked in zip(parts, self._asked, strict=True)
            if asked and self._final[0, part].any()
        )

    def _missed(self, part: slice, xs: np.ndarray) -> np.ndarray:
        """(K,) m or rad, the residual's length along the axes that are weighed; infinite where a motion ran away."""
        q = xs[:, : self.mechanism.nq]
        known, missed = np.isfinite(q).all(axis=1), np.full(len(q), np.inf)
        r = self._residual(q[known], self._position[-1], self._orientation[-1])
        missed[known] = np.linalg.norm(r[:, part] * (self._final[0, part] > 0.0), axis=1)
        return missed

    def final_cost(self, x: np.ndarray) -> float:
        """The part of the value that the end x (nx,) has."""
        r = self._residual(x[None, : self.mechanism.nq], self._position[-1], self._orientation[-1])
        return 0.5 * float(np.sum(self._final * r**2))

    def _residual(self, q: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
        """(n, 6) of configurations q (n, nq) from a position and a quaternion, or from one for each."""
        T = frame_pose(self.mechanism, q, self.frame)
        turned = log_quaternion(product(conjugate(orientation), quaternion_of(T[:, :3, :3])))
        return np.concatenate([T[:, :3, 3] - position, turned], axis=1)

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a candidate that ran away: there is no pose
            return float("inf")
        _, r, weights, _ = self._residuals(xs)
        return 0.5 * float(np.sum(weights * r**2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradient J'W r and Hessian J'W J, J the derivative of the residuals; nothing of the control."""
        (N, nu), nv = us.shape, self.mechanism.nv
        model = Quadratic(
            np.zeros((N + 1, self.ndx, self.ndx)), np.zeros((N + 1, self.ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu))
        )
        stages, r, weights, q = self._residuals(xs)
        J = jacobian(self.mechanism, q, self.frame)
        R = frame_pose(self.mechanism, q, self.frame)[:, :3, :3]
        J[:, 3:] = log_jacobian(r[:, 3:]) @ np.swapaxes(R, 1, 2) @ J[:, 3:]  # log(R_ref' R exp(e)), e in R's own axes
        WJ = weights[:, :, None] * J
        model.Q[stages, :nv, :nv] = np.swapaxes(J, 1, 2) @ WJ
        model.q[stages, :nv] = np.einsum("nri,nr->ni", WJ, r)
        return model


def _side_by_side(*parts: np.ndarray) -> np.ndarray:
    """Arrays (rows, k) next to each other, one row of an array repeated as often as another one has rows."""
    rows = max(map(len, parts))
    return np.concatenate([np.broadcast_to(part, (rows, part.shape[1])) for part in parts], axis=1)


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (..., 4), w first, of a rotation matrix (..., 3, 3)."""
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    signs = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    # 4 q q', of which the row with the largest diagonal is far from zero
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., range(4), range(4)] = 1.0 + diagonal @ signs.T
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        outer[..., i + 1, j + 1] = outer[..., j + 1, i + 1] = R[..., i, j] + R[..., j, i]
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    rows = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)
