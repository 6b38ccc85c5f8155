"""Continuation: follow the plans of a family of problems from an easy member to the one that is asked for.

A family is a function of s >= 0: problem_at(0) is the asked problem, a larger s an easier one, e.g. with wider limits
or a softer ground. From a plan at some s, until s = 0:

    predict    states and controls, linear in s through the last two plans
    correct    solve problem_at(s) from there, by multiple shooting where a rollout does not follow the prediction
    step       longer after a quick solve; shorter where the plan misses its goal: it fell off its branch

(Allgower and Georg, Numerical Continuation Methods, 1990, sections 2 and 6).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.trajectory import Trajectory

FALL_ITERATIONS, FALL_SHARE = 10, 0.02  # a solve whose cost falls by this share in so many iterations goes on
BETTER_SHARE = 0.5  # of the cost of the plan before: a solve that is cheaper by it has found a better branch

# One solve from a trajectory, or from the problem's first guess for None, with an iteration limit.
SolveFrom = Callable[[Problem, Trajectory | None, int], Plan]


@dataclass(frozen=True)
class Continuation:
    """A family of problems, and how to follow its plans.

    Attributes:
        problem_at: The problem at s.
        solve: One solve.
        meets_goals: Whether a plan, converged or not, meets the goals of its problem.
        report: Called with s, the plan of each solve and whether it was kept.
        max_solves: Limit of the solves of one call.
        look_iterations: Number of iterations after which a solve goes on only if its cost is falling, its plan meets
            the goals, or it costs less than the plan before by BETTER_SHARE.
        max_iterations: Limit of those that it goes on with: a plan that has converged predicts the next one better.
        min_step: Smallest step of s.
        first_share: First step over s.
        growth: Ratio of a step to the one before it, after a quick solve.
        min_share: Smallest step over s: below it a branch ends far from the asked problem.
    """

    problem_at: Callable[[float], Problem]
    solve: SolveFrom
    meets_goals: Callable[[Plan], bool]
    report: Callable[[float, Plan, bool], object]
    max_solves: int = 16
    look_iterations: int = 60
    max_iterations: int = 1000
    min_step: float = 0.01
    first_share: float = 0.5
    growth: float = 1.5
    min_share: float = 0.1

    def run(self, s: float, plan: Plan) -> tuple[float, Plan]:
        """The smallest s that was reached from a plan at s, and its plan: at 0 the one of the asked problem."""
        before: tuple[float, Plan] | None = None
        step = max(self.first_share * s, self.min_step)
        for _ in range(self.max_solves):
            if s == 0.0 or step < max(self.min_step, self.min_share * s):
                break
            to = s - step if s - step >= self.min_step else 0.0
            better = plan.cost - BETTER_SHARE * abs(plan.cost)
            found, kept = self._corrected(to, _predicted(to, s, plan, before), better)
            if kept:
                before = (s, plan) if plan.converged else None  # a plan on its way predicts nothing
                s, plan = to, found
                step = min(self.growth * step, s) if found.nit < self.look_iterations else min(step, s)
            else:
                step = 0.4 * min(step, s)
        return s, plan

    def _corrected(self, s: float, guess: Trajectory, better: float) -> tuple[Plan, bool]:
        """The plan at s from a predicted trajectory, and whether it meets its goals; at s = 0 it must converge too.

        It goes on also where its cost is below `better`: it has left the branch for one that is worth its iterations.
        """
        problem = self.problem_at(s)
        plan = self.solve(problem, guess, self.look_iterations)
        for _ in range(self.max_iterations // self.look_iterations):
            if not (plan.status is Status.MAX_ITERATIONS and _is_falling(plan)):
                break
            self.report(s, plan, True)
            plan = self.solve(problem, plan.motion, self.look_iterations)
        if plan.status is Status.MAX_ITERATIONS and (self.meets_goals(plan) or plan.cost < better):
            self.report(s, plan, True)
            plan = self.solve(problem, plan.motion, self.max_iterations)
        kept = self.meets_goals(plan) and (s > 0.0 or plan.converged)
        self.report(s, plan, kept)
        return plan, kept


def _is_falling(plan: Plan) -> bool:
    """Whether the last FALL_ITERATIONS of a solve have reduced its cost by more than FALL_SHARE of it."""
    return plan.nit > FALL_ITERATIONS and plan.history[-FALL_ITERATIONS].cost - plan.cost > FALL_SHARE * abs(plan.cost)


def _predicted(to: float, s: float, plan: Plan, before: tuple[float, Plan] | None) -> Trajectory:
    """The trajectory of a plan at s, extrapolated to another s through the plan before it."""
    motion = plan.motion
    if before is None:
        return motion
    ahead, space = (to - s) / (s - before[0]), motion.space
    change = space.difference(motion.xs, before[1].xs)
    return replace(
        motion, xs=space.integrate(motion.xs, ahead * change), us=motion.us + ahead * (motion.us - before[1].us)
    )
