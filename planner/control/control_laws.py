"""Control laws: the feedback of a plan, gravity compensation and damping without one, and a plan with its gains alone.

    TrackedPlan          u = us[n] + K[n] (x - xs(t))                             from the time on that it was made for
    FallbackControl      u = gravity compensation at q, less M(q) qd / TIME       within the bounds of the problem

Without a plan velocities decay with the time constant TIME if the robot is fully actuated, else in the actuated
directions. Dynamics without a mechanism keep the last control of the plan.

A plan with its gains alone, FixedPlanController, is the baseline of a Controller. After its end it regulates the goal
as a proof does (planner.proof.goal_regulator), or by the fallback control where there is no regulator.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from functools import cached_property
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.joint_forces import actuator_lengths, actuator_moments, force_slopes, gains_at
from planner.dynamics.quasi_static import equilibrium, quasi_static_controls
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.touch_downs import StageRule, reference, standing, touch_downs_of
from planner.proof.goal_regulator import GoalRegulator, hold_gain
from planner.proof.replays.replaying import problem_of
from planner.solvers.engine.protocol import TrajectoryArrays

TIME_TOLERANCE = 1e-6  # of a stage: smaller differences of time are zero


class TrackedPlan:
    """A plan that feedback tracks. Around its touch-downs the stage waits for the feet: see problem.touch_downs.

    Attributes:
        xs: (N+1, nx).
        us: (N, nu).
        K: (N, nu, ndx).
        made: Time of its first state, s; nan before the task begins.
    """

    def __init__(self, dynamics: Any, trajectory: TrajectoryArrays, made: float) -> None:
        self._dynamics, self._dt, self._space = dynamics, dynamics.dt, space_of(dynamics)
        (self.xs, self.us, self.K), self.made = trajectory, made

    def _stages(self, t: float) -> tuple[int, float]:
        """Whole stages from its begin to t, s, and the part of the next one."""
        stages = 0.0 if math.isnan(self.made) else max((t - self.made) / self._dt, 0.0)
        n = int(stages + TIME_TOLERANCE)
        return n, stages - n

    def ended(self, t: float) -> bool:
        """Whether it has no stage at t, s."""
        return self._stages(t)[0] >= len(self.us)

    def feedforward(self, t: float) -> np.ndarray:
        """The planned control (nu,) at t, s; after the end the last one."""
        return self.us[min(self._stages(t)[0], len(self.us) - 1)]

    @cached_property
    def _rule(self) -> StageRule:
        return StageRule(touch_downs_of(self._dynamics, self.xs))

    @cached_property
    def _feet(self) -> list[str]:
        mechanism = capabilities_of(self._dynamics).mechanism
        contacts = () if mechanism is None else mechanism.contacts
        return [] if mechanism is None else list(dict.fromkeys(mechanism.body_of(one.link) for one in contacts))

    def control(self, t: float, x: np.ndarray) -> np.ndarray:
        """The control (nu,) with feedback at t, s, and x (nx,), before bounds; its stage is the clock's."""
        n = min(self._stages(t)[0], len(self.us) - 1)
        return self.us[n] + self.K[n] @ self._space.single_difference(x, self.expected(t))

    def waiting_control(self, t: float, x: np.ndarray, standing_feet: Collection[str] | None = None) -> np.ndarray:
        """The same with a stage that waits for feet; t is now, and does not go back.

        `standing_feet` are the names of those that bear load; by default they are estimated from x by the contact law.
        """
        for foot in standing_feet or ():
            choice("a foot of standing_feet", foot, self._feet)
        n, part = self._stages(t)
        if n == 0 or n >= len(self.us):  # a plan that is made again each stage has nothing to wait for
            return self.control(t, x)
        found: list[Collection[str]] = []

        def bears(foot: str) -> bool:
            if not found:
                found.append(self._standing(x, standing_feet))
            return foot in found[0]

        waits = self._rule(n + part, bears)
        if waits is None:
            return self.control(t, x)
        x_ref = reference(self._dynamics, self.xs[waits.stage], self._dt * (n + part - waits.stage))
        return self.us[waits.stage] + self.K[waits.stage] @ self._space.single_difference(x, x_ref)

    def _standing(self, x: np.ndarray, told: Collection[str] | None) -> Collection[str]:
        if told is not None:
            return told
        mechanism = capabilities_of(self._dynamics).mechanism
        assert mechanism is not None  # it has touch-downs
        return [foot for foot, bears in standing(mechanism, x[None]).items() if bears[0]]

    def expected(self, t: float) -> np.ndarray:
        """The planned state (nx,) at t, s, integrated from the knot before; after the end the last one."""
        n, part = self._stages(t)
        if n >= len(self.us) or part <= TIME_TOLERANCE:
            return self.xs[min(n, len(self.us))].copy()  # the next plan overwrites the memory
        return self._dynamics.step(self.xs[n : n + 1], self.us[n : n + 1], np.array([part * self._dt]))[0]


TIME = 0.1  # s, time constant of the velocities
KEEPS = 1e-3  # upper limit of the state change per stage at an equilibrium, relative to that of zero control
_NEWTON = 3  # iterations
_KEPT = 1e-9  # state change of one stage, in each coordinate's unit: Newton's tolerance


class FallbackControl:
    """Gravity compensation and damping."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._inverse = problem, np.zeros((0, 0))
        dynamics = problem.dynamics
        self._mechanism = dynamics.mechanism if isinstance(dynamics, RigidBodyDynamics) else None
        if self._mechanism is not None and not getattr(dynamics, "prescribed", ()):
            self._inverse = self._inverse_at(self._mechanism.qpos0)

    @property
    def how(self) -> str:
        """In words."""
        return "by gravity compensation and damping" if self.known else "by the last control of its plan"

    @property
    def known(self) -> bool:
        """Whether the dynamics have a mechanism, without prescribed joints, for gravity compensation."""
        return bool(self._inverse.size)

    def __call__(self, x: np.ndarray, otherwise: np.ndarray, damped: bool = True) -> np.ndarray:
        """The control (nu,) at a state x (nx,), before bounds; `otherwise` (nu,) unless `known`.

        Without damping it is gravity compensation alone, for a state that is not measured.
        """
        m = self._mechanism
        if m is None or not self.known:
            return otherwise
        if not damped:
            return quasi_static_controls(m, x, contacts=False)
        qd, actuators = x[m.velocities], m.actuators
        lengths, rates = actuator_lengths(m, x[: m.nq]), actuators.moment @ qd
        servo = actuators.moment.T @ (force_slopes(actuators, np.zeros(m.nu), lengths, rates).by_rate * rates)
        damping = mass_matrix(m, x[: m.nq]) @ qd / TIME
        inverse = self._inverse_at(x[: m.nq]) if actuators.wrenches or actuators.laws else self._inverse
        return quasi_static_controls(m, x, contacts=False) - inverse @ (damping + servo)

    def _inverse_at(self, q: np.ndarray) -> np.ndarray:
        """(nu, nv) the least controls for generalized forces at a pose (nq,)."""
        m = self._mechanism
        assert m is not None
        gain = gains_at(m.actuators, actuator_lengths(m, q))
        return np.linalg.pinv((gain[:, None] * actuator_moments(m, q)).T)


def equilibrium_control(problem: Problem, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
    """The control (nu,) that makes x (nx,) an equilibrium, by Newton from u; None if none is within the bounds."""
    dynamics, space = problem.dynamics, space_of(problem.dynamics)
    first = space.difference(dynamics.step(x[None], np.zeros((1, dynamics.nu)))[0], x)
    _, u = equilibrium(dynamics, x, u, iterations=_NEWTON, tolerance=_KEPT)
    if problem.bounds is not None:
        u = problem.bounds.clip(-1, u, x)
    left = space.difference(dynamics.step(x[None], u[None])[0], x)
    kept = np.isfinite(left).all() and np.abs(left).max() <= KEEPS * np.abs(first).max() + 1e-9
    return u if kept else None


class FixedPlanController:
    """u = us[n] + K[n] (x - x_plan(t)), then regulation of the goal."""

    planned, seconds, processor_seconds = False, 0.0, 0.0
    threaded, simulated, latency = False, False, 0.0

    def __init__(self, plan: Plan) -> None:
        self.plan, self.problem = plan, problem_of(plan)
        self._begin()
        self._hold: GoalRegulator | None = None
        self._holding = FallbackControl(self.problem)
        try:
            self._hold = hold_gain(self.problem)
        except PlannerError:
            self._hold = None

    def _begin(self) -> None:
        plan = self.plan
        self._tracked = TrackedPlan(self.problem.dynamics, (plan.xs, plan.us, plan.K), 0.0)

    def reset(self, x0: Any = None) -> None:
        """Begin again; a PlannerError for another start."""
        self._begin()
        if x0 is not None:
            raise PlannerError(
                "start is given for a plan with its gains alone, expected a Controller, which can plan from there."
            )

    def __call__(self, t: float, x: np.ndarray, standing_feet: Collection[str] | None = None) -> np.ndarray:
        """The control (nu,) at time t, s, and state x (nx,).

        Args:
            t: s since the begin of the plan; it does not go back before the next reset().
            x: (nx,) measured state.
            standing_feet: Names of the feet (`plan.touch_downs`) that bear load now, as switches or torques tell it; by
                default what the plan's contact law says at x, with the ground where the model has it.
        """
        plan, bounds = self.plan, self.problem.bounds
        if not self._tracked.ended(t):
            u = self._tracked.waiting_control(t, x, standing_feet)
        else:
            u = self._holding(x, plan.us[-1]) if self._hold is None else self._hold.control(x)
        n = int(t / self.problem.dynamics.dt + TIME_TOLERANCE)
        return u if bounds is None else bounds.clip(min(n, plan.N - 1), u, None)

    def expected(self, t: float) -> np.ndarray:
        """The state (nx,) of the plan at time t, s."""
        return self._hold.x_goal if self._hold is not None and self._tracked.ended(t) else self._tracked.expected(t)
