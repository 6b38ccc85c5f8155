"""Followed: the memory of a plan that a controller follows while the next one is made in the memory of a solve."""

from __future__ import annotations

import numpy as np

from planner.kernels.lq.tracked_trajectory import FOLLOWED, load_tracked, store_tracked
from planner.kernels.lq.workspace import Workspace
from planner.kernels.numba.lanes import lane_array
from planner.model.space import StateSpace
from planner.solvers.engine.warm_start_shift import TIME_TOLERANCE, TrajectoryArrays, shift_trajectory

_STAGES = FOLLOWED.stages


class TrackedTrajectory:
    """A trajectory with gains, which have room after their end, so that they can be followed from any stage on.

    Attributes:
        xs: (N+1, nx).
        us: (N, nu).
        K: (N, nu, ndx) a view of the gains.
        trajectory: The three.
    """

    def __init__(self, w: Workspace, space: StateSpace) -> None:
        self._space, self._N, (nu, width) = space, len(w.us), w.K.shape[1:]
        self.xs, self.us, self._x0 = np.zeros_like(w.xs), np.zeros_like(w.us), np.zeros(w.xs.shape[1])
        self._rows = lane_array(2 * self._N, nu, width)
        self._address, self._stride = self._rows.ctypes.data, self._rows.strides[0]
        self._first = self._rows[: self._N]
        self.K = self._first[:, :, w.first : w.first + w.ndx]
        self.trajectory = self.xs, self.us, self.K
        arrays = {"x0": self._x0, "xs": self.xs, "us": self.us, "K": self._rows}
        self._table = FOLLOWED.table({"stages": 0}, arrays)

    def take(self, trajectory: TrajectoryArrays) -> None:
        """Copy a trajectory that is not this one already."""
        if trajectory[2] is not self.K:
            self.xs[:], self.us[:], self.K[:] = trajectory

    def begin(self, w: Workspace, x0: np.ndarray, stages: float) -> None:
        """Write it into the memory of a solve, some stages on and from x0 (nx,), and have its gains followed."""
        m = int(stages + TIME_TOLERANCE)
        if stages - m > TIME_TOLERANCE:
            m = self._between(w, x0, stages)
        else:
            m = min(m, self._N)
            self._table[_STAGES], self._x0[:] = m, x0
            load_tracked(w.table, self._table)
        w.use_gains(self._first, self._address + m * self._stride)

    def _between(self, w: Workspace, x0: np.ndarray, stages: float) -> int:
        """As load_tracked, by any number of stages; the whole ones."""
        N = self._N
        m = shift_trajectory((w.xs, w.us), (self.xs, self.us), stages, self._space)
        self._rows[N : N + m] = self._rows[N - 1]
        w.k.fill(0.0)
        w.us[0] += self.K[min(m, N - 1)] @ self._space.single_difference(x0, w.xs[0])
        w.xs[0] = x0
        return m

    def use(self, w: Workspace) -> None:
        """Have the next sweep write its gains here."""
        w.use_gains(self._first, self._address)

    def keep(self, w: Workspace) -> float:
        """Copy the trajectory of a solve, whose gains are here already; the square of the norm of its last state."""
        return store_tracked(w.table, self._table)
