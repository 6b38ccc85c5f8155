"""What the residuals of a machine's states are made of: its points and frames, where they are and how they move."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from planner.dynamics.kinematics import frame_pose, jacobian, jacobian_derivatives, points_of
from planner.model.mechanism import Frame, Mechanism
from planner.problem.costs.residuals.arrays import ResidualArrays


class KinematicsCache:
    """States xs (K, nx) of a mechanism as the terms of ResidualArrays of K stages see them."""

    def __init__(self, mechanism: Mechanism, arrays: ResidualArrays, xs: np.ndarray) -> None:
        self.mechanism, self.arrays, self.nv = mechanism, arrays, mechanism.nv
        self.q, self.v = xs[:, : mechanism.nq], xs[:, mechanism.nq : mechanism.nq + mechanism.nv]

    @cached_property
    def places(self) -> np.ndarray:
        """(K, P, 3) m, the points."""
        m = self.arrays
        places, _ = points_of(self.mechanism, self.q, m.link, m.offset, moving=False)
        return m.share[:, None] * places + np.swapaxes(m.world, 0, 1)

    @cached_property
    def jacobians(self) -> np.ndarray:
        """(K, P, 3, nv), their derivatives."""
        m = self.arrays
        return m.share[:, None, None] * points_of(self.mechanism, self.q, m.link, m.offset)[1]

    @cached_property
    def velocities(self) -> np.ndarray:
        """(K, P, 3) m/s of the points, by their Jacobians."""
        return np.einsum("npai,ni->npa", self.jacobians, self.v)

    def turning(self, p: int) -> np.ndarray:
        """(K, 3, nv), the derivative of point p's velocity by the configuration."""
        by_q = jacobian_derivatives(self.mechanism, self.q, self.frame(p))[:, :3]
        return self.arrays.share[p] * np.einsum("najk,nj->nak", by_q, self.v)

    def frame(self, p: int, rotation: np.ndarray | None = None) -> Frame:
        """The frame at point p with a rotation (3, 3) in its link's frame."""
        T = np.eye(4)
        T[:3, 3] = self.arrays.offset[p]
        if rotation is not None:
            T[:3, :3] = rotation
        return Frame(int(self.arrays.link[p]), T)

    def frame_of(self, t: int) -> Frame:
        """The frame that term t is about, with the rotation in its constants."""
        return self.frame(int(self.arrays.ends[t, 0]), self.arrays.constant[t, :9].reshape(3, 3))

    def pose(self, frame: Frame) -> np.ndarray:
        """(K, 4, 4) of a frame."""
        return frame_pose(self.mechanism, self.q, frame)

    def jacobian(self, frame: Frame) -> np.ndarray:
        """(K, 6, nv) of a frame: linear, then angular rows, in the world's axes."""
        return jacobian(self.mechanism, self.q, frame)

    def jacobian_rates(self, frame: Frame) -> np.ndarray:
        """(K, 6, nv): how the frame's velocity changes with the configuration."""
        return np.einsum("najk,nj->nak", jacobian_derivatives(self.mechanism, self.q, frame), self.v)
