"""TrackedPlan: u = us[n] + K[n] (x - xs(t)) of a plan from the time on that it was made for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.model.space import space_of
from planner.solvers.engine.protocol import TrajectoryArrays

TIME_TOLERANCE = 1e-6  # of a stage: smaller differences of time are zero


class TrackedPlan:
    """A plan that feedback tracks.

    Attributes:
        xs: (N+1, nx).
        us: (N, nu).
        K: (N, nu, ndx).
        made: Time of its first state, s; nan before the task begins.
    """

    def __init__(self, dynamics: Any, trajectory: TrajectoryArrays, made: float) -> None:
        self._dynamics, self._dt, self._space = dynamics, dynamics.dt, space_of(dynamics)
        (self.xs, self.us, self.K), self.made = trajectory, made

    def _stages(self, t: float) -> tuple[int, float]:
        """Whole stages from its begin to t, s, and the part of the next one."""
        stages = 0.0 if math.isnan(self.made) else max((t - self.made) / self._dt, 0.0)
        n = int(stages + TIME_TOLERANCE)
        return n, stages - n

    def ended(self, t: float) -> bool:
        """Whether it has no stage at t, s."""
        return self._stages(t)[0] >= len(self.us)

    def feedforward(self, t: float) -> np.ndarray:
        """The planned control (nu,) at t, s; after the end the last one."""
        return self.us[min(self._stages(t)[0], len(self.us) - 1)]

    def control(self, t: float, x: np.ndarray) -> np.ndarray:
        """The control (nu,) with feedback at t, s, and x (nx,), before bounds."""
        n = min(self._stages(t)[0], len(self.us) - 1)
        return self.us[n] + self.K[n] @ self._space.single_difference(x, self.expected(t))

    def expected(self, t: float) -> np.ndarray:
        """The planned state (nx,) at t, s, integrated from the knot before; after the end the last one."""
        n, part = self._stages(t)
        if n >= len(self.us) or part <= TIME_TOLERANCE:
            return self.xs[min(n, len(self.us))].copy()  # the next plan overwrites the memory
        return self._dynamics.step(self.xs[n : n + 1], self.us[n : n + 1], np.array([part * self._dt]))[0]
