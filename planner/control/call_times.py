"""How long planning calls of a controller take on this computer, and the latency and rate that they allow.

Latency and rate follow from processor time: what else runs on this computer now is not in it. The wall time that it
takes from a call, too, is counted as overruns.
"""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.control.controller import Controller

CALLS, SECONDS = 100, 2.0  # measured calls at most, and the wall time of all of them, s, after the first FEWEST
FEWEST = 10
_ROUND = (1.0, 2.0, 5.0, 10.0)  # latencies are rounded up to these numbers, so that most runs on a computer are equal


class CallTimes(NamedTuple):
    """Times of planning calls, s."""

    median: float
    percentile_99: float
    maximum: float
    calls: int

    @property
    def latency(self) -> float:
        """The 99th percentile, rounded up to 1, 2 or 5 times a power of ten, s."""
        scale = 10.0 ** math.floor(math.log10(self.percentile_99))
        return next(one * scale for one in _ROUND if one * scale >= self.percentile_99)


def times_of(seconds: np.ndarray) -> CallTimes:
    """The times of calls (M,), M > 0."""
    return CallTimes(float(np.median(seconds)), float(np.percentile(seconds, 99.0)), float(seconds.max()), len(seconds))


def measured_calls(controller: Controller) -> CallTimes:
    """Processor times of planning calls, one per period, in the problem's own dynamics; resets the controller."""
    controller.reset()
    controller.simulated = True
    dynamics, x, taken, began = controller.problem.dynamics, controller.problem.x0, list[float](), time.perf_counter()
    period = 1.0 / controller.rate
    for k in range(CALLS):
        u = controller(k * period, x)
        taken.append(controller.processor_seconds)
        if len(taken) >= FEWEST and time.perf_counter() - began > SECONDS:
            break
        for part in np.full(max(round(period / dynamics.dt), 1), dynamics.dt):
            x = dynamics.step(x[None], u[None], np.array([part]))[0]
    controller.reset()
    return times_of(np.array(taken))


def fitting_rate(controller: Controller, latency: float) -> float:
    """The highest rate, Hz, of one plan every whole number of stages, whose period is not shorter than a latency, s.

    Raises:
        PlannerError: No plan of the controller's horizon lasts that long.
    """
    dt, H = controller.problem.dynamics.dt, controller.horizon
    stages = max(math.ceil(latency / dt - 1e-9), 1)
    if stages > H:
        raise PlannerError(
            f"a call takes {1e3 * latency:.3g} ms and a plan ends after {1e3 * H * dt:.3g} ms, expected a longer "
            "horizon, or a faster computer."
        )
    return 1.0 / (stages * dt)
