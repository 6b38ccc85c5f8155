"""Controller: u = controller(t, x), model predictive control that replans from the measured state.

    plan     at the rate, from the measured x: warm start from the last plan, shifted by the elapsed time and rolled out
             from x with its gains; then a fixed number of SLQ iterations (solvers.slq), or a time budget of them
    between  u = us[n] + K[n] (x - xs(t)), within bounds, so that it may be called more often than it plans

After a large push the rollout of the last plan may diverge, which one iteration does not correct. So where it costs
more than THROWN times the planned cost, the first plan of the task is rolled out from x too, and the cheaper rollout is
the warm start.

After a failed solve the last plan continues, with an event. After the last stage of that plan, or after `patience`
failures in a row, the control is gravity compensation and damping within the bounds (planner.control.fallback_control).
Solves continue, and the first success is an event.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, count, number, short_repr
from planner.base.errors import PlannerError
from planner.control.fallback_control import FallbackControl, equilibrium_control
from planner.control.receding_horizon import RecedingHorizonProblem
from planner.control.window_parts import TIME_TOLERANCE, goal_states, goal_stays, horizon_and_rate, state_after
from planner.kernels.lq.line_search import ARMIJO
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE
from planner.model.space import space_of
from planner.problem.costs.tracking import states
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.engine.tracked_trajectory import TrajectoryArrays
from planner.solvers.options import DEFAULT, EXPECTED_REDUCTION_TOLERANCE
from planner.solvers.slq import solve
from planner.solvers.stabilizing_guess import DIVERGENCE_FACTOR

PATIENCE = 10  # failed solves in a row before gravity compensation and damping
SOLVED = 0.1  # upper limit of -slope / cost of a plan whose violations update the multipliers
THROWN = 2.0  # ratio of rollout cost to planned cost above which the first plan is tried as warm start
_MAX_EVENTS = 1000


class ControllerStatus(StrEnum):
    """State of a controller; its value is a sentence."""

    PLANNING = "It follows the plan that it has just made."
    LAST_PLAN = "The last solve failed; it goes on with the plan before."
    HOLDING = "It holds the machine where it is, by gravity compensation and damping, until a solve succeeds."


class Event(NamedTuple):
    """A message of a controller with its time."""

    t: float  # s
    words: str

    def __str__(self) -> str:
        return f"t = {self.t:.4g} s: {self.words}"


class Controller:
    """Model predictive control of a problem from the measured state; `u = controller(t, x)`.

    Args:
        problem: The task. Its time begins with the first call after a reset; its goal remains after its end.
        horizon: Number of stages of each plan; by default that of the problem.
        rate: Plans per second, Hz; at most one per stage, which is the default.
        iterations: SLQ iterations of each plan.
        budget: s, in place of a number of iterations: as many as begin within it, at least one. Results then depend on
            the computer.
        patience: Failed solves in a row before gravity compensation and damping.
        plan: The first plan of the problem; solved by default.
        latency: s, from a planning call until its control acts. It plans for that instant, from the state that the
            problem's dynamics predict for then under the present control.

    Attributes:
        plan: The first plan of the whole task, converged; solved again by reset(x0).
        status: A ControllerStatus.
        events: Failures and recoveries, each with its time.
        failures: Failed solves since the reset.
        plans: Plans made since the reset.
        planned: Whether the last call made a plan.
        keeps_goal: Whether the goal remains after the end of the task: some control makes it an equilibrium.
        seconds: Wall-clock time of the last planning call, s; 0 where it did not plan.

    Raises:
        PlannerError: A rate above one plan per stage, a number out of range, a cost without a window (see
            window_parts.parts_of), a first solve that diverges.
    """

    def __init__(
        self, problem: Problem, horizon: int | None = None, rate: float | None = None, iterations: int = 1,
        budget: float | None = None, patience: int = PATIENCE, plan: Plan | None = None, latency: float = 0.0,
    ) -> None:  # fmt: skip
        H, rate = horizon_and_rate(problem, horizon, rate)
        dt = problem.dynamics.dt
        self.problem, self.horizon, self.rate = problem, H, rate
        self.iterations = count("iterations", iterations)
        self.budget = None if budget is None else number("budget", budget, greater_than=0.0)
        self.patience = count("patience", patience)
        self.latency = number("latency", latency, minimum=0.0)
        self._dt, self._space, self._bounds = dt, space_of(problem.dynamics), problem.bounds
        # The goal remains after the end of the task if some control makes it an equilibrium.
        self._window, self._holding = (
            RecedingHorizonProblem(problem, H, keeps=goal_stays(problem)),
            FallbackControl(problem),
        )
        self._engine = self._window.engine
        if plan is not None and (not isinstance(plan, Plan) or plan.us.shape != (problem.N, problem.dynamics.nu)):
            raise PlannerError(f"plan is {short_repr(plan)}, expected a Plan of the problem, or None.")
        self.plan = self._solved(problem.x0) if plan is None else plan
        self.keeps_goal = self._window.keeps
        self._goal: Any = None
        self._new_goal: np.ndarray | None = None
        self.reset()

    def __repr__(self) -> str:
        return (
            f"Controller({self.horizon} stages of {self._dt:g} s, {self.rate:g} Hz, iterations {self.iterations}: "
            f"{self.status.name.lower().replace('_', ' ')})"
        )

    def _solved(self, x0: np.ndarray) -> Plan:
        """The plan of the whole task from a state x0 (nx,)."""
        asked = self.problem if np.array_equal(x0, self.problem.x0) else replace(self.problem, x0=x0)
        plan = solve(asked)
        if not (np.isfinite(plan.xs).all() and np.isfinite(plan.K).all()):
            raise PlannerError(f"the controller has no plan to begin with: {plan.message}")
        return plan

    def reset(self, x0: Any = None) -> None:
        """Restart the task with the next call; from another start (nx,) after a new solve."""
        if x0 is not None:
            self.plan = self._solved(states("x0", x0, self._space, ()))
        self._xs, self._us, self._K = self._plan_now = self._first_plan(0)
        self._window.set_penalties(self.plan, self.problem.trajectory_constraints)  # resets the multipliers
        self._window.slide(0)
        self._engine.start_from_controls(self.problem.x0, self._us)
        self._begin, self._made, self._asked = math.nan, math.nan, -math.inf
        self._mu, self._in_a_row, self._cost = 0.0, 0, math.inf
        self.status, self.events = ControllerStatus.PLANNING, list[Event]()
        self.failures = self.plans = self.stalls = 0
        self.planned, self.seconds = False, 0.0
        self._acting = self._us[0].copy()
        if self._goal is None:
            end = self.plan.xs[-1] if self._window.frames else self._window.x_ref[-1]
            self._rest = equilibrium_control(self.problem, end, self.plan.us[-1])
            self._window.rest(self._rest)

    @property
    def goal(self) -> Any:
        """The goal of the task; it may be set at any time.

        A keyframe's name, positions (nq,), a state (nx,) or its trajectory over the horizon (horizon + 1, nx); or a
        table of frames with world positions, m, (3,) or (horizon + 1, 3): {"hand": [0.4, 0, 0.6]}.
        """
        return self._window.x_ref[-1].copy() if self._goal is None else self._goal

    @goal.setter
    def goal(self, goal: Any) -> None:
        if isinstance(goal, Mapping):
            if not self._window.frames:
                raise PlannerError("goal is a table of frames and no frame of this problem has one, expected a state.")
            for frame, places in goal.items():
                shape = (3,) if np.ndim(places) < 2 else (self.horizon + 1, 3)
                self._window.point(str(frame), array(f"the goal of {frame}", places, shape))
        else:
            self._new_goal = goal_states(self.problem, goal, self.horizon)  # used by the next plan
        self._goal = goal

    def __call__(self, t: float, x: np.ndarray) -> np.ndarray:
        """The control (nu,) at time t, s, and state x (nx,); plans if a plan is due.

        Times must not decrease between resets. The state of a Mechanism is MuJoCo's qpos, qvel and act.
        """
        self.planned, self.seconds = False, 0.0
        if (t - self._asked) * self.rate >= 1.0 - TIME_TOLERANCE:
            began = time.perf_counter()
            self._asked = t
            if self.latency:
                t, x = t + self.latency, state_after(self.problem, x, self._acting, self.latency)
            self.make_plan(t, x)
            self.planned, self.seconds = True, time.perf_counter() - began
            if self.status is ControllerStatus.PLANNING:
                self._acting = self._us[0].copy()
                return self._acting
        self._acting = self.control(t, x)
        return self._acting

    def make_plan(self, t: float, x: np.ndarray) -> bool:
        """Plan from x (nx,) at time t, s; whether it succeeded. `control` then tracks the plan."""
        if math.isnan(self._begin):
            self._begin = self._made = t - self.latency
        stage = int((t - self._begin) / self._dt + TIME_TOLERANCE)
        if self._new_goal is not None:
            last = np.atleast_2d(self._new_goal)[-1]
            self._rest = equilibrium_control(self.problem, last, self._us[-1] if self._rest is None else self._rest)
            self._window.aim(self._new_goal, self._rest, stage)
            self._new_goal = None
        self._window.slide(stage)
        trouble = self._solve(t, x)
        if trouble:
            self._failed(t, trouble)
            return False
        if self._in_a_row:
            self._say(t, f"a solve succeeded after {self._in_a_row} that failed.")
        self._made, self._in_a_row, self.status = t, 0, ControllerStatus.PLANNING
        self.plans += 1
        return True

    def _solve(self, t: float, x: np.ndarray) -> str:
        """Shift the plan to (t, x) and iterate; "" or the reason of failure."""
        engine, began = self._engine, time.perf_counter()
        cost = engine.start_from_trajectory(x, self._plan_now, (t - self._made) / self._dt)
        if not cost <= THROWN * self._cost and self._has_way_back(x):
            cost = self._back(t, x, cost)
        if not math.isfinite(cost) and not np.isfinite(x).all():
            return "the measured state is not finite"
        if not math.isfinite(cost) and self.status is ControllerStatus.HOLDING:  # the last plan is too old
            held = self._holding(x, self._us[-1])
            cost = engine.start_from_controls(x, np.tile(held, (self.horizon, 1)))
        if not math.isfinite(cost):
            return "the plan before, followed from here, runs away"
        least, factor = DEFAULT.min_regularization, DEFAULT.regularization_factor
        fresh, kind, done, slope = True, CONVERGED, 0, 0.0
        while done < self.iterations if self.budget is None else self._within(began, done):
            mu = self._mu * engine.largest_control_weight
            promise = -1.0 if self._mu else EXPECTED_REDUCTION_TOLERANCE * max(1.0, abs(cost))
            outcome = engine.iterate(True, ARMIJO, mu, fresh, cost, 0.0, promise)
            done, kind, fresh, cost = done + 1, outcome.kind, outcome.kind == ACCEPTED, outcome.cost
            slope = outcome.slope
            if kind == CONVERGED:
                break
            if fresh:
                self._mu = self._mu / factor if outcome.step >= 1.0 and self._mu > least else 0.0
            else:
                self._mu = min(max(least, factor * self._mu), DEFAULT.max_regularization)
        if kind == INDEFINITE:
            return "the sweep is not definite"
        if not math.isfinite(slope):
            return "the gains are not finite"
        self.stalls += kind not in (ACCEPTED, CONVERGED)  # no step lowers the cost: the shifted plan remains
        plan = engine.read(DIVERGENCE_FACTOR) if math.isfinite(cost) else None
        if plan is None:
            return "the plan is not finite"
        self._xs, self._us, self._K = self._plan_now = plan
        self._window.update_hinges(self._xs, self._us, cost, solved=-slope <= SOLVED * abs(cost))
        self._cost = cost
        return ""

    def _has_way_back(self, x: np.ndarray) -> bool:
        """Whether the first plan may be rolled out from x: the goal is unchanged and the task has not ended."""
        return self._goal is None and self._window.stage < self.problem.N and bool(np.isfinite(x).all())

    def _back(self, t: float, x: np.ndarray, cost: float) -> float:
        """Start from the rollout of the first plan if it is cheaper than that of the last one; the lower cost."""
        engine, last = self._engine, [part.copy() for part in self._plan_now]  # the engine overwrites it
        first = self._first_plan(self._window.stage)
        back = engine.start_from_trajectory(x, first)
        if not math.isfinite(back) or back >= cost:
            self._xs, self._us, self._K = self._plan_now = last[0], last[1], last[2]
            return engine.start_from_trajectory(x, self._plan_now, (t - self._made) / self._dt)
        self._xs, self._us, self._K = self._plan_now = first
        self._made = t
        return back

    def _first_plan(self, stage: int) -> TrajectoryArrays:
        """The first plan over the window from a stage of the task on; its last state and control after its end."""
        plan, n = self.plan, stage + np.arange(self.horizon + 1)
        before = np.minimum(n[:-1], plan.N - 1)
        return plan.xs[np.minimum(n, plan.N)], plan.us[before], plan.K[before]

    def _within(self, began: float, done: int) -> bool:
        assert self.budget is not None
        return done == 0 or time.perf_counter() - began < self.budget

    def _failed(self, t: float, trouble: str) -> None:
        self.failures, self._in_a_row = self.failures + 1, self._in_a_row + 1
        if self.status is not ControllerStatus.HOLDING:
            self.status = ControllerStatus.LAST_PLAN
        if self._in_a_row == 1:
            self._say(t, f"a solve failed, {trouble}; it goes on with the plan before.")
        if self._in_a_row == self.patience:
            self._hold(t, f"{self.patience} solves failed in a row")

    def _hold(self, t: float, why: str) -> None:
        if self.status is not ControllerStatus.HOLDING:
            how = "by gravity compensation and damping" if self._holding.known else "by the last control of its plan"
            self._say(t, f"{why}; it holds the machine {how}.")
        self.status = ControllerStatus.HOLDING

    def _say(self, t: float, words: str) -> None:
        if len(self.events) < _MAX_EVENTS:
            self.events.append(Event(t, words))

    def control(self, t: float, x: np.ndarray) -> np.ndarray:
        """The control (nu,) at time t, s, and state x (nx,) of the last plan with its feedback."""
        if math.isnan(self._made):
            raise PlannerError("the controller has not planned yet, expected controller(t, x) before control(t, x).")
        stages = max((t - self._made) / self._dt, 0.0)
        n = int(stages + TIME_TOLERANCE)
        if n >= self.horizon and self.status is not ControllerStatus.PLANNING:
            self._hold(t, "the plan has ended")
        at = min(int((t - self._begin) / self._dt + TIME_TOLERANCE), self.problem.N - 1)
        if not math.isfinite(x.dot(x)):  # no feedback from a non-finite state
            u = self._acting
        elif self.status is ControllerStatus.HOLDING:
            u = self._holding(x, self._us[-1])
        else:
            n = min(n, self.horizon - 1)
            u = self._us[n] + self._K[n] @ self._space.single_difference(x, self.expected(t))
        return u if self._bounds is None else self._bounds.clip(at, u, None)

    def expected(self, t: float) -> np.ndarray:
        """The state (nx,) of the plan at time t, s, integrated from the knot before."""
        stages = max((t - self._made) / self._dt, 0.0)
        n = int(stages + TIME_TOLERANCE)
        if n >= self.horizon:
            return self._xs[-1].copy()
        part = stages - n
        if part <= TIME_TOLERANCE:
            return self._xs[n].copy()  # the next plan overwrites the memory
        return self.problem.dynamics.step(self._xs[n : n + 1], self._us[n : n + 1], np.array([part * self._dt]))[0]
