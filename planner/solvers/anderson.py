"""Anderson's acceleration: where steps converge slowly, a guess of where they lead (Walker and Ni 2011).

The Hessian of Gauss and Newton leaves out what the dynamics bend, so their steps d(U) converge only linearly. How d
changes along the last iterations is known, though: where controls move by S c it changes by Y c. The point with the
least direction, min |d - Y c|, is then

    U + d - (S + Y) c,

which is the step of a quasi-Newton method with several secants, without any second derivative. The states are guessed
in the same way, and rollouts with the gains of the last sweep keep near them. The guess is taken, or a half or less of
the way to it, if that costs less than where the step led.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque

import numpy as np

from planner.model.space import space_of
from planner.problem.problem import Problem
from planner.solvers.engine import Engine, IterationResult

STEPS = 5  # that are remembered: more are of a motion too far away
MAX_REDUCTION = 1e-3  # of the cost: steps that gain more are far from a minimum, and tell nothing of it
PROMISED = 0.1  # of its promise: a full step whose gain is off by less has a right model, and converges fast by itself
DEPENDENT = 1e-12  # of the largest eigenvalue of Y'Y: changes of the direction that are rounding

Motion = tuple[np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu)


class AndersonAcceleration:
    """The last steps of one solve.

    Args:
        problem: Whose engine it is.
        engine: After its start.
    """

    def __init__(self, problem: Problem, engine: Engine) -> None:
        self._engine, self._space = engine, space_of(problem.dynamics)
        self._begin: Motion | None = None  # of the next iteration
        self._before: Motion | None = None  # of the one before it
        # Changes of controls and states: directions, and ways from where one iteration began to where the next did.
        self._directions: deque[np.ndarray] = deque(maxlen=STEPS)
        self._ways: deque[np.ndarray] = deque(maxlen=STEPS - 1)

    def after(self, cost: float, done: IterationResult) -> float:
        """The cost after a step from this cost: the step's, or that of a guess that the engine then has."""
        gained = cost - done.cost
        if gained > MAX_REDUCTION * max(1.0, abs(done.cost)):
            self._directions.clear()
            self._ways.clear()
            self._begin = self._before = None
            return done.cost
        end = self._engine.trajectory()
        begin, self._begin = self._begin, end
        if begin is None:
            return done.cost
        self._directions.append(self._change(begin, end) / done.step)
        if self._before is not None:
            self._ways.append(self._change(self._before, begin))
        self._before = begin
        right = done.step == 1.0 and abs(gained - done.expected) < PROMISED * done.expected
        if right or not self._ways:
            return done.cost
        step, after = self._engine.backtrack_along(*self._guess(us=end[1].shape, share=done.step), done.cost)
        if step > 0.0:
            self._begin = self._engine.trajectory()
        return after

    def _change(self, begin: Motion, end: Motion) -> np.ndarray:
        """Of the controls, then of the states, as one vector."""
        return np.concatenate([(end[1] - begin[1]).ravel(), self._space.difference(end[0], begin[0]).ravel()])

    def _guess(self, us: tuple[int, ...], share: float) -> Motion:
        """Changes of states and controls from where the last step led, after this share, to where the steps lead."""
        directions, size = np.stack(self._directions), math.prod(us)
        d, Y, S = directions[-1], np.diff(directions, axis=0), np.stack(self._ways)
        by_controls, c = Y[:, :size], np.zeros(len(Y))
        with contextlib.suppress(np.linalg.LinAlgError):  # of motions so far away that squares overflow
            c = np.linalg.lstsq(by_controls @ by_controls.T, by_controls @ d[:size], rcond=DEPENDENT)[0]
        way = (1.0 - share) * d - c @ (S + Y)
        return way[size:].reshape(us[0] + 1, -1), way[:size].reshape(us)
