"""One iteration of a Crocoddyl solver, again and again from the same trajectory. Needs Crocoddyl's environment."""

from __future__ import annotations

import time
from typing import Any

from serving import Answer, timed


class Iteration:
    """Linearize, sweep, try the full step, with a solver of a shooting problem from states xs and controls us."""

    def __init__(self, shooting: Any, solver: Any, xs: list[Any], us: list[Any], feasible: bool) -> None:
        shooting.nthreads = 1
        shooting.calc(xs, us)
        solver.solve(xs, us, 1, feasible)
        self._shooting, self._solver, self._start = shooting, solver, (xs, us, feasible)

    def rewind(self) -> None:
        """Back to the first trajectory, its dynamics computed."""
        xs, us, feasible = self._start
        self._shooting.calc(xs, us)
        self._solver.setCandidate(xs, us, feasible)

    def once(self) -> None:
        """One iteration."""
        self._solver.calcDiff()
        self._solver.backwardPass()
        self._solver.tryStep(1.0)

    def times(self, repeats: int, seconds: float) -> Answer:
        """Processor times of single iterations, as the benchmarks take of ours."""
        return {"times": timed(self.once, self.rewind, repeats, seconds, time.process_time)}
