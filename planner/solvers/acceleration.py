"""Anderson's acceleration: where steps converge slowly, a guess of where they lead (Walker and Ni 2011).

The Hessian of Gauss and Newton leaves out what the dynamics bend, so their steps d(U) converge only linearly. How d
changes along the last iterations is known, though: where controls move by S c it changes by Y c. The point with the
least direction, min |d - Y c|, is then

    U + d - (S + Y) c,

which is the step of a quasi-Newton method with several secants, without any second derivative. The states are guessed
in the same way, and a rollout with the gains of the last sweep keeps near them. It is taken only if it costs less than
where the step led; else that is rolled out again, bit for bit.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from planner.model.space import space_of
from planner.problem.problem import Problem
from planner.solvers.engine import Engine, Outcome

STEPS = 5  # that are remembered: more are of a motion too far away
NEAR = 1e-2  # of the cost: steps that gain more are far from a minimum, and tell nothing of it
SLOW = 0.1  # of the last gain: steps that gain less converge fast by themselves
DEPENDENT = 1e-8  # of the largest singular value: changes of the direction that are rounding

Motion = tuple[np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu)


class _Step(NamedTuple):
    """Where an iteration began, where it led, and the share of its direction that was taken."""

    begin: Motion
    end: Motion
    share: float


class Acceleration:
    """The last steps of one solve.

    Args:
        problem: Whose engine it is.
        engine: After its start.
    """

    def __init__(self, problem: Problem, engine: Engine) -> None:
        self._engine, self._space = engine, space_of(problem.dynamics)
        self._steps: deque[_Step] = deque(maxlen=STEPS)
        self._begin: Motion | None = None  # of the next iteration
        self._gained = 0.0

    def after(self, cost: float, done: Outcome) -> float:
        """The cost after a step from this cost: the step's, or that of a guess that the engine then has."""
        gained, before = cost - done.cost, self._gained
        self._gained = gained
        if gained > NEAR * max(1.0, abs(done.cost)):
            self._steps.clear()
            self._begin = None
            return done.cost
        begin, end = self._begin, self._engine.trajectory()
        self._begin = end
        if begin is None:
            return done.cost
        self._steps.append(_Step(begin, end, done.step))
        if len(self._steps) < 2 or gained < SLOW * before:
            return done.cost
        guessed = np.inf
        try:
            xs, us = self._guess()
            guessed = self._engine.approach(us, xs)
        finally:  # also where Ctrl-C came in between
            if not guessed < done.cost:
                self._engine.approach(end[1])
        if not guessed < done.cost:
            return done.cost
        self._begin = self._engine.trajectory()
        return guessed

    def _guess(self) -> Motion:
        """Where the steps lead."""
        (xs, us), difference = self._steps[-1].begin, self._space.difference
        begins = np.stack([_flat(difference(step.begin[0], xs), step.begin[1] - us) for step in self._steps])
        moves = np.stack([
            _flat(difference(step.end[0], step.begin[0]), step.end[1] - step.begin[1]) / step.share
            for step in self._steps
        ])  # fmt: skip
        S, Y, d = np.diff(begins, axis=0), np.diff(moves, axis=0), moves[-1]
        controls = slice(0, us.size)
        c = np.linalg.lstsq(Y[:, controls].T, d[controls], rcond=DEPENDENT)[0]
        way = d - c @ (S + Y)
        return self._space.integrate(xs, way[us.size :].reshape(len(xs), -1)), us + way[controls].reshape(us.shape)


def _flat(dxs: np.ndarray, dus: np.ndarray) -> np.ndarray:
    """Changes of the controls, then of the states, as one vector."""
    return np.concatenate([dus.ravel(), dxs.ravel()])
