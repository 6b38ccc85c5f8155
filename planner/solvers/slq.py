"""SLQ, the paper's sequential linear quadratic algorithm (section 3.3), told top to bottom.

    minimize J(U) of Eq. 9 over the controls U = [u(0) ... u(N-1)], the states being functions of U (Eq. 10):

    repeat   linearize the dynamics along the trajectory of U_k                         Eq. 35
             solve the LQ problem by the Riccati sweep; its controls are the direction  Eq. 31-34
             search along the direction                                                 Eq. 36
    until    the gradient (Eq. 19) or the decrease that the LQ problem promises (Eq. 42) is small.

Two updates. "open-loop" is the paper's, U + alpha dU. "feedback" rolls out u = us + alpha k + K (x - xs): the same
direction to first order, and it stays near the trajectory where the dynamics are unstable.
With "feedback" and Armijo's rule, the default, steps that converge slowly are accelerated (see solvers.anderson).

With limits (see problem.limits) the controls stay within their bounds all along, and for ranges of the states
and constraints (see problem.constraints) this is done several times over (see solvers.augmented_lagrangian).

It ends in a local minimum, the one its first guess leads to; with several starts solve() looks for a better one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.base.executors import checked_executor
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE
from planner.model.space import space_of
from planner.problem.objective_problem import solver_problem
from planner.problem.plan import Iteration, Plan, Status
from planner.problem.problem import Problem
from planner.problem.rediscretize import stage_too_long
from planner.problem.state_bounds import BoundPenalties
from planner.problem.trajectory import Trajectory
from planner.solvers.anderson import AndersonAcceleration
from planner.solvers.augmented_lagrangian import augmented_lagrangian
from planner.solvers.engine import Engine, IterationResult, acquire_engine, release_engine
from planner.solvers.multiple_shooting import close_defects, guessed_states, line_to_the_end
from planner.solvers.multistart import MAX_STARTS, best_of
from planner.solvers.regularization import Regularization, plain_sweep
from planner.solvers.stabilizing_guess import has_diverged, stabilizing_guess
from planner.solvers.warm_start import tracked_warm_start

UPDATES = ("feedback", "open-loop")
HESSIANS = ("gauss-newton", "exact")
LINE_SEARCHES = ("armijo", "exact", "wolfe", "goldstein")  # in the order of kernels.lq.line_search

DECREASE = 1e-10  # expected_reduction_tolerance where neither the call nor the problem sets one

NONSMOOTH_REDUCTION_TOLERANCE = (
    1e-5  # actual_reduction_tolerance of machines with friction loss where neither the call nor the problem sets one
)

_SLOW = 2  # iterations in a row of the plain model that gain less than actual_reduction_tolerance end a solve
_SLOWER = 8  # the same with KINKED: while joints change the sign of their friction little is gained, then more


def solve(
    problem: Problem,
    *,
    update: str = "feedback",
    line_search: str = "armijo",
    hessian: str = "gauss-newton",
    states: np.ndarray | str | None = None,
    warm_start: Plan | Trajectory | None = None,
    max_iterations: int = 1000,
    gradient_tolerance: float = 1e-8,
    expected_reduction_tolerance: float | None = None,
    actual_reduction_tolerance: float | None = None,
    callback: Callable[[Any], object] | None = None,
    starts: int = 1,
    seed: int = 0,
    spread: float = 1.0,
    rank: Callable[[Plan], float] | None = None,
    executor: Executor | None = None,
) -> Plan:
    """Optimize a motion.

    Args:
        problem: The problem to solve.
        update: "feedback" (default) or "open-loop" (the paper's Eq. 36).
        line_search: "armijo" (default), "exact", "wolfe" or "goldstein".
        hessian: "gauss-newton" (default, the paper's) or "exact": with the second derivatives of the dynamics, which
            makes it differential dynamic programming. Far fewer iterations where the end is hard to reach and the
            cost is small against the curvature; each takes longer.
        states: A first guess of the states (N+1, nx) beside that of the controls, which need not fit it: the solve then
            begins by multiple shooting (see solvers.multiple_shooting). "line" for the straight line to the cost's
            reference
            at the end. None (default) for the states that the controls lead to.
        warm_start: A Plan of the same machine to start from, or plan.shifted(seconds) or plan.stretched(duration). The
            first controls are those that follow it; where no controls do, its states are a first guess. Limits and
            constraints begin with its multipliers. Its step and duration may differ from the problem's. None
            (default) starts from the problem's own guess.
        max_iterations: The most iterations.
        gradient_tolerance: Stop when the norm of Eq. 19 falls below this (Eq. 20).
        expected_reduction_tolerance: Stop when the LQ model promises less than this times max(1, J). By default the
        problem's,
            or 1e-10 if it has none.
        actual_reduction_tolerance: Stop also when two iterations in a row have each gained less than this times max(1,
        J);
            iterations with regularization do not count. It ends solves at kinks of contact, where the LQ model keeps
            promising a decrease that no step achieves. By default the problem's. If it has none: 1e-5 in eight
            iterations for machines with friction loss, which has such kinks too, else 0 (never).
        callback: Called with each Iteration, or with several starts with each Start as it ends; print makes a table.
            It may raise StopIteration to end the solve.
        starts: Number of first guesses: the problem's own, and smooth random changes of its controls, beside the
            straight line of states where `states` is None and the cost asks for a whole state at the end. They run on
            all processors. The number of processors does not change the plan.
        seed: Seed of the random changes.
        spread: Size of the random changes, relative to the controls of the first guess, or to those that five
            iterations make of it if these are larger.
        rank: A function of a Plan: the start with the least value wins. By default its cost; proof.proven_cost is its
            cost in MuJoCo. A number that is not finite comes last.
        executor: Where the starts are solved, any concurrent.futures.Executor; by default threads. The plan is the
            same to the last bit.

    Returns:
        A Plan. Of several starts it is the one of least rank among those that converged, or among all if none did;
        its `starts` list the others. A solve that does not converge says so in its status and raises nothing. Ctrl-C
        returns the best plan so far, with status INTERRUPTED.

    Raises:
        PlannerError: An argument that is none of the choices or out of range.
    """
    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
    if expected_reduction_tolerance is None:
        expected_reduction_tolerance = (
            DECREASE if problem.expected_reduction_tolerance is None else problem.expected_reduction_tolerance
        )
    slow = _SLOW
    if actual_reduction_tolerance is None:
        actual_reduction_tolerance = problem.actual_reduction_tolerance or (
            NONSMOOTH_REDUCTION_TOLERANCE if _has_friction_loss(problem) else 0.0
        )
        slow = _SLOW if problem.actual_reduction_tolerance else _SLOWER
    descent = _Settings(
        choice("update", update, UPDATES) == "feedback",
        LINE_SEARCHES.index(choice("line_search", line_search, LINE_SEARCHES)),
        choice("hessian", hessian, HESSIANS) == "exact",
        number("gradient_tolerance", gradient_tolerance, minimum=0.0),
        number("expected_reduction_tolerance", expected_reduction_tolerance, minimum=0.0),
        number("actual_reduction_tolerance", actual_reduction_tolerance, minimum=0.0),
        slow,
    )
    count("max_iterations", max_iterations)
    count("starts", starts, maximum=MAX_STARTS)
    count("seed", seed, minimum=0)
    number("spread", spread, greater_than=0.0)
    checked_executor(executor)
    if callback is not None and not callable(callback):
        raise PlannerError(f"callback is {short_repr(callback)}, expected a function of one line of progress.")
    if rank is not None and not callable(rank):
        raise PlannerError(
            f"rank is {short_repr(rank)}, expected a function of a Plan, e.g. planner.proof.proven_cost."
        )

    beside = penalties = None
    if warm_start is not None:
        us, beside, penalties = tracked_warm_start(problem, warm_start)
        problem = replace(problem, us=us)
    core = solver_problem(problem)
    if states is None and beside is not None and core.dynamics.nx == problem.dynamics.nx:  # jerk has more
        states = beside
    descend = partial(_solve_from_guess, core, descent, guessed_states(core, states), penalties)
    options: dict[str, Any] = {
        "update": update, "line_search": line_search, "hessian": hessian, "max_iterations": max_iterations,
        "gradient_tolerance": gradient_tolerance, "expected_reduction_tolerance": expected_reduction_tolerance,
        "actual_reduction_tolerance": descent.actual_reduction_tolerance, "starts": starts,
    }  # fmt: skip
    if starts > 1:
        options |= {"seed": seed, "spread": spread}
    if states is not None and warm_start is None:
        options["states"] = "line" if isinstance(states, str) else "given"
    if warm_start is not None:
        options["warm_start"] = "given"
    if rank is not None:
        options["rank"] = getattr(rank, "__name__", type(rank).__name__)
    ranking = rank if rank is None or core is problem else lambda plan: rank(as_user_plan(problem, plan))

    def solved(guess: np.ndarray) -> Plan:
        if starts == 1:
            return descend(guess, max_iterations, callback)
        sizing, others = partial(_solve_from_guess, core, descent, None, None), descend
        if states is None and (line := line_to_the_end(core)) is not None:
            others = partial(_solve_from_guess, core, descent, line, penalties)
        return best_of(
            guess, descend, max_iterations, starts, seed, spread, callback, ranking, sizing, others, executor
        )

    best = solved(core.first_guess)
    if best.status is Status.NOT_FINITE and not best.history:  # it had no first rollout
        steady = stabilizing_guess(core)
        if steady is not None:
            options["first_guess"] = (
                f"It runs away at t = {best.t[np.argmax(has_diverged(best.xs))]:.4g} s, so it was replaced by controls "
                "that hold or brake the machine with feedback."
            )
            best = solved(steady)
    if best.status is Status.NOT_FINITE and (cure := stage_too_long(problem)):
        options["not_finite"] = cure
    return replace(as_user_plan(problem, best), options=options)


def as_user_plan(problem: Problem, plan: Plan) -> Plan:
    """A plan of its solver_problem as one of the problem itself: its states, its cost, its gains."""
    if plan.problem is problem:
        return plan
    own = _inner_solve(problem, _Settings(), None, None, plan.us, plan.bound_penalties, 0, 0)
    more = own.cost - plan.cost  # of terms that no control changes
    history = tuple(line._replace(cost=line.cost + more) for line in plan.history)
    return replace(own, status=plan.status, history=history, starts=plan.starts, bound_penalties=plan.bound_penalties)


def _has_friction_loss(problem: Problem) -> bool:
    """Whether joints of the machine have friction loss."""
    mechanism = getattr(problem.dynamics, "mechanism", None)
    return mechanism is not None and bool(np.any(mechanism.friction_loss))


def _has_contacts(problem: Problem) -> bool:
    """Whether the machine has contacts."""
    mechanism = getattr(problem.dynamics, "mechanism", None)
    return mechanism is not None and bool(mechanism.contacts or mechanism.body_contacts)


class _Settings(NamedTuple):
    """How a solve goes down: the checked arguments of solve()."""

    feedback: bool = True
    rule: int = 0  # index in LINE_SEARCHES
    exact: bool = False
    gradient_tolerance: float = 0.0
    expected_reduction_tolerance: float = 0.0
    actual_reduction_tolerance: float = 0.0
    max_slow_iterations: int = _SLOW  # iterations in a row that gain less end a solve

    @property
    def accelerated(self) -> bool:
        """Whether steps that converge slowly are; what the paper and its theorems are about is left as it is."""
        return self.feedback and LINE_SEARCHES[self.rule] == "armijo"


def _solve_from_guess(
    problem: Problem, descent: _Settings, states: np.ndarray | None, penalties: BoundPenalties | None, first_guess:
    np.ndarray,
    max_iterations: int, callback: Callable[[Iteration], object] | None,
) -> Plan:  # fmt: skip
    """One solve from one first guess (N, nu), and of states (N+1, nx) or None, and of penalties or None."""
    minimize = partial(_inner_solve, problem, descent, callback, states)
    if problem.trajectory_constraints is None:
        return minimize(first_guess, None, max_iterations, 0)
    return augmented_lagrangian(
        problem.trajectory_constraints,
        problem.trajectory_constraints.tolerance,
        minimize,
        first_guess,
        max_iterations,
        penalties,
    )


def _inner_solve(
    problem: Problem, descent: _Settings, callback: Callable[[Iteration], object] | None, states: np.ndarray | None,
    first_guess: np.ndarray, penalties: BoundPenalties | None, max_iterations: int, first_line: int,
    inexact_tolerance: float = 0.0,
) -> Plan:  # fmt: skip
    """A minimum of the cost, and of penalties where there are any; only a solve's first line looks at states.

    It also ends where less than `loose` times max(1, J) is left to gain, which is no minimum yet: so much is promised,
    or a full step has gained what was promised of it to within so much.
    """
    engine = acquire_engine(problem, descent.rule)
    if problem.trajectory_constraints is not None:
        engine.set_penalties(penalties)
    history, regularize_states, interrupted = list[Iteration](), descent.exact or states is not None, False
    if states is not None and first_line == 0:
        closed = close_defects(problem, engine, descent.exact, states, first_guess, max_iterations, callback, penalties)
        cost, history, interrupted = closed
    else:
        cost = engine.start_from_controls(problem.x0, first_guess, descent.exact)
    if not math.isfinite(cost) or has_diverged(engine.trajectory()[0]).any():
        return _not_finite(problem, engine, cost)

    bounded = problem.bounds is not None and not _has_contacts(problem)  # at kinks of contact states are held in vain
    regularization, acceleration = (
        Regularization(engine, descent.exact, regularize_states, bounded),
        AndersonAcceleration(problem, engine),
    )
    has_inequalities = problem.limits is not None or problem.trajectory_constraints is not None
    relinearize, at_minimum, inexactly_converged, status = (
        True,
        False,
        False,
        Status.INTERRUPTED if interrupted else Status.MAX_ITERATIONS,
    )
    try:
        while len(history) < max_iterations and not interrupted:
            # A regularized model promises too little: only the plain one may say that nothing is left to gain.
            mu = regularization.mu
            tolerance = max(inexact_tolerance, descent.expected_reduction_tolerance)
            promise = tolerance * max(1.0, abs(cost)) if regularization.unregularized else -1.0
            tolerances = descent.gradient_tolerance, promise
            done = engine.iterate(descent.feedback, descent.rule, mu, relinearize, cost, *tolerances)
            if done.kind == INDEFINITE and regularization.drop_second_order():
                relinearize = False
                continue
            relinearize, inexactly_converged = (
                done.kind == ACCEPTED,
                _as_promised(done, cost, regularization.unregularized, inexact_tolerance),
            )
            after = (
                acceleration.after(cost, done)
                if relinearize and not inexactly_converged and descent.accelerated
                else done.cost
            )
            i, shown = first_line + len(history), regularization.shown
            line = Iteration(i, cost, done.gradient_norm, done.step, done.expected, cost - after, shown)
            history.append(line)
            cost = after
            if callback is not None:
                callback(line)

            at_minimum = done.kind == CONVERGED
            if at_minimum or inexactly_converged or _stalled(history, descent):
                status = Status.CONVERGED
                break
            min_reduction = tolerance * max(1.0, abs(cost))
            small_expected_reduction = done.kind != INDEFINITE and -0.5 * done.slope <= min_reduction
            if regularization.try_unregularized(relinearize, small_expected_reduction):
                continue
            if relinearize:
                regularization.decrease(done.step, has_inequalities and done.expected <= min_reduction)
                continue
            regularization.increase()
            if regularization.exhausted:
                status = Status.NO_DESCENT
                break
    except (KeyboardInterrupt, StopIteration):
        status = Status.INTERRUPTED

    xs, us = engine.trajectory()
    if at_minimum:
        gradient_norm = history[-1].gradient_norm
        if regularize_states or bounded or not regularization.unregularized:
            plain_sweep(engine)  # the gains of a plan are those of the plain model of Eq. 31
    else:  # gains and gradient belong to an earlier trajectory
        cost, last = problem.cost.value(xs, us), plain_sweep(engine)
        gradient_norm = last.gradient_norm
        if not inexactly_converged:  # the next round has the line of this trajectory
            history.append(Iteration(first_line + len(history), cost, gradient_norm, 0.0, last.expected, 0.0, 0.0))
    if penalties is not None:  # the cost of a plan is that of its problem
        cost = problem.cost.value(xs, us)
    K = engine.gains()
    if status is not Status.INTERRUPTED and not (math.isfinite(gradient_norm) and np.isfinite(K).all()):
        status = Status.NOT_FINITE  # stages so unstable that costates overflow; their model promises nothing
    plan = _plan(problem, xs, us, K, cost, gradient_norm, status, history)
    release_engine(problem, engine, descent.rule)
    return plan


def _as_promised(done: IterationResult, cost: float, plain: bool, inexact_tolerance: float) -> bool:
    """Whether a full step of the plain model gained what it promised to within loose max(1, J)."""
    off = abs(cost - done.cost - done.expected)
    return done.step == 1.0 and plain and off < inexact_tolerance * max(1.0, abs(cost))


def _stalled(history: list[Iteration], descent: _Settings) -> bool:
    """Whether the last iterations of the plain model have each gained less than the tolerance."""
    least = descent.actual_reduction_tolerance
    return (
        least > 0.0
        and len(history) >= descent.max_slow_iterations
        and all(
            line.step > 0.0 and line.regularization == 0.0 and line.actual < least * max(1.0, abs(line.cost))
            for line in history[-descent.max_slow_iterations :]
        )
    )


def _not_finite(problem: Problem, engine: Engine, cost: float) -> Plan:
    """The plan of a first guess that runs away: no gains, no gradient."""
    xs, us = engine.trajectory()
    K = np.zeros((*us.shape, space_of(problem.dynamics).ndx))
    return _plan(problem, xs, us, K, cost, math.nan, Status.NOT_FINITE, [])


def _plan(
    problem: Problem, xs: np.ndarray, us: np.ndarray, K: np.ndarray, cost: float, gradient_norm: float,
    status: Status, history: list[Iteration],
) -> Plan:  # fmt: skip
    t = problem.dynamics.dt * np.arange(len(xs))
    return Plan(
        t, xs, us, K, cost, gradient_norm, status, tuple(history), problem,
        problem.recipe, problem.twin,
    )  # fmt: skip
