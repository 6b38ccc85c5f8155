"""Anderson acceleration of steps that converge slowly (Walker and Ni 2011).

The Gauss-Newton Hessian leaves out the second derivatives of the dynamics, so its steps d(U) converge only linearly.
Over the last iterations d changed by Y c where controls changed by S c. The point of least direction, min |d - Y c|, is

    U + d - (S + Y) c,

the step of a quasi-Newton method with several secants, without second derivatives. States are extrapolated in the same
way, and rollouts with the gains of the last sweep stay near them. The point is taken, or a half or less of the way to
it, if it costs less than the step did.
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
    """The last steps of one solve.

    Args:
        problem: Of the engine.
        engine: After its start.
        options: The constants of the acceleration.
    """

    def __init__(self, problem: Problem, engine: Engine, options: SolverOptions) -> None:
        self._engine, self._space, self._options = engine, space_of(problem.dynamics), options
        self._begin: StatesAndControls | None = None  # of the next iteration
        self._before: StatesAndControls | None = None  # of the one before it
        # Changes of controls and states: directions d, and differences between the starts of successive iterations.
        self._directions: deque[np.ndarray] = deque(maxlen=options.acceleration_steps)
        self._differences: deque[np.ndarray] = deque(maxlen=options.acceleration_steps - 1)

    def extrapolate(self, cost: float, after: float, step: float, expected: float) -> float:
        """The cost after a step from `cost` to `after`, or that of the extrapolated point, which the engine then has.

        Args:
            cost: Before the step.
            after: After it.
            step: Its length.
            expected: Its expected reduction.
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
        """Of the controls, then of the states, as one vector."""
        return np.concatenate([(end[1] - begin[1]).ravel(), self._space.difference(end[0], begin[0]).ravel()])

    def _point(self, us: tuple[int, ...], step: float) -> StatesAndControls:
        """Changes of states and controls from the end of the last step, of this length, to the extrapolated point."""
        directions, size = np.stack(self._directions), math.prod(us)
        d, Y, S = directions[-1], np.diff(directions, axis=0), np.stack(self._differences)
        by_controls, c = Y[:, :size], np.zeros(len(Y))
        with contextlib.suppress(np.linalg.LinAlgError):  # far from a minimum squares may overflow
            c = np.linalg.lstsq(by_controls @ by_controls.T, by_controls @ d[:size], rcond=RANK_TOLERANCE)[0]
        change = (1.0 - step) * d - c @ (S + Y)
        return change[size:].reshape(us[0] + 1, -1), change[:size].reshape(us)
