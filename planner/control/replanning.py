"""Replanner: the window's solve from a measured or predicted state, warm-started by the plan before.

The plan before is shifted to the new time and rolled out from x with its gains. After a large push this rollout may
diverge, which one iteration does not correct. So where it costs more than THROWN times the planned cost, the first plan
of the task is rolled out from x too, and the cheaper rollout is the warm start. A number of SLQ iterations follows, or
those that fit in a budget of wall time: an iteration begins only if what one took lately fits in what is left.

Without a budget the last iteration of `prepare` is one of real-time iteration: the whole step is taken, and the rollout
that begins the next plan tells whether it lowered the cost. Where it did not, as after a push, the plan begins without
that step if this is cheaper, and its iterations search.
"""

from __future__ import annotations

import math
import time

import numpy as np

from planner.control.controller_states import Fault
from planner.control.receding_horizon import RecedingHorizonProblem
from planner.kernels.lq.line_search import ARMIJO
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.engine.protocol import TrajectoryArrays
from planner.solvers.options import DEFAULT, EXPECTED_REDUCTION_TOLERANCE
from planner.solvers.other_guesses import DIVERGENCE_FACTOR

SOLVED = 0.1  # upper limit of -slope / cost of a plan whose violations update the multipliers
THROWN = 2.0  # ratio of rollout cost to planned cost above which the first plan is tried as warm start
FORGOTTEN = 0.9  # per iteration: an estimate from one slow iteration of a busy computer decays


class Replanner:
    """Solves a window again and again.

    Attributes:
        trajectory: xs (H+1, nx), us (H, nu), K (H, nu, ndx) of the last plan, in memory of the engine.
        made: Time of its first state, s.
        stalls: Solves whose search found no lower cost: the shifted plan remains.
        iteration_seconds: Wall time of an iteration, s: the largest of late.
    """

    def __init__(
        self, problem: Problem, H: int, keeps: bool, iterations: int, budget: float | None, patience: int
    ) -> None:
        self.window = RecedingHorizonProblem(problem, H, keeps=keeps)
        self.engine, self.iteration_seconds = self.window.engine, 0.0
        self._problem, self._H, self._iterations, self._budget = problem, H, iterations, budget
        self._patience, self._dt = patience, problem.dynamics.dt

    def reset(self, plan: Plan) -> None:
        """Begin with the first plan of the task; one iteration loads the kernels and is timed."""
        self._first, self._mu, self._cost = plan, 0.0, math.inf
        self._step: np.ndarray | None = None  # (H, nu) of the last plan's controls, whose cost no rollout has told
        self.stalls = self._skipped = 0
        self.trajectory, self.made = self._first_plan(0), math.nan
        self.window.set_penalties(plan, self._problem.trajectory_constraints)  # resets the multipliers
        self.window.slide(0)
        for _ in range(2 if self._budget is not None else 0):  # the first one may load machine code
            cost = self.engine.start_from_controls(self._problem.x0, self.trajectory[1])
            self.iteration_seconds = 0.0
            self._iterate(cost, True)
        self.engine.start_from_controls(self._problem.x0, self.trajectory[1])

    def _first_plan(self, stage: int) -> TrajectoryArrays:
        """The first plan over the window from a stage of the task on; its last state and control after its end."""
        plan, n = self._first, stage + np.arange(self._H + 1)
        before = np.minimum(n[:-1], plan.N - 1)
        return plan.xs[np.minimum(n, plan.N)], plan.us[before], plan.K[before]

    def replan(
        self, t: float, x: np.ndarray, held: np.ndarray | None, leads_back: bool, searched: bool
    ) -> Fault | None:
        """Shift the plan to (t, x) and iterate; None or why it failed.

        Args:
            t: s.
            x: (nx,) state at t.
            held: (nu,) control that holds the machine, to begin with where the last plan is too old; or None.
            leads_back: Whether the first plan of the task may be the warm start.
            searched: Whether the last iteration has a line search, too.
        """
        engine, began = self.engine, time.perf_counter()
        cost, lowered = self._begin(t, x)
        searched = searched or self._budget is not None or not lowered
        if not math.isfinite(cost) and not np.isfinite(x).all():
            return Fault.NOT_FINITE_START
        if not cost <= THROWN * self._cost and leads_back:
            cost = self._back(t, x, cost)
        if not math.isfinite(cost) and held is not None:
            cost = engine.start_from_controls(x, np.tile(held, (self._H, 1)))
        if not math.isfinite(cost):
            return Fault.RUNS_AWAY
        fresh, kind, done, slope = True, CONVERGED, 0, 0.0
        while self._goes_on(began, done):
            whole = not searched and done == self._iterations - 1
            kind, slope, cost = self._sweep(cost, fresh) if whole else self._iterate(cost, fresh)
            done, fresh = done + 1, kind == ACCEPTED
            if kind == CONVERGED:
                break
        if not done:
            return Fault.BUDGET
        if kind == INDEFINITE:
            return Fault.INDEFINITE
        if not math.isfinite(slope):
            return Fault.GAINS
        plan = engine.read(DIVERGENCE_FACTOR) if math.isfinite(cost) else None
        self.stalls += kind not in (ACCEPTED, CONVERGED)
        if plan is None:
            return Fault.NOT_FINITE
        self.trajectory, self.made, self._cost = plan, t, cost
        self.window.update_hinges(plan[0], plan[1], cost, solved=-slope <= SOLVED * abs(cost))
        self._step = None if searched or kind != ACCEPTED else engine.whole_step()
        if self._step is not None:
            np.add(plan[1], self._step, out=plan[1])
        return None

    def _begin(self, t: float, x: np.ndarray) -> tuple[float, bool]:
        """Start from the last plan, moved on to (t, x): the cost, and whether a step without a search lowered it."""
        stages, step, us = (t - self.made) / self._dt, self._step, self.trajectory[1]
        cost = self.engine.start_from_trajectory(x, self.trajectory, stages)
        self._step = None
        if step is None or cost <= self._cost:
            return cost, True
        us -= step
        without = self.engine.start_from_trajectory(x, self.trajectory, stages)
        if cost < without:
            us += step
            return self.engine.start_from_trajectory(x, self.trajectory, stages), False
        return without, False

    def _sweep(self, cost: float, fresh: bool) -> tuple[int, float, float]:
        """An iteration whose whole step is taken without a rollout: its kind, slope, and the cost before it."""
        direction = self.engine.compute_direction(self._mu * self.engine.largest_control_weight, fresh)
        self._regularize(ACCEPTED if direction.definite else INDEFINITE, 1.0)
        return (ACCEPTED, direction.slope, cost) if direction.definite else (INDEFINITE, 0.0, cost)

    def _iterate(self, cost: float, fresh: bool) -> tuple[int, float, float]:
        """One iteration: its kind, slope and cost."""
        began = time.perf_counter()
        promise = -1.0 if self._mu else EXPECTED_REDUCTION_TOLERANCE * max(1.0, abs(cost))
        mu = self._mu * self.engine.largest_control_weight
        outcome = self.engine.iterate(True, ARMIJO, mu, fresh, cost, 0.0, promise)
        self._regularize(outcome.kind, outcome.step)
        self.iteration_seconds = max(time.perf_counter() - began, FORGOTTEN * self.iteration_seconds)
        return outcome.kind, outcome.slope, outcome.cost

    def _regularize(self, kind: int, step: float) -> None:
        """The weight of the next iteration, after one with a step of this length."""
        least, factor = DEFAULT.min_regularization, DEFAULT.regularization_factor
        if kind == ACCEPTED:
            self._mu = self._mu / factor if step >= 1.0 and self._mu > least else 0.0
        elif kind != CONVERGED:
            self._mu = min(max(least, factor * self._mu), DEFAULT.max_regularization)

    def _goes_on(self, began: float, done: int) -> bool:
        """Whether another iteration begins. Every `patience`-th plan has one at any cost, so that it is timed again."""
        if self._budget is None:
            return done < self._iterations
        fits = time.perf_counter() - began + self.iteration_seconds <= self._budget
        if done:
            return fits
        self._skipped = 0 if fits else self._skipped + 1
        return fits or self._skipped % self._patience == 0

    def _back(self, t: float, x: np.ndarray, cost: float) -> float:
        """Start from the rollout of the first plan if it is cheaper than that of the last one; the lower cost."""
        engine, (xs, us, K) = self.engine, [part.copy() for part in self.trajectory]  # the engine overwrites it
        first = self._first_plan(self.window.stage)
        back = engine.start_from_trajectory(x, first)
        if not math.isfinite(back) or back >= cost:
            self.trajectory = xs, us, K
            return engine.start_from_trajectory(x, self.trajectory, (t - self.made) / self._dt)
        self.trajectory, self.made = first, t
        return back
