"""Relaxation: where a direct solve ends without success, solve an easier problem and follow its plan to the asked one.

A guess may be a bad one, or a saddle: a car that is to go sideways gets nowhere by any small change of its controls
from rest. So a solve without contacts begins again from other first guesses (solvers.other_guesses), and any that
converges as far from its goals as it began from slightly shaken controls; with contacts, which bear a small push
without motion, from strongly shaken ones, too.

With contacts the easier problem has softer ones (solvers.continuation): sinking ten times as deep, then less and
less. Where objects are to be moved that nothing touches it has forces at a distance instead, from afar and then from
nearer. Softer ones are also tried where a direct solve has not converged after MAX_QUICK_ITERATIONS. One that is near
its end goes on for as many first: its plan is at its goals or lacks weight for them, and its feet stay or its cost
has settled. The others go on only where softer contacts lead to no plan that costs less. Those are given up where the
first plan on them costs EASIER times the direct one. The last solve always has the contacts of the problem; its plan
is taken, too, where it costs less and lacks weight for its goals.

Before, where joints have friction loss, the easier problem is one whose loss is full only at SMOOTHER times the speed:
a joint that reverses then meets a damper and no kink. Its plan is the first guess of the asked problem.

Bounds that act from the first iteration may trap a solve too. The plan of the free problem is followed into the limits,
by a continuation in the logarithm of the factor by which they are wider. Where this branch ends above the factor 1,
others begin at SWING_FACTOR from controls that swing between their bounds: with as many half periods as the slowest
oscillation about the start has in the duration, one less and one more, of either sign; at last so within the limits.
If all end, the motion is infeasible as far as found, and other durations are tried (solvers.passing_duration).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from planner.model.capabilities import capabilities_of
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.initial_guess import Trajectory
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.solvers.continuation import (
    BETTER_SHARE,
    SMOOTHER,
    Continuation,
    DistantContacts,
    RelaxationStep,
    SofterContacts,
    WiderLimits,
    at_limits,
    free_problem,
    has_softer,
    stays_on_feet,
    with_smoother_friction,
)
from planner.solvers.engine import is_in_numpy
from planner.solvers.gains import tracked_warm_start
from planner.solvers.options import SolverOptions
from planner.solvers.other_guesses import LARGE_SHAKE, SHAKE, other_guesses, shaken, swings
from planner.solvers.passing_duration import find_passing_duration
from planner.solvers.trapped import (
    FIRST_ITERATIONS,
    MAX_QUICK_ITERATIONS,
    NEAR,
    failed,
    is_at_goals,
    is_better,
    is_cheaper,
    is_promising,
    is_settled,
    is_trapped,
    lacks_only_weight,
    lacks_weight,
    look_iterations,
    may_replace,
    meets_goals,
    stays_away,
)
from planner.solvers.work import WorkBudget

MOVING_SHARE = 0.1  # of the cost of a plan that touches nothing: one that is cheaper by it moves what is to be moved
DISTANT_ITERATIONS = 100  # after which a solve with forces at a distance goes on only if its plan is kept
SWING_FACTOR = 2.0  # of the limits, at which branches with other numbers of swings begin
MAX_REPEATS = 2  # number of swings that lead to a branch that was followed, after which no others are tried
SHAKES = ((SHAKE, 0), (LARGE_SHAKE, 1), (LARGE_SHAKE, 2))  # shares and seeds, while a plan ends where it began
GUESS_WORK = 10.0  # limit of the work of a solve from the first other guess (solvers.work), half of it for each next
SAME_COST = 1e-3  # relative difference of the costs below which two of them are the same branch, or its mirror image
EASIER = 10.0  # times the cost of the direct plan: a problem of softer contacts whose plan costs more is none easier

# One solve from states (N+1, nx) or None, penalties or None, and controls (N, nu), with an iteration limit.
SolveOne = Callable[..., Plan]


def relax(
    problem: Problem, direct: Plan, solve_one: SolveOne, options: SolverOptions,
    callback: Callable[[Any], object] | None, budget: WorkBudget | None = None,
) -> tuple[Plan, dict[str, Any]]:  # fmt: skip
    """The plan of a relaxation, else the direct one; and a record of its solves for its options.

    Args:
        problem: Any.
        direct: Its plan by a direct solve without success, or after direct_iterations.
        solve_one: One solve of (problem, options, states, penalties, controls, iteration limit, callback).
        options: Of the solves.
        callback: Called with each RelaxationStep; it may raise StopIteration.
        budget: That the solves after the direct one are charged to, and that ends them.

    Returns:
        The direct plan, or a better one, is INFEASIBLE where the free problem is solved and this one is not; it has the
        status of the budget where that ended the search.
    """
    work = _Relaxation(problem, solve_one, options, callback, budget)
    try:
        plan = work.run(direct)
    except _OutOfWorkError as end:
        best = work.best or direct
        status = Status.INFEASIBLE if "duration" in work.passing else end.status
        plan = replace(best, status=status) if failed(best) else best
    except (KeyboardInterrupt, StopIteration):
        plan = replace(work.best or direct, status=Status.INTERRUPTED)
    return plan, work.record()


class _OutOfWorkError(Exception):
    """The budget of a relaxation is used up."""

    def __init__(self, status: Status) -> None:
        self.status = status


@dataclass
class _Relaxation:
    problem: Problem
    solve_one: SolveOne
    options: SolverOptions
    callback: Callable[[Any], object] | None
    budget: WorkBudget | None
    steps: list[RelaxationStep] = field(default_factory=list)
    passing: dict[str, float] = field(default_factory=dict)  # the factor and the duration that pass
    best: Plan | None = None  # of the problem itself, for a relaxation that is cut
    is_kept: Callable[[Plan], bool] = meets_goals  # a plan on the way into the limits
    off_saddle: Trajectory | None = None  # where shaken controls led: the guess is a saddle of softer contacts too

    def run(self, direct: Plan) -> Plan:
        problem, limit = self.problem, self.options.max_iterations
        self.best = direct
        self._report("direct", 1.0, direct, not failed(direct))
        for share, seed in SHAKES if has_softer(problem) else SHAKES[:1]:  # without contacts there are better guesses
            if not stays_away(problem, direct) or self._distant():
                break
            allowed = self._allowed(problem, limit if share == SHAKE else FIRST_ITERATIONS)
            plan = self.solve_one(problem, self.options, None, None, shaken(problem, share, seed), allowed, None)
            if self._report("shaken", 1.0, plan, not failed(plan)) or (
                plan.status in (Status.CONVERGED, Status.MAX_ITERATIONS) and plan.cost < direct.cost
            ):
                self.best = direct = replace(plan, starts=direct.starts)
                self.off_saddle = plan.motion
                if not is_trapped(problem, direct, self.options):
                    return direct
        stopped = direct.status is Status.MAX_ITERATIONS and look_iterations(problem) < limit
        if stopped and has_softer(problem) and self._is_near(direct):  # softer contacts find nothing else
            direct = self._resumed(direct, int(MAX_QUICK_ITERATIONS))
            if not is_trapped(problem, direct, self.options):
                return direct
            stopped = direct.status is Status.MAX_ITERATIONS
        plan = None
        if has_softer(problem):
            plan = self._by_forces_at_a_distance(direct) if failed(direct) and self._distant() else None
            if plan is None or not meets_goals(plan):
                other = self._by_smoother_friction(plan or direct) or self._by_softer_contacts(plan or direct)
                ways = [one for one in (other, plan) if one is not None]
                plan = min(ways, key=lambda one: (not meets_goals(one), one.cost), default=None)
        elif stopped or not meets_goals(direct):
            plan = self._by_other_guesses(direct)
        worse = plan is None or (plan.cost >= direct.cost if has_softer(problem) else not meets_goals(plan))
        if stopped and worse:
            spent = sum(step.iterations for step in self.steps if step.stage in ("direct", "resumed"))
            direct = self._resumed(direct, limit - spent)
        if plan is not None and is_better(plan, direct):
            self.best = direct = replace(plan, starts=direct.starts)
        if not (failed(direct) and at_limits(problem, direct)) or lacks_only_weight(problem, direct):
            return direct
        free = self._solve(free_problem(problem), None, limit)
        self._report("free", math.inf, free, is_at_goals(free))
        if not is_at_goals(free):
            return direct
        if not meets_goals(free):  # no limits give it the weight that it lacks
            self.is_kept, self.passing["lacks_weight"] = is_at_goals, 1.0
        family = WiderLimits.around(problem, free)
        lowest: tuple[float, Plan] | None = None
        for s, plan in self._branches(family, free):
            s, plan = self._continuation("limits", family).run(s, plan)
            if s == 0.0:
                return replace(plan, starts=direct.starts)
            if lowest is None or s < lowest[0]:
                lowest = s, plan
        if lowest is None or meets_goals(direct):
            return direct  # slow, but not infeasible
        if (plan := self._from_swings(problem)) is not None:
            return replace(plan, starts=direct.starts)
        self.passing["factor"] = math.exp(lowest[0])
        find_passing_duration(problem, *lowest, self._in_duration, self._from_swings, self._passes_in)
        return replace(direct, status=Status.INFEASIBLE)

    def _by_other_guesses(self, direct: Plan) -> Plan | None:
        """The plan of the first other guess that converges and meets the goals, else the cheapest, if better.

        Guesses end once two of them lead to the same minimum: then the weights or the limits keep it off its goals.
        The one that was cut at the lowest cost goes on if none converges at less.
        """
        costs = [direct.cost] if direct.converged else []
        ended, cut = list[Plan](), list[tuple[str, Plan]]()
        for k, (stage, states, us) in enumerate(other_guesses(self.problem)):
            share = WorkBudget(GUESS_WORK / 2**k).iterations(self.problem, self.options.max_iterations)
            allowed = self._allowed(self.problem, max(share, Continuation.look_iterations))
            plan = self.solve_one(self.problem, self.options, states, None, us, allowed, None)
            if self._report(stage, 1.0, plan, plan.converged and not plan.missed_goals):
                return plan
            again = plan.converged and any(math.isclose(plan.cost, cost, rel_tol=SAME_COST) for cost in costs)
            costs += [plan.cost] if plan.converged else []
            ended += [plan] if plan.converged else []
            cut += [(stage, plan)] if plan.status is Status.MAX_ITERATIONS else []
            if again and not (stage == "held" and pair_clearance_of(self.problem.constraints)):
                break  # held before an obstacle it is on the same side of it
        lowest = min((plan.cost for plan in ended), default=math.inf)
        stage, first = min(cut, key=lambda one: one[1].cost, default=("", None))
        if first is not None and first.cost < lowest and is_promising(first, direct):
            plan = self._resumed(first, self.options.max_iterations - first.nit, stage)
            if plan.converged and not plan.missed_goals:
                return plan
            ended.append(plan)
        better = [plan for plan in ended if may_replace(plan, direct) and is_promising(plan, direct)]
        return min(better, key=lambda plan: (not plan.converged, plan.cost), default=None)

    def _distant(self) -> bool:
        """Whether objects are to be moved that nothing touches: no motion nearby reaches them."""
        return has_softer(self.problem) and DistantContacts(self.problem).factor > 1.0

    def _by_forces_at_a_distance(self, direct: Plan) -> Plan | None:
        """The plan of the problem that one whose objects feel their pushers from afar leads to, else None.

        The direct one touches nothing: one that costs less by MOVING_SHARE moves what is to be moved, and is kept.
        """

        def is_kept(plan: Plan) -> bool:
            return meets_goals(plan) or is_cheaper(plan, direct, MOVING_SHARE)

        family = DistantContacts(self.problem)
        first = self._solve(family.at(family.factor), None, FIRST_ITERATIONS)
        if not self._report("distance", family.factor, first, is_kept(first)):
            return None
        # Beyond the reach of the force there is no gradient, so each step halves it, and no step is longer.
        s, halvings = math.log(family.factor), math.ceil(math.log2(family.factor))
        steps = replace(
            self._continuation("distance", family), first_share=1.0 / halvings, growth=1.0, min_share=0.1 / halvings,
            max_solves=2 * halvings + 16, look_iterations=DISTANT_ITERATIONS, meets_goals=is_kept,
        )  # fmt: skip
        s, plan = steps.run(s, first)
        if s > 0.0:
            return None
        if is_better(plan, direct):
            self.best = replace(plan, starts=direct.starts)  # where another way is cut
        return plan

    def _by_smoother_friction(self, direct: Plan) -> Plan | None:
        """The plan of the problem from that of one whose friction loss has no kink, where both meet their goals."""
        if not capabilities_of(self.problem.dynamics).friction_loss:
            return None
        smooth = self._solve(with_smoother_friction(self.problem), None, int(MAX_QUICK_ITERATIONS))
        better = smooth.cost < direct.cost or not meets_goals(direct)
        if not self._report("friction", SMOOTHER, smooth, meets_goals(smooth) and better):
            return None
        plan = self._solve(self.problem, smooth.motion, self.options.max_iterations)
        return plan if self._report("friction", 1.0, plan, plan.converged and meets_goals(plan)) else None

    def _by_softer_contacts(self, direct: Plan) -> Plan | None:
        """The plan that softer contacts lead to, else that of the cheapest attempt if it is promising; or None.

        What stands on softer ground stands lower: only the last plan has to meet the goals, and one that costs as much
        as that before lacks weight.
        """
        costs, attempts = list[float](), list[Plan]()

        def report(s: float, plan: Plan, kept: bool) -> None:
            attempts.extend([plan] * (s == 0.0))
            self._report("contacts", math.exp(s), plan, kept)

        def is_kept(plan: Plan) -> bool:
            if plan.problem is self.problem:
                return meets_goals(plan) or (bool(costs) and plan.cost <= costs[-1] + NEAR * abs(costs[-1]))
            costs.extend([plan.cost] if plan.status is Status.CONVERGED else [])
            return plan.status is Status.CONVERGED or is_cheaper(plan, direct, BETTER_SHARE)

        family = SofterContacts(self.problem)
        branch = replace(self._continuation("contacts", family), meets_goals=is_kept, report=report)
        soft = self._solve(family.at(family.factor), self.off_saddle, branch.look_iterations)
        comparable = direct.status is not Status.OUTSIDE_LIMITS and math.isfinite(direct.cost)
        harder = comparable and soft.cost > EASIER * max(1.0, direct.cost) and not meets_goals(soft)
        if not self._report("contacts", family.factor, soft, bool(np.isfinite(soft.xs).all()) and not harder):
            return None
        s, plan = branch.run(math.log(family.factor), soft)
        if s == 0.0:
            return plan
        better = [one for one in attempts if may_replace(one, direct) and is_promising(one, direct)]
        return self._resumed(min(better, key=lambda one: one.cost), self.options.max_iterations) if better else None

    def _is_near(self, direct: Plan) -> bool:
        """Whether a plan is at its goals, or lacks weight for them, on feet that stay or at a cost that has settled."""
        at_goals = meets_goals(direct) or lacks_weight(self.problem, direct)
        return at_goals and (stays_on_feet(self.problem, direct.xs) or is_settled(direct))

    def _resumed(self, plan: Plan, iterations: int, stage: str = "resumed") -> Plan:
        """A solve from where its iterations stopped it, for so many more at most; by default the direct one."""
        if iterations <= 0:
            return plan
        allowed = self._allowed(self.problem, iterations)
        further = self.solve_one(self.problem, self.options, None, plan.bound_penalties, plan.us, allowed, None)
        further = replace(further, starts=plan.starts)
        if self.best is plan and further.cost <= plan.cost:
            self.best = further
        self._report(stage, 1.0, further, not failed(further))
        return further

    def _branches(self, family: WiderLimits, free: Plan) -> Iterator[tuple[float, Plan]]:
        """The free plan, then those of other numbers of swings that meet the goal in wider limits, and their s."""
        yield max(math.log(max(family.factor, 1.0)), Continuation.min_step), free
        factor = min(SWING_FACTOR, max(family.factor, 1.0))
        for plan in self._swings("swing", family.at(factor), factor, swings(self.problem)):
            yield max(math.log(factor), Continuation.min_step), plan

    def _swings(self, stage: str, problem: Problem, factor: float, guesses: Iterable[np.ndarray]) -> Iterator[Plan]:
        """The plans of other numbers of swings that meet the goals, until MAX_REPEATS lead to one that was seen."""
        seen, again = list[float](), 0
        for us in guesses:
            plan = self.solve_one(problem, self.options, None, None, us, self._allowed(problem, FIRST_ITERATIONS), None)
            same = any(math.isclose(plan.cost, cost, rel_tol=SAME_COST) for cost in seen)
            kept, again = meets_goals(plan) and not same, again + same
            seen.append(plan.cost)
            if self._report(stage, factor, plan, kept):
                yield plan
            if again == MAX_REPEATS:
                return

    def _in_duration(self, problem: Problem, s: float, plan: Plan) -> tuple[float, Plan]:
        """0 and the plan in another duration if it passes, else the smallest s that was reached."""
        direct = self._solve(problem, None, FIRST_ITERATIONS)
        if self._report("duration", 1.0, direct, direct.converged and self.is_kept(direct)):
            return 0.0, direct
        family = WiderLimits(problem, 1.0, None, None)
        wider = self._solve(family.at(math.exp(s)), plan.motion.stretched(problem.duration), FIRST_ITERATIONS)
        kept = self.is_kept(wider) and (s > 0.0 or wider.converged)
        kept = self._report("duration", math.exp(s), wider, kept)
        return self._continuation("duration", family).run(s, wider) if kept else (s, plan)

    def _from_swings(self, problem: Problem) -> Plan | None:
        """The first plan of a problem from swings that passes."""
        return next((one for one in self._swings("duration", problem, 1.0, swings(problem)) if one.converged), None)

    def _passes_in(self, duration: float, plan: Plan) -> None:
        """Note a duration that passes; if its plan has weight for its goals, those of shorter ones are to, too."""
        self.passing["duration"], self.is_kept = duration, meets_goals if meets_goals(plan) else self.is_kept

    def _continuation(self, stage: str, family: WiderLimits | SofterContacts | DistantContacts) -> Continuation:
        return Continuation(
            lambda s: family.at(math.exp(s)), self._solve, self.is_kept,
            lambda s, plan, kept: self._report(stage, math.exp(s), plan, kept),
            max_iterations=self.options.max_iterations,
        )  # fmt: skip

    def _solve(self, problem: Problem, motion: Trajectory | None, max_iterations: int) -> Plan:
        solve, max_iterations = partial(self.solve_one, problem, self.options), self._allowed(problem, max_iterations)
        if motion is None:
            return solve(None, None, problem.first_guess, max_iterations, None)
        us, states, penalties = tracked_warm_start(problem, motion, self.options.max_warm_start_cost_ratio)
        us = us if problem.bounds is None else problem.bounds.clip(slice(None), us, None)
        return solve(states, penalties, us, max_iterations, None)

    def _allowed(self, problem: Problem, iterations: int) -> int:
        in_numpy = is_in_numpy(self.problem, self.options.rule)
        return iterations if self.budget is None else self.budget.iterations(problem, iterations, 1, in_numpy)

    def _report(self, stage: str, factor: float, plan: Plan, kept: bool) -> bool:
        row = (stage, factor, float(plan.t[-1]), plan.cost, plan.nit, plan.status, kept)
        self.steps.append(step := RelaxationStep(len(self.steps), *row))
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if self.budget is not None and stage != "direct":
            self.budget.charge(self.problem, plan.nit, is_in_numpy(self.problem, self.options.rule))
            if self.budget.exhausted and not (kept and factor == 1.0):
                raise _OutOfWorkError(self.budget.end)
        if self.callback is not None:
            self.callback(step)
        return kept

    def record(self) -> dict[str, Any]:
        """The solves, and the factor of the limits and the duration at which they pass; infinity is None."""
        rows = [
            [one.stage, one.factor if math.isfinite(one.factor) else None, *one[3:6], one.status.name, one.meets_goal]
            for one in self.steps
        ]
        return {"steps": rows, **self.passing}
