"""Controller: u = controller(t, x), model predictive control that replans from the measured state.

    prepare    at the rate: one solve of the window (planner.control.replanning) for the state that the model predicts
    feedback   u = us[n] + K[n] (x - xs(t)), within bounds, some tens of microseconds
    call       both: it plans from the measured x where a plan is due

The feedback is the minimum of the LQ problem of the last iteration from the measured state, as in real-time iteration.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np

from planner.base.arguments import array, count, number, short_repr
from planner.base.errors import PlannerError
from planner.control.control_laws import TIME_TOLERANCE, FallbackControl, TrackedPlan, equilibrium_control
from planner.control.controller_states import PATIENCE, ControllerStatus, Fault, StateMachine
from planner.control.replanning import Replanner
from planner.control.window_parts import (
    goal_fault,
    goal_states,
    goal_stays,
    horizon_and_rate,
    is_of_frames,
    state_after,
    window_dynamics,
)
from planner.model.space import space_of
from planner.problem.costs.tracking import states
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.slq import solve

FARTHEST = 100.0  # times the largest number of plan and goal, at least 1, that a measured state may have
LATEST = 1e12  # s, of clocks: those of Unix show 2e9


class Controller(StateMachine):
    """Model predictive control of a problem from the measured state; `u = controller(t, x)`.

    Args:
        problem: The task. Its time begins with the first call after a reset; its goal remains after its end.
        horizon: Number of stages of each plan; by default that of the problem.
        rate: Plans per second, Hz; at most one per stage, which is the default.
        iterations: SLQ iterations of each plan.
        budget: s of wall time, in place of a number of iterations: one begins only if what one took lately fits in
            what is left. Results then depend on the computer.
        patience: Failed solves, or unusable measurements, in a row before gravity compensation and damping.
        plan: The first plan of the problem; solved by default.
        latency: s, from a planning call until its control acts. It plans for that instant, from the state that the
            problem's dynamics predict for then under the present control.
        threaded: Whether a call only begins a plan, in a thread of its own, and returns the feedback of the last one.
            The plan begins in the state that this feedback leads to at `latency`, and acts then or when it is ready.
            Results depend on the computer, except in simulate(). Without a thread the control is constant meanwhile.
            By default where the latency is above 0 and it, or the time between two plans, is longer than a stage.

    Attributes:
        plan: The first plan of the whole task, converged; solved again by reset(x0).
        status: A ControllerStatus.
        events: Transitions of the status, failures and recoveries: planner.control.controller_states.Event.
        failures: Failed solves since the reset.
        faults: Unusable measurements since the reset.
        plans: Plans made since the reset.
        overruns: Plans that took longer than the period of the rate, or than the budget, of wall time.
        simulated: Whether time is: set it after a reset, as simulate() does. Wall time then has no part in status and
            events; a threaded plan is made at once and acts after `latency`.
        planned: Whether the last call made a plan.
        keeps_goal: Whether the goal remains after the end of the task: some control makes it an equilibrium.
        seconds: Wall time of the last plan, s; 0 where the last call did not plan.
        processor_seconds: Processor time of it, s, of its thread; measured where time is simulated.

    Raises:
        PlannerError: A rate above one plan per stage, a number out of range, a cost without a window (see
            window_parts.parts_of), a first solve that diverges.
    """

    def __init__(
        self, problem: Problem, horizon: int | None = None, rate: float | None = None, iterations: int = 1,
        budget: float | None = None, patience: int = PATIENCE, plan: Plan | None = None, latency: float = 0.0,
        threaded: bool | None = None,
    ) -> None:  # fmt: skip
        H, rate = horizon_and_rate(problem, horizon, rate)
        self.problem, self.horizon, self.rate = problem, H, rate
        self.iterations = count("iterations", iterations)
        self.budget = None if budget is None else number("budget", budget, greater_than=0.0)
        patience = count("patience", patience)
        self._dt, self._space, self._bounds = problem.dynamics.dt, space_of(problem.dynamics), problem.bounds
        self.latency = number("latency", latency, minimum=0.0, maximum=H * self._dt)
        late = self.latency > 0.0 and max(1.0 / rate, self.latency) > self._dt * (1.0 + TIME_TOLERANCE)
        self.threaded = late if threaded is None else bool(threaded)
        if plan is not None and (not isinstance(plan, Plan) or plan.us.shape != (problem.N, problem.dynamics.nu)):
            raise PlannerError(f"plan is {short_repr(plan)}, expected a Plan of the problem, or None.")
        self.plan = self._begun = self._solved(problem.x0) if plan is None else plan
        dynamics = window_dynamics(problem, self.plan.xs[:: max(problem.N // 4, 1)])
        self._model = problem if dynamics is problem.dynamics else replace(problem, dynamics=dynamics)
        self._replanner = Replanner(self._model, H, goal_stays(problem), self.iterations, self.budget, patience)
        self._window, self._holding = self._replanner.window, FallbackControl(problem)
        self.keeps_goal = self._window.keeps
        self._goal: Any = None
        self._new_goal: np.ndarray | None = None
        self._thread: ThreadPoolExecutor | None = None
        super().__init__(patience, min(1.0 / rate, self.budget or math.inf), self._holding.how)
        self.reset()

    def __repr__(self) -> str:
        return (
            f"Controller({self.horizon} stages of {self._dt:g} s, {self.rate:g} Hz, iterations {self.iterations}: "
            f"{self.status.name.lower()})"
        )

    def _solved(self, x0: np.ndarray, warm_start: Plan | None = None) -> Plan:
        """The plan of the whole task from a state x0 (nx,)."""
        asked = self.problem if np.array_equal(x0, self.problem.x0) else replace(self.problem, x0=x0)
        plan = solve(asked, warm_start=warm_start)
        if not (np.isfinite(plan.xs).all() and np.isfinite(plan.K).all()):
            raise PlannerError(f"the controller has no plan to begin with: {plan.message}")
        return plan

    def with_timing(self, rate: float, latency: float) -> Controller:
        """One with another rate, Hz, and latency, s, and the same first plan."""
        own = self.horizon, rate, self.iterations, self.budget, self.patience, self.plan, latency
        return Controller(self.problem, *own)

    def reset(self, x0: Any = None) -> None:
        """Restart the task with the next call. Leaves STOPPED.

        From another start x0 (nx,) the task is solved again, warm-started by the first plan: a machine hops on.
        """
        if self._thread is not None:
            self._thread.shutdown()  # the engine has one user
        self._thread = ThreadPoolExecutor(1, "planner") if self.threaded else None
        self._pending: Future[Fault | None] | None = None
        if x0 is not None:
            self.plan = self._solved(states("x0", x0, self._space, ()), self._begun)
        self._replanner.reset(self.plan)
        self._adopt()
        self.restart()
        self.simulated = False
        self._begin, self._asked = math.nan, -math.inf
        self.planned, self.seconds, self.processor_seconds, self._waits = False, 0.0, 0.0, False
        self._acting, self._seen, self._last_t = self._tracked.us[0].copy(), self.plan.xs[0].copy(), -math.inf
        if self._goal is None:
            end = self.plan.xs[-1] if self._window.frames else self._window.x_ref[-1]
            self._rest = equilibrium_control(self._model, end, self.plan.us[-1])
            self._window.rest(self._rest)
        largest = max(1.0, np.abs(self.plan.xs).max(), np.abs(self._window.x_ref).max())
        self._farthest = FARTHEST * float(largest)

    @property
    def stalls(self) -> int:
        """Solves that found no lower cost than the plan before: no failure."""
        return self._replanner.stalls

    @property
    def goal(self) -> Any:
        """The goal of the task; it may be set at any time.

        A keyframe's name, positions (nq,), a state (nx,), or its trajectory over the horizon (horizon + 1, nx); joints,
        {"elbow": 0.5}, while others are where the problem's goal has them; frames with world positions, m, (3,) or
        (horizon + 1, 3): {"hand": [0.4, 0, 0.6]}. One that cannot be met (planner.control.window_parts) is an event,
        and the machine is held until the next goal.
        """
        return self._window.x_ref[-1].copy() if self._goal is None else self._goal

    @goal.setter
    def goal(self, goal: Any) -> None:
        if is_of_frames(self.problem, goal, self._window.frames):
            if not self._window.frames:
                raise PlannerError("goal is a table of frames and no frame of this problem has one, expected a state.")
            places = {
                str(frame): array(f"the goal of {frame}", at, (3,) if np.ndim(at) < 2 else (self.horizon + 1, 3))
                for frame, at in goal.items()
            }
            fault = goal_fault(self.problem, places)
            for frame, at in places.items() if fault is None else ():
                self._window.point(frame, at)
        else:
            new = goal_states(self.problem, goal, self.horizon)
            fault = goal_fault(self.problem, new)
            if fault is None:
                self._new_goal = new  # used by the next plan
                self._farthest = max(self._farthest, FARTHEST * float(np.abs(new).max()))
        if fault is not None and not self._waits:
            self.refused(self._now, fault)
        self._waits = fault is not None
        if fault is None:
            self._goal = goal

    def close(self) -> None:
        """End the thread of a threaded controller, which then holds the machine until a reset."""
        if self._thread is not None:
            self._thread.shutdown()
            self.stop()

    def __call__(self, t: float, x: np.ndarray, standing_feet: Collection[str] | None = None) -> np.ndarray:
        """The control (nu,) at time t, s, and state x (nx,); plans if a plan is due.

        The state of a Mechanism is MuJoCo's qpos, qvel and act. Any measurement is answered by a control that is finite
        and within the bounds: while one is unusable, the plan goes on without feedback, then the machine is held.
        `standing_feet` are the names of those that bear load now, as for FixedPlanController.
        """
        self.planned, self.seconds, self.processor_seconds = False, 0.0, 0.0
        fault = self._fault(t, x)
        if fault is not None:
            return self._without(t, fault)
        x = self._measured(t, x)
        due = (t - self._asked) * self.rate >= 1.0 - TIME_TOLERANCE
        if self._pending is not None and self._pending.done() and t >= self._pending_at - TIME_TOLERANCE * self._dt:
            fault, self._pending = self._pending.result(), None
            if self._plans:  # no stop, nor a goal that cannot be met, came meanwhile
                self._ended(t, fault)
        if not due or self._pending is not None or not self._plans:
            return self._control(t, x, standing_feet)
        self._started(t)
        if self._thread is not None:
            self._slide(t + self.latency)
            self._pending_at = t + self.latency
            if self.simulated:
                self._pending = Future()
                self._pending.set_result(self._timed(t, x, self.latency))
            else:
                self._pending = self._thread.submit(self._timed, t, x, self.latency)
            return self._control(t, x, standing_feet)
        if self.latency:
            t, x = t + self.latency, self._usable(state_after(self._model, x, self._acting, self.latency))
        if self._replan(t, x):
            self._acting = self._tracked.us[0].copy()
            return self._acting.copy()
        return self._control(t, x, standing_feet)

    def prepare(self, t: float, x: np.ndarray | None = None) -> bool:
        """Plan for time t, s; whether it succeeded. `feedback` then tracks that plan.

        Args:
            t: s, of the measurement to come.
            x: (nx,) the state then; by default what the problem's dynamics predict from the last measurement.
        """
        if self.threaded:
            raise PlannerError("a threaded controller prepares its plans by itself, expected controller(t, x).")
        fault = self._fault(t, self._seen if x is None else x)
        if fault is Fault.CLOCK or fault is Fault.LENGTH:
            self._without(t, fault)
            return False
        self._started(t)
        if not self._plans:
            return False
        if x is None:
            since = min(t - self._last_t, self.horizon * self._dt) if self._last_t > -math.inf else 0.0
            x = self._usable(state_after(self._model, self._seen, self._acting, since))
        return self._replan(t, np.asarray(x, dtype=float), searched=False)

    def feedback(
        self, x: np.ndarray, t: float | None = None, standing_feet: Collection[str] | None = None
    ) -> np.ndarray:  # fmt: skip
        """The control (nu,) at state x (nx,) by the last plan; nothing is planned.

        Args:
            x: (nx,) measured state.
            t: s; by default the time that the last plan was prepared for.
            standing_feet: As of a call.
        """
        if math.isnan(self._begin):
            raise PlannerError("the controller has not planned yet, expected prepare(t) or controller(t, x) before.")
        t = self._tracked.made if t is None else t
        fault = self._fault(t, x)
        return self._without(t, fault) if fault else self._control(t, self._measured(t, x), standing_feet)

    @property
    def _plans(self) -> bool:
        return self.status is not ControllerStatus.STOPPED and not self._waits

    def _started(self, t: float) -> None:
        """A plan is asked for at t, the first one at the begin of the task."""
        self._asked = t
        if math.isnan(self._begin):
            self._begin = self._tracked.made = self._replanner.made = t

    def _slide(self, t: float) -> None:
        """Move the window to the plan for time t, with the last goal."""
        stage = self._stage(t)
        if self._new_goal is not None:
            near = self._tracked.us[-1] if self._rest is None else self._rest
            self._rest = equilibrium_control(self._model, np.atleast_2d(self._new_goal)[-1], near)
            self._window.aim(self._new_goal, self._rest, stage)
            self._new_goal = None
        self._window.slide(stage)
        self._leads_back = self._goal is None and self._window.stage < self.problem.N
        self._held = self.status is ControllerStatus.HOLDING

    def _timed(self, t: float, x: np.ndarray, ahead: float = 0.0, searched: bool = True) -> Fault | None:
        """One solve from x at t, or from where the last plan leads `ahead` s later, and its times."""
        began, worked = time.perf_counter(), self._processor_time()
        if ahead:
            t, x = t + ahead, self._usable(self._led(t, x, ahead))
        held = self._holding(x, self._tracked.us[-1]) if self._held and np.isfinite(x).all() else None
        fault = self._replanner.replan(t, x, held, self._leads_back, searched)
        self._taken = time.perf_counter() - began, self._processor_time() - worked
        return fault

    def _processor_time(self) -> float:
        """The thread's, s; 0 on a robot: it is asked of the system, which in a sandbox takes as long as a plan."""
        return time.thread_time() if self.simulated else 0.0

    def _led(self, t: float, x: np.ndarray, ahead: float) -> np.ndarray:
        """The state (nx,) `ahead` s after x at t, under the feedback of the last plan or what holds the machine."""
        end = t + ahead
        while end - t > TIME_TOLERANCE * self._dt:
            part = min(end - t, self._dt)
            u = self._acting if self._held else self._clipped(t, self._tracked.control(t, x))
            x = state_after(self._model, x, u, part)
            t += part
        return x

    def _replan(self, t: float, x: np.ndarray, searched: bool = True) -> bool:
        self._slide(t)
        return self._ended(t, self._timed(t, x, searched=searched))

    def _ended(self, t: float, fault: Fault | None) -> bool:
        """Take what a solve for time t left; whether it succeeded."""
        self._adopt()
        self.planned, (self.seconds, self.processor_seconds) = True, self._taken
        seconds = 0.0 if self.simulated else self.seconds
        return self.ended(t, fault, seconds, iteration_seconds=self._replanner.iteration_seconds)

    def _adopt(self) -> None:
        """Track the last plan of the replanner; a copy where the next is made in another thread."""
        xs, us, K = self._replanner.trajectory
        own = (xs.copy(), us.copy(), K.copy()) if self.threaded else (xs, us, K)
        self._tracked = TrackedPlan(self._model.dynamics, own, self._replanner.made)

    def _fault(self, t: float, x: Any) -> Fault | None:
        """Why a measurement cannot be used, or None."""
        if not isinstance(t, Real) or not abs(t) < LATEST:
            return Fault.CLOCK
        if x is not self._seen:  # which was usable
            try:
                x = np.asarray(x)
            except ValueError:  # rows of several lengths
                return Fault.LENGTH
            if x.shape != self._seen.shape or x.dtype.kind not in "fiub":
                return Fault.LENGTH
            if not self._near(x.astype(float, copy=False)):
                return Fault.SIZE if np.isfinite(x).all() else Fault.STATE
        return Fault.CLOCK_BACK if t < self._last_t - TIME_TOLERANCE * self._dt else None

    def _near(self, x: np.ndarray) -> bool:
        """Whether no entry of a state (nx,) is farther than a measured one may be; False where one is not finite."""
        return bool(x.dot(x) <= self._farthest**2 or np.abs(x).max() <= self._farthest)  # the first is a quick yes

    def _usable(self, x: np.ndarray) -> np.ndarray:
        """A predicted state (nx,); the last measured one where the prediction runs away."""
        return x if self._near(x) else self._seen

    def _measured(self, t: float, x: Any) -> np.ndarray:
        """Take a usable measurement."""
        if self._last_t == -math.inf:
            self._now = t
        self.usable(t, 1.0 / self.rate)
        self._last_t, self._seen = t, np.array(x, dtype=float)
        return self._seen

    def _without(self, t: float, fault: Fault) -> np.ndarray:
        """The control without a usable measurement: of the plan alone, or what holds the machine where it was seen."""
        now = self._now if fault is Fault.CLOCK else max(t, self._now)
        self.unusable(now, fault)
        holds = self.status in (ControllerStatus.HOLDING, ControllerStatus.STOPPED)
        u = self._holding(self._seen, self._tracked.us[-1], damped=False) if holds else self._tracked.feedforward(now)
        self._acting = self._clipped(now, u)
        return self._acting.copy()

    def _control(self, t: float, x: np.ndarray, standing_feet: Collection[str] | None) -> np.ndarray:
        """The control (nu,) of the last plan with its feedback, or what holds the machine."""
        if self._tracked.ended(t):
            self.hold(t, "the plan has ended")
        holds = self.status in (ControllerStatus.HOLDING, ControllerStatus.STOPPED)
        u = self._holding(x, self._tracked.us[-1]) if holds else self._tracked.waiting_control(t, x, standing_feet)
        self._acting = self._clipped(t, u)
        return self._acting.copy()

    def _clipped(self, t: float, u: np.ndarray) -> np.ndarray:
        """A control (nu,) within the bounds; the one before in place of one that is not finite."""
        if not math.isfinite(u.dot(u)):
            u = self._acting
        return u if self._bounds is None else self._bounds.clip(min(self._stage(t), self.problem.N - 1), u, None)

    def _stage(self, t: float) -> int:
        """The stage of the task at t, s, at least 0."""
        return 0 if math.isnan(self._begin) else max(int((t - self._begin) / self._dt + TIME_TOLERANCE), 0)

    def expected(self, t: float) -> np.ndarray:
        """The state (nx,) of the plan at time t, s, integrated from the knot before."""
        return self._tracked.expected(t)
