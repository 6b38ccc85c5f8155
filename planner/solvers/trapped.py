"""Whether a direct solve is trapped: it ended without success, and larger weights would not mend it."""

from __future__ import annotations

import math

import numpy as np

from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.goals import goals_of, missed_goal_message
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.thrust import missing_thrust
from planner.solvers.continuation import BETTER_SHARE, Continuation, has_softer, share_at_limits
from planner.solvers.options import DEFAULT, SolverOptions

MAX_QUICK_ITERATIONS = Continuation.look_iterations  # of a direct solve with contacts: then it crawls along their kinks
FIRST_ITERATIONS = 300  # limit of the first solve of a branch, and of a direct one past obstacles
NEAR = 0.1  # of the largest error of a goal along a plan: what misses it by less needs weight, not another motion
SLOWER = 0.75  # the same of a velocity, with contacts
CLOSE = 2.0  # tolerances, likewise
SETTLED = 0.05  # of the cost
FEW = 0.2  # of the stages: where limits act in fewer, a larger weight still moves the controls of the others
_UNSUCCESSFUL = (Status.MAX_ITERATIONS, Status.NO_DESCENT, Status.OUTSIDE_LIMITS)


def is_trapped(problem: Problem, plan: Plan, options: SolverOptions) -> bool:
    """Whether a direct solve ended without success, and not only because its weights are too small."""
    if not (_is_relaxed(problem, options) and failed(plan)) or plan.status is Status.NOT_FINITE:
        return False
    if missing_thrust(problem) is not None:  # it falls on all ways
        return False
    return stays_away(problem, plan) or not lacks_only_weight(problem, plan)


def direct_iterations(problem: Problem, options: SolverOptions) -> int:
    """Limit of the iterations of a direct solve, after which softer contacts or ways around obstacles are tried."""
    most = options.max_iterations
    return int(min(most, look_iterations(problem))) if _is_relaxed(problem, options) else most


def look_iterations(problem: Problem) -> float:
    """Iterations after which a direct solve waits for other ones; infinite where it does not."""
    if has_softer(problem):
        return MAX_QUICK_ITERATIONS
    return math.inf if pair_clearance_of(problem.constraints) is None else FIRST_ITERATIONS


def _is_relaxed(problem: Problem, options: SolverOptions) -> bool:
    """Not where an iteration limit below the default cuts a solve: who asks for little work gets little."""
    return options.homotopy and options.max_iterations >= DEFAULT.max_iterations and problem.periodic is None


def failed(plan: Plan) -> bool:
    """Whether a plan has no success, or misses a goal."""
    return plan.status in (*_UNSUCCESSFUL, Status.NOT_FINITE) or bool(plan.missed_goals)


def lacks_weight(problem: Problem, plan: Plan) -> bool:
    """Whether a plan misses its goals by so little that weights are missing, and no other motion."""
    for one in goals_of(problem, plan.xs):
        # machines with contacts have small weights on where they end: one that is there and slows down lacks them
        share = SLOWER if one.unit.endswith("/s") and has_softer(problem) else NEAR
        farthest = 0.0 if one.times is not None else share * float(np.max(one.error(plan.xs)))
        if not one.miss(plan.t, plan.xs) <= max(CLOSE * one.tolerance, farthest):
            return False
    return True


def lacks_only_weight(problem: Problem, plan: Plan) -> bool:
    """Whether a plan converged, lacks weight for its goals, and its limits leave it room for more."""
    return plan.status is Status.CONVERGED and share_at_limits(problem, plan) < FEW and lacks_weight(problem, plan)


def is_settled(plan: Plan) -> bool:
    """Whether the last third of the iterations of a solve took at most SETTLED of its cost off."""
    costs = [line.cost for line in plan.history[2 * len(plan.history) // 3 :]]
    return len(costs) > 1 and abs(costs[0] - costs[-1]) <= SETTLED * abs(costs[-1])


def stays_away(problem: Problem, plan: Plan, near: float = NEAR) -> bool:
    """Whether a converged plan ends as far from a goal as it begins, to a share of it."""
    if not plan.converged:
        return False
    for one in goals_of(problem, plan.xs):
        if one.times is None and np.isfinite(one.tolerance):
            begins, ends = (float(one.error(x[None])[0]) for x in plan.xs[[0, -1]])
            if begins > one.tolerance and ends >= (1.0 - near) * begins:
                return True
    return False


def meets_goals(plan: Plan) -> bool:
    """Whether a plan, converged or not, meets its goals within its limits."""
    if plan.problem is None or not np.isfinite(plan.xs).all() or plan.status is Status.OUTSIDE_LIMITS:
        return False
    return not missed_goal_message(plan.problem, *plan.judged_motion)


def is_at_goals(plan: Plan) -> bool:
    """Whether a plan meets its goals within its limits, or lacks only weight for them."""
    if meets_goals(plan):
        return True
    within = np.isfinite(plan.xs).all() and plan.status is not Status.OUTSIDE_LIMITS
    return bool(within and plan.problem is not None and lacks_weight(plan.problem, plan))


def is_cheaper(plan: Plan, direct: Plan, share: float) -> bool:
    """Whether a plan, converged or not, costs less than the direct one by a share of its cost."""
    return plan.cost < direct.cost - share * abs(direct.cost)


def is_promising(plan: Plan, direct: Plan) -> bool:
    """Whether a plan costs less than the direct one by BETTER_SHARE, or that one alone is outside of its limits."""
    outside = direct.status is Status.OUTSIDE_LIMITS and plan.status is not Status.OUTSIDE_LIMITS
    return outside or is_cheaper(plan, direct, BETTER_SHARE)


def largest_violation(problem: Problem, plan: Plan) -> float:
    """Largest violation of limits and constraints by a plan, rad, m, rad/s, m/s."""
    constraints = problem.trajectory_constraints
    return 0.0 if constraints is None else float(np.max(constraints.violation(plan.xs, plan.us), initial=0.0))


def may_replace(plan: Plan, direct: Plan) -> bool:
    """Whether a plan may take the direct one's place by its cost, which says nothing of a way through its limits.

    It has converged, or is within its limits where the direct one has not converged either.
    """
    if plan.converged or direct.converged or plan.problem is None or plan.status is Status.OUTSIDE_LIMITS:
        return plan.converged
    constraints = plan.problem.trajectory_constraints
    return constraints is None or largest_violation(plan.problem, plan) <= constraints.tolerance


def is_better(plan: Plan, direct: Plan) -> bool:
    """Whether the plan that another way leads to costs less than the direct one, or meets goals that this one misses.

    No plan that has failed replaces a success, and none that has not converged or is not at its goals a converged one.
    """
    if failed(plan) and not failed(direct):
        return False
    if direct.converged and not (plan.converged or meets_goals(plan)):
        return False
    return plan.cost < direct.cost or (failed(direct) and (meets_goals(plan) or not math.isfinite(direct.cost)))
