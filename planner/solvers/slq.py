"""SLQ, the paper's sequential linear quadratic algorithm (section 3.3).

    minimize J(U) of Eq. 9 over the controls U = [u(0) ... u(N-1)], the states being functions of U (Eq. 10):

    repeat   linearize the dynamics along the trajectory of U_k                         Eq. 35
             solve the LQ problem by the Riccati sweep; its controls are the direction  Eq. 31-34
             search along the direction                                                 Eq. 36
    until    the gradient (Eq. 19) or the reduction that the LQ problem expects (Eq. 42) is small.

Two updates. "open-loop" is the paper's, U + alpha dU. "feedback" rolls out u = us + alpha k + K (x - xs): the same
direction to first order, and its feedback stabilizes the rollout of unstable dynamics.
With "feedback" and Armijo's rule, the default, slowly converging steps are accelerated (see solvers.step_control).

With limits (see problem.limits) all iterates satisfy the bounds of the controls; bounds of the states and constraints
(see problem.constraints) take several such solves (see solvers.augmented_lagrangian).

It converges to a local minimum, which depends on the first guess; several starts may find a better one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.base.executors import checked_executor
from planner.dynamics.second_thread import second_thread
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.goals import has_tolerances
from planner.problem.initial_guess import Trajectory
from planner.problem.objective import seeks_duration, smoothed, solver_problem
from planner.problem.plan import Iteration, Plan, Status
from planner.problem.problem import Problem
from planner.problem.rediscretize import is_unresolved, stage_too_long
from planner.solvers.augmented_lagrangian import augmented_lagrangian
from planner.solvers.engine import Engine, acquire_engine, is_in_numpy, release_engine
from planner.solvers.gains import tracked_warm_start, with_robust_gains
from planner.solvers.multiple_shooting import close_defects, guessed_states, line_to_the_end
from planner.solvers.multistart import best_of
from planner.solvers.options import SolverOptions, with_overrides
from planner.solvers.other_guesses import has_diverged, stabilizing_guess
from planner.solvers.relaxation import relax
from planner.solvers.step_control import AndersonAcceleration, Regularization, unregularized_sweep
from planner.solvers.trapped import direct_iterations, is_trapped
from planner.solvers.work import UntilDeadline, WorkBudget, budget_of, with_cut


@second_thread()
def solve(
    problem: Problem,
    options: SolverOptions | None = None,
    *,
    states: np.ndarray | str | None = None,
    warm_start: Plan | Trajectory | None = None,
    callback: Callable[[Any], object] | None = None,
    rank: Callable[[Plan], float] | None = None,
    executor: Executor | None = None,
    budget: WorkBudget | float | None = None,
    update: str | None = None,
    line_search: str | None = None,
    hessian: str | None = None,
    max_iterations: int | None = None,
    gradient_tolerance: float | None = None,
    expected_reduction_tolerance: float | None = None,
    actual_reduction_tolerance: float | None = None,
    starts: int | None = None,
    seed: int | None = None,
    spread: float | None = None,
) -> Plan:
    """Solve a trajectory optimization problem.

    Where its objective has time, this is solve_for(problem): its duration is chosen by many solves. A plan's own
    problem has its duration already, and with `warm_start` any keeps it. One of energy is solved for effort first.

    Args:
        problem: The problem to solve.
        options: Settings of the algorithm; None for the defaults. See SolverOptions for the meaning of each. The
            common ones are keywords here too, and override those of `options`.
        states: A first guess of the states (N+1, nx), which need not be the rollout of the controls: the solve then
            begins by multiple shooting (see solvers.multiple_shooting). "line" for the straight line to the cost's
            final reference. None (default) for the rollout of the controls.
        warm_start: A Plan of the same robot to start from, or plan.shifted(seconds) or plan.stretched(duration). The
            first controls track it; where tracking fails, its states are a first guess. Limits and constraints begin
            with its multipliers. Its step and duration may differ from the problem's. None (default) starts from the
            problem's own guess.
        callback: Called with each Iteration, or for several starts with each Start as it ends, and with each
            RelaxationStep where a solve without success, or a slow one with contacts, is relaxed; print makes a table.
            It may raise StopIteration to end the solve. Where the duration is chosen, called with each DurationTrial.
        rank: A function of a Plan: the start with the lowest value is returned. By default its cost; proof.proven_cost
            is its cost in MuJoCo. Non-finite values rank last.
        executor: Any concurrent.futures.Executor for the starts; by default threads. The plan is the same to the last
            bit.
        budget: Work that the solve may take, or a WorkBudget (see solvers.work): counted, about a unit a second, so
            that the plan is the same on any computer. Of several starts each gets an equal share. A solve that it cuts
            ends with WORK_LIMIT, one that its deadline cuts with TIME_LIMIT. None (default) for no limit.
        update: "feedback" (default) or "open-loop" (the paper's Eq. 36).
        line_search: "armijo" (default), "exact", "wolfe" or "goldstein".
        hessian: "gauss-newton" (default, the paper's) or "exact", with the second derivatives of the dynamics (DDP).
        max_iterations: Limit of the iterations; 1000 by default.
        gradient_tolerance: Converged when the norm of the gradient (Eq. 19) is at most this (Eq. 20).
        expected_reduction_tolerance: Converged when the LQ problem expects a reduction of at most this times max(1, J).
        actual_reduction_tolerance: Converged also when iterations in a row each reduce the cost by less than this times
            max(1, J).
        starts: Number of first guesses: the problem's own, and smooth random changes of its controls, with the straight
            line of states where `states` is None and all final weights are positive. They run on all processors. The
            number of processors does not change the plan.
        seed: Seed of the random changes.
        spread: Size of the random changes, relative to the RMS of the first guess's controls, or of those after
            `pilot_iterations` if that is larger.

    Returns:
        A Plan. Of several starts it is the one of lowest rank among those that converged, or among all if none did;
        its `starts` list all. A solve that does not converge sets its status and raises nothing. Ctrl-C returns the
        best plan so far, with status INTERRUPTED.

    Raises:
        PlannerError: An argument that is no valid choice or out of range.
    """
    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
    own = with_overrides(
        options, update=update, line_search=line_search, hessian=hessian, max_iterations=max_iterations,
        gradient_tolerance=gradient_tolerance, expected_reduction_tolerance=expected_reduction_tolerance,
        actual_reduction_tolerance=actual_reduction_tolerance, starts=starts, seed=seed, spread=spread,
    )  # fmt: skip
    checked_executor(executor)
    if callback is not None and not callable(callback):
        raise PlannerError(f"callback is {short_repr(callback)}, expected a function of one line of progress.")
    if rank is not None and not callable(rank):
        raise PlannerError(
            f"rank is {short_repr(rank)}, expected a function of a Plan, e.g. planner.proof.proven_cost."
        )
    work = budget_of(budget)
    if seeks_duration(problem) and warm_start is None and problem.periodic is None:  # a cycle's duration is fixed
        from planner import solve_for  # at first use, since it is made of solves

        given: dict[str, Any] = {"states": states, "rank": rank, "executor": executor, "budget": work}
        return solve_for(problem, callback=callback, options=own, **given)

    one = with_overrides(own, starts=1)
    problem = smoothed(problem, partial(solve, options=one, warm_start=warm_start, budget=work))
    settings = own.for_problem(problem)
    asked, deadline = settings.max_iterations, None
    if work is not None:
        deadline = work.deadline
        affordable = work.iterations(problem, asked, settings.starts, is_in_numpy(problem, settings.rule))
        settings = with_overrides(settings, max_iterations=affordable)
    whole = with_overrides(settings, max_iterations=asked)
    beside = penalties = None
    if warm_start is not None:
        us, beside, penalties = tracked_warm_start(problem, warm_start, settings.max_warm_start_cost_ratio)
        problem = replace(problem, us=us)
    core = solver_problem(problem)
    if states is None and beside is not None and core.dynamics.nx == problem.dynamics.nx:  # jerk augments the state
        states = beside
    solve_one = partial(
        _solve_from_guess, core, settings, guessed_states(core, states), penalties, deadline=deadline
    )  # fmt: skip
    recorded = own.recorded(problem)
    if states is not None and warm_start is None:
        recorded["states"] = "line" if isinstance(states, str) else "given"
    if warm_start is not None:
        recorded["warm_start"] = "given"
    if rank is not None:
        recorded["rank"] = getattr(rank, "__name__", type(rank).__name__)
    ranking = rank if rank is None or core is problem else lambda plan: rank(as_user_plan(problem, plan))

    may_relax = warm_start is None and core.dynamics is problem.dynamics

    def solved(guess: np.ndarray) -> Plan:
        if settings.starts == 1:
            limit = direct_iterations(core, whole) if may_relax else asked
            return solve_one(guess, min(settings.max_iterations, limit), callback)
        pilot, others = partial(solve_one.func, core, settings, None, None, **solve_one.keywords), solve_one
        if states is None and (line := line_to_the_end(core)) is not None:
            others = partial(solve_one.func, core, settings, line, penalties, **solve_one.keywords)
        return best_of(guess, solve_one, settings, callback, ranking, pilot, others, executor)

    best = solved(core.first_guess)
    if best.status is Status.NOT_FINITE and not best.history:  # the first rollout diverged
        steady = stabilizing_guess(core)
        if steady is not None:
            recorded["first_guess"] = (
                f"It runs away at t = {best.t[np.argmax(has_diverged(best.xs))]:.4g} s, so it was replaced by controls "
                "that hold or brake the machine with feedback."
            )
            best = solved(steady)
    if work is not None:
        work.charge(problem, best.total_iterations, is_in_numpy(problem, settings.rule))
    if (
        may_relax and not (work is not None and (work.exhausted or work.iterations(core, 2) < 2))
        and is_trapped(core, best, whole)  # the budget has not cut it: some is left
    ):  # fmt: skip
        solve_again = partial(_solve_from_guess, deadline=deadline)
        best, recorded["relaxation"] = relax(core, best, solve_again, whole, callback, work)
    if best.status is Status.NOT_FINITE and (cure := stage_too_long(problem)):
        recorded["not_finite"] = cure
    if work is not None:
        best = with_cut(best, work, settings.max_iterations < asked, recorded)
    return with_robust_gains(judged_status(replace(as_user_plan(problem, best), options=recorded)))


def judged_status(plan: Plan) -> Plan:
    """A converged plan whose status says if its steps do not resolve its motion, or if it misses a goal.

    Of goals those count that have a tolerance (see has_tolerances). Machines with a rule of their own are judged by it,
    in a proof, which shows the error of the steps of every plan.
    """
    if plan.status is not Status.CONVERGED or plan.problem is None:
        return plan
    own = plan.problem.requirements
    try:
        if (own is None or own.goal is None) and is_unresolved(plan):
            return replace(plan, status=Status.UNRESOLVED)
        misses_goal = bool(has_tolerances(plan.problem) and plan.missed_goals)
    except KeyboardInterrupt:
        return replace(plan, status=Status.INTERRUPTED)
    return replace(plan, status=Status.GOAL_MISSED) if misses_goal else plan


def as_user_plan(problem: Problem, plan: Plan) -> Plan:
    """Convert a plan of solver_problem(problem) to one of the problem, with its states, cost and gains."""
    if plan.problem is problem:
        return plan
    own = _inner_solve(problem, SolverOptions(), None, None, plan.us, plan.bound_penalties, 0, 0)
    more = own.cost - plan.cost  # of terms independent of the controls
    history = tuple(line._replace(cost=line.cost + more) for line in plan.history)
    return replace(own, status=plan.status, history=history, starts=plan.starts, bound_penalties=plan.bound_penalties)


def _solve_from_guess(
    problem: Problem, options: SolverOptions, states: np.ndarray | None, penalties: BoundPenalties | None,
    first_guess: np.ndarray, max_iterations: int, callback: Callable[[Iteration], object] | None,
    deadline: float | None = None,
) -> Plan:  # fmt: skip
    """One solve from first controls (N, nu), states (N+1, nx) or None, and penalties or None, until a deadline."""
    callback = callback if deadline is None else UntilDeadline(deadline, callback)
    minimize = partial(_inner_solve, problem, options, callback, states)
    if problem.trajectory_constraints is None:
        return minimize(first_guess, None, max_iterations, 0)
    constraints = problem.trajectory_constraints
    return augmented_lagrangian(
        constraints, constraints.tolerance, minimize, first_guess, max_iterations, penalties, options
    )


def _inner_solve(
    problem: Problem, options: SolverOptions, callback: Callable[[Iteration], object] | None, states: np.ndarray | None,
    first_guess: np.ndarray, penalties: BoundPenalties | None, max_iterations: int, first_line: int,
    inexact_tolerance: float = 0.0,
) -> Plan:  # fmt: skip
    """Minimize the cost plus the penalties, if any; the states are used only if `first_line` is 0.

    With `inexact_tolerance` it ends before the minimum: once the expected reduction is at most this times max(1, J), or
    once the actual reduction of a full step differs from the expected one by less.
    """
    engine, rule, exact = acquire_engine(problem, options.rule), options.rule, options.exact_hessian
    if penalties is not None:
        engine.set_penalties(penalties)
    history, status = list[Iteration](), Status.MAX_ITERATIONS
    if states is not None and first_line == 0:
        cost, history, interrupted = close_defects(
            problem, engine, exact, states, first_guess, max_iterations, callback, penalties, options
        )
        status = Status.INTERRUPTED if interrupted else status
    else:
        cost = engine.start_from_controls(problem.x0, first_guess, exact)
    if not math.isfinite(cost) or has_diverged(engine.trajectory()[0]).any():
        return _not_finite(problem, engine, cost)

    # At kinks of contacts and friction a weight on changes of the states does not help.
    machine = capabilities_of(problem.dynamics)
    smooth = options.feedback and not (machine.contacts or machine.stops or machine.friction_loss)
    at_bounds = problem.bounds is not None and not (machine.contacts or machine.friction_loss)
    regularization = Regularization(engine, exact, exact or states is not None, at_bounds, smooth, options)
    acceleration = AndersonAcceleration(problem, engine, options)
    has_inequalities = problem.limits is not None or problem.trajectory_constraints is not None
    tolerance = max(inexact_tolerance, options.expected_reduction_tolerance or 0.0)
    relinearize, linearized, stationary, converged_inexactly = True, True, False, False
    try:
        while len(history) < max_iterations and status is not Status.INTERRUPTED:
            # 1. Linearize and solve the LQ problem.
            linearized = relinearize
            direction = engine.compute_direction(regularization.mu, relinearize)
            if not direction.definite and regularization.drop_second_order():
                relinearize = False
                continue

            # 2. Search along the direction. Convergence is tested only without regularization, which shrinks the
            # expected reduction.
            min_reduction = tolerance * max(1.0, abs(cost)) if regularization.unregularized else -1.0
            at_minimum = direction.definite and direction.is_stationary(options.gradient_tolerance, min_reduction)
            step, after = 0.0, cost
            if direction.definite and not at_minimum:
                step, after = engine.line_search(options.feedback, rule, cost, direction.slope)

            # 3. Expected and actual reduction.
            expected = direction.expected_reduction(step) if direction.definite else 0.0
            model_error = abs(cost - after - expected)
            accurate = step == 1.0 and regularization.unregularized
            accurate = accurate and model_error < inexact_tolerance * max(1.0, abs(cost))
            if step > 0.0 and not accurate and options.accelerated:
                after = acceleration.extrapolate(cost, after, step, expected)
            number, weight = first_line + len(history), regularization.weight
            line = Iteration(number, cost, direction.gradient_norm, step, expected, cost - after, weight)
            history.append(line)
            cost = after
            if callback is not None:
                callback(line)

            # 4. Stopping criteria.
            stationary, converged_inexactly, relinearize = at_minimum, accurate, step > 0.0
            if stationary or converged_inexactly or _reductions_are_small(history, options):
                status = Status.CONVERGED
                break

            # 5. Increase or decrease the regularization.
            reduction = -0.5 * direction.slope if direction.definite else math.inf
            min_reduction = tolerance * max(1.0, abs(cost))
            if regularization.try_unregularized(relinearize, reduction, min_reduction):
                continue
            if relinearize:
                small = (reduction if smooth else expected) <= min_reduction
                regularization.decrease(step, has_inequalities and small)
                continue
            regularization.increase()
            if regularization.exhausted:
                status = Status.NO_DESCENT
                break
    except (KeyboardInterrupt, StopIteration):
        status = Status.INTERRUPTED

    xs, us = engine.trajectory()
    if stationary:
        gradient_norm = history[-1].gradient_norm
        if engine.curved or regularization.of_states or not regularization.unregularized or not linearized:
            # The gains of a plan are those of the LQ problem of Eq. 31. A sweep with an earlier one's active penalties
            # may have violations of rounding's size, times their weight, in its gradient.
            gradient_norm = unregularized_sweep(engine, options).gradient_norm
    else:  # gains and gradient belong to an earlier trajectory
        cost, last = problem.cost.value(xs, us), unregularized_sweep(engine, options)
        gradient_norm = last.gradient_norm
        if not converged_inexactly:  # the next round records this trajectory
            history.append(Iteration(first_line + len(history), cost, gradient_norm, 0.0, last.expected, 0.0, 0.0))
    if penalties is not None:  # a plan has the cost without penalties
        cost = problem.cost.value(xs, us)
    if problem.bounds is not None and problem.bounds.servos is not None:
        # Gains that follow a bound of force would have the set-point follow the joint: the servo's stiffness is lost.
        engine.holds_bounds = True
        unregularized_sweep(engine, options)
        engine.holds_bounds = False
    K = engine.gains()
    # Open-loop costates overflow where stages are too long, and in long motions that only feedback makes stable.
    overflows = not math.isfinite(gradient_norm) and (machine.mechanism is None or bool(stage_too_long(problem)))
    if status is not Status.INTERRUPTED and (overflows or not np.isfinite(K).all()):
        status = Status.NOT_FINITE
    release_engine(problem, engine, rule)
    return _plan(problem, xs, us, K, cost, gradient_norm, status, history)


def _reductions_are_small(history: list[Iteration], options: SolverOptions) -> bool:
    """Whether the last iterations, all without regularization, each reduced the cost by less than the tolerance."""
    tolerance, last = options.actual_reduction_tolerance, history[-options.max_slow_iterations :]
    return (
        bool(tolerance)
        and len(last) == options.max_slow_iterations
        and all(
            line.step > 0.0 and line.regularization == 0.0 and line.actual < tolerance * max(1.0, abs(line.cost))
            for line in last
        )
    )


def _not_finite(problem: Problem, engine: Engine, cost: float) -> Plan:
    """The plan of a diverging first guess: zero gains, gradient norm NaN."""
    xs, us = engine.trajectory()
    K = np.zeros((*us.shape, space_of(problem.dynamics).ndx))
    return _plan(problem, xs, us, K, cost, math.nan, Status.NOT_FINITE, [])


def _plan(
    problem: Problem, xs: np.ndarray, us: np.ndarray, K: np.ndarray, cost: float, gradient_norm: float,
    status: Status, history: list[Iteration],
) -> Plan:  # fmt: skip
    return Plan(
        problem.dynamics.dt * np.arange(len(xs)), xs, us, K, cost, gradient_norm, status, tuple(history), problem,
        problem.recipe, problem.twin,
    )  # fmt: skip
