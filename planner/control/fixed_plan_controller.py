"""FixedPlanController: a plan with its feedback as a controller, without replanning; regulates the goal after its end.

It is the baseline of a Controller. The regulator is that of a proof (planner.proof.goal_regulator), or gravity
compensation and damping where there is none.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.control.fallback_control import FallbackControl
from planner.problem.plan import Plan
from planner.proof.goal_regulator import GoalRegulator, hold_gain
from planner.proof.replays.replaying import problem_of

_TIME_TOLERANCE = 1e-6  # of a stage: smaller differences of time are zero


class FixedPlanController:
    """u = us[n] + K[n] (x - x_plan(t)), then regulation of the goal."""

    planned, seconds = False, 0.0

    def __init__(self, plan: Plan) -> None:
        self.plan, self.problem = plan, problem_of(plan)
        self._hold: GoalRegulator | None = None
        self._holding = FallbackControl(self.problem)
        try:
            self._hold = hold_gain(self.problem)
        except PlannerError:
            self._hold = None

    def reset(self, x0: Any = None) -> None:
        """No state to reset; a PlannerError for another start."""
        if x0 is not None:
            raise PlannerError(
                "start is given for a plan with its gains alone, expected a Controller, which can plan from there."
            )

    def __call__(self, t: float, x: np.ndarray) -> np.ndarray:
        """The control (nu,) at time t, s, and state x (nx,)."""
        plan, bounds = self.plan, self.problem.bounds
        n = int(t / self.problem.dynamics.dt + _TIME_TOLERANCE)
        if n < plan.N:
            u = plan.us[n] + plan.K[n] @ plan.space.difference(x, self.expected(t))
        else:
            u = self._holding(x, plan.us[-1]) if self._hold is None else self._hold.control(x)
        return u if bounds is None else bounds.clip(min(n, plan.N - 1), u, None)

    def expected(self, t: float) -> np.ndarray:
        """The state (nx,) of the plan at time t, s."""
        plan, dynamics = self.plan, self.problem.dynamics
        stages = t / dynamics.dt
        n = int(stages + _TIME_TOLERANCE)
        if n >= plan.N:
            return plan.xs[-1] if self._hold is None else self._hold.x_goal
        part = max(stages - n, 0.0)
        return (
            dynamics.step(plan.xs[n : n + 1], plan.us[n : n + 1], np.array([part * dynamics.dt]))[0]
            if part > _TIME_TOLERANCE
            else plan.xs[n]
        )
