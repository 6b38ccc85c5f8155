"""Anderson acceleration of slowly converging steps (Walker and Ni 2011).

The Gauss-Newton Hessian leaves out the second derivatives of the dynamics, so its steps d(U) converge only linearly.
The columns of Y and S are the changes of d and of the controls over the last iterations. With c minimizing |d - Y c|
the extrapolated point is

    U + d - (S + Y) c,

a multisecant quasi-Newton step. States are extrapolated likewise and tracked with the gains of the last sweep. The
point is accepted, with backtracking, if it costs less than the plain step.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque

import numpy as np

from planner.model.space import space_of
from planner.problem.problem import Problem
from planner.solvers.engine import Engine
from planner.solvers.options import SolverOptions

RANK_TOLERANCE = 1e-12  # relative to the largest eigenvalue of Y'Y: smaller ones are rounding

StatesAndControls = tuple[np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu)


class AndersonAcceleration:
    """Anderson acceleration over the last steps of one solve.

    Args:
        problem: Problem of the engine.
        engine: Started.
        options: The constants of the acceleration.
    """

    def __init__(self, problem: Problem, engine: Engine, options: SolverOptions) -> None:
        self._engine, self._space, self._options = engine, space_of(problem.dynamics), options
        self._begin: StatesAndControls | None = None  # trajectory at the start of the next iteration
        self._before: StatesAndControls | None = None  # and of the one before
        # Changes of controls and states: directions d, and differences between the starts of successive iterations.
        self._directions: deque[np.ndarray] = deque(maxlen=options.acceleration_steps)
        self._differences: deque[np.ndarray] = deque(maxlen=options.acceleration_steps - 1)

    def extrapolate(self, cost: float, after: float, step: float, expected: float) -> float:
        """The cost of the extrapolated point, if the engine accepts it, else `after`.

        Args:
            cost: Cost before the step.
            after: Cost after the step.
            step: Step length.
            expected: Expected reduction of the step.
        """
        reduction = cost - after
        if reduction > self._options.acceleration_max_reduction * max(1.0, abs(after)):
            self._directions.clear()
            self._differences.clear()
            self._begin = self._before = None
            return after
        end = self._engine.trajectory()
        begin, self._begin = self._begin, end
        if begin is None:
            return after
        self._directions.append(self._change(begin, end) / step)
        if self._before is not None:
            self._differences.append(self._change(self._before, begin))
        self._before = begin
        accurate = step == 1.0 and abs(reduction - expected) < self._options.acceleration_model_error * expected
        if accurate or not self._differences:
            return after
        part, extrapolated = self._engine.backtrack_along(*self._point(end[1].shape, step), after)
        if part > 0.0:
            self._begin = self._engine.trajectory()
        return extrapolated

    def _change(self, begin: StatesAndControls, end: StatesAndControls) -> np.ndarray:
        """Change of the controls, then of the states, as one vector (N nu + (N+1) ndx,)."""
        return np.concatenate([(end[1] - begin[1]).ravel(), self._space.difference(end[0], begin[0]).ravel()])

    def _point(self, us: tuple[int, ...], step: float) -> StatesAndControls:
        """Changes of states (N+1, ndx) and controls (N, nu) from the end of the step to the extrapolated point."""
        directions, size = np.stack(self._directions), math.prod(us)
        d, Y, S = directions[-1], np.diff(directions, axis=0), np.stack(self._differences)
        by_controls, c = Y[:, :size], np.zeros(len(Y))
        with contextlib.suppress(np.linalg.LinAlgError):  # before convergence squares may overflow
            c = np.linalg.lstsq(by_controls @ by_controls.T, by_controls @ d[:size], rcond=RANK_TOLERANCE)[0]
        change = (1.0 - step) * d - c @ (S + Y)
        return change[size:].reshape(us[0] + 1, -1), change[:size].reshape(us)
