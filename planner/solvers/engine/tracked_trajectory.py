"""TrackedTrajectory: a trajectory with gains that a controller tracks while a solve writes the next to other memory."""

from __future__ import annotations

import numpy as np

from planner.kernels.lq.tracked_trajectory import FOLLOWED, load_tracked, store_tracked
from planner.kernels.lq.workspace import Workspace
from planner.kernels.numba.lanes import lane_array
from planner.model.space import StateSpace

TrajectoryArrays = tuple[np.ndarray, np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu), K (N, nu, ndx)
StatesAndControls = tuple[np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu)

TIME_TOLERANCE = 1e-6  # of a stage: smaller differences of time are zero
_STAGES = FOLLOWED.stages


def shift_trajectory(target: StatesAndControls, source: StatesAndControls, stages: float, space: StateSpace) -> int:
    """Write states and controls shifted by a real number of stages; after the end the last ones repeat.

    Args:
        target: Written arrays.
        source: Arrays of the same shapes.
        stages: At least 0.
        space: Of the states.

    Returns:
        The number of whole stages, by which gains shift.
    """
    (xs, us), (own_xs, own_us) = target, source
    m = int(stages + TIME_TOLERANCE)
    part, m = stages - m, min(m, len(us))
    if m == 0:
        xs[:], us[:] = own_xs, own_us
    else:
        left = len(us) - m
        xs[: left + 1], us[:left] = own_xs[m:], own_us[m:]
        xs[left + 1 :], us[left:] = own_xs[-1], own_us[-1]
    if part > TIME_TOLERANCE:
        xs[:-1] = space.integrate(xs[:-1], part * space.difference(xs[1:], xs[:-1]))
    return m


class TrackedTrajectory:
    """A trajectory with gains, with memory for N more stages after its end: it can be tracked from any stage on.

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
        """Copy a trajectory, unless it is this one."""
        if trajectory[2] is not self.K:
            self.xs[:], self.us[:], self.K[:] = trajectory

    def begin(self, w: Workspace, x0: np.ndarray, stages: float) -> None:
        """Load it, shifted by `stages`, into a solve that starts at x0 (nx,); rollouts use its gains."""
        m = int(stages + TIME_TOLERANCE)
        if stages - m > TIME_TOLERANCE:
            m = self._between(w, x0, stages)
        else:
            m = min(m, self._N)
            self._table[_STAGES], self._x0[:] = m, x0
            load_tracked(w.table, self._table)
        w.use_gains(self._first, self._address + m * self._stride)

    def _between(self, w: Workspace, x0: np.ndarray, stages: float) -> int:
        """As load_tracked, for a fractional shift; returns the number of whole stages."""
        N = self._N
        m = shift_trajectory((w.xs, w.us), (self.xs, self.us), stages, self._space)
        self._rows[N : N + m] = self._rows[N - 1]
        w.k.fill(0.0)
        w.us[0] += self.K[min(m, N - 1)] @ self._space.single_difference(x0, w.xs[0])
        w.xs[0] = x0
        return m

    def use(self, w: Workspace) -> None:
        """Let the next sweep write its gains to this memory."""
        w.use_gains(self._first, self._address)

    def keep(self, w: Workspace) -> float:
        """Copy a solve's trajectory, whose gains are already in this memory; the squared norm of its last state."""
        return store_tracked(w.table, self._table)
