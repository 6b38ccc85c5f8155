"""Multistart: SLQ from several first guesses, since it converges to a local minimum.

Start 0 is the problem's own first guess; start k adds a smooth random change, drawn from (seed, k) alone:

    u(n) = guess(n) + spread scale sum over m < 6 of a_m cos(pi m (n + 1/2) / N),   a_m normal, sd falling as 1/(1 + m)

with an expected RMS of 1 of the sum, and a scale per control in its unit: the RMS of the guess, or of the controls
after pilot_iterations from it if larger.
If all final weights are positive, starts from 1 on also begin with the straight line of states to the final reference
(solvers.multiple_shooting), since rollouts of random controls rarely lead back to it.
Starts run on threads or a given executor; the selected plan does not depend on their timing. Plans are ranked one at a
time, in the caller's thread.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from threading import Event

import numpy as np

from planner.base.arguments import short_repr
from planner.base.environment import processors
from planner.base.errors import PlannerError
from planner.base.executors import cancel_or_end, result_or_retry
from planner.problem.plan import Iteration, Plan, Start, Status
from planner.solvers.options import SolverOptions

_MODES = 6  # number of cosines: 0 to 2.5 periods over the horizon


# One solve from a first guess (N, nu), with an iteration limit and a callback.
SolveOne = Callable[[np.ndarray, int, Callable[[Iteration], object] | None], Plan]


def best_of(
    guess: np.ndarray, solve_one: SolveOne, options: SolverOptions, callback: Callable[[Start], object] | None,
    rank: Callable[[Plan], float] | None = None, pilot: SolveOne | None = None, others: SolveOne | None = None,
    executor: Executor | None = None,
) -> Plan:  # fmt: skip
    """The plan of lowest rank among the converged starts, or among all if none converged.

    Args:
        guess: Controls (N, nu) of start 0; the other starts add random changes.
        solve_one: One solve from a first guess.
        options: Number of starts, random changes, iteration limit of each solve.
        callback: Called with each Start, in order, as soon as it and those before it have ended.
        rank: Function of a Plan, lower is better; its cost by default.
        pilot: The solve whose first iterations scale the random changes; `solve_one` by default.
        others: One solve from a changed guess; `solve_one` by default.
        executor: Runs the starts; by default one thread per processor.
    """
    max_iterations, starts = options.max_iterations, options.starts
    first = (pilot or solve_one)(guess, min(options.pilot_iterations, max_iterations), None)
    if first.status is Status.INTERRUPTED:
        return replace(first, starts=(_summary(0, first, first.cost),))
    stop, scale = _Stop(), options.spread * _sizes(guess, first.us)
    run = partial(_run, solve_one, others or solve_one, guess, scale, options.seed, max_iterations, stop)
    ended: list[Start] = []
    best: Plan | None = None
    waiting: deque[tuple[int, Future[Plan]]] = deque()
    submitted, interrupted = 0, False
    own = ThreadPoolExecutor(min(starts, processors())) if executor is None else nullcontext(executor)
    with own as pool:
        try:
            while waiting or (submitted < starts and not interrupted):
                try:
                    while submitted < starts and not interrupted:
                        waiting.append((submitted, pool.submit(run, submitted)))
                        submitted += 1
                    number, plan = waiting[0][0], result_or_retry(pool, waiting[0][1], run, waiting[0][0])
                    if executor is not None:  # plans of another process have a copy of the problem
                        plan = replace(plan, problem=first.problem)
                    summary = _summary(number, plan, _score(rank, plan))
                    waiting.popleft()
                    if best is None or summary.rank < min(start.rank for start in ended):
                        best = plan
                    ended.append(summary)
                    if callback is not None and not interrupted:
                        callback(ended[-1])
                except (KeyboardInterrupt, StopIteration):
                    interrupted = True
                    stop.event.set()  # running solves end after their next iteration
                    waiting = deque((k, future) for k, future in waiting if not cancel_or_end(pool, future))
        finally:  # also after an error, e.g. in the callback
            stop.event.set()
            for _, future in waiting:
                cancel_or_end(pool, future)
    if best is None:  # interrupted before any start began
        best, ended = first, [_summary(0, first, first.cost)]
    return replace(best, starts=tuple(ended), status=Status.INTERRUPTED if interrupted else best.status)


class _Stop:
    """A callback that ends all solves of this process after their next iteration, once its event is set."""

    def __init__(self) -> None:
        self.event = Event()

    def __call__(self, _: Iteration) -> None:
        if self.event.is_set():
            raise StopIteration

    def __reduce__(self) -> tuple[type[_Stop], tuple[()]]:
        return _Stop, ()


def _run(
    solve_one: SolveOne, others: SolveOne, guess: np.ndarray, scale: np.ndarray, seed: int, max_iterations: int,
    stop: _Stop, number: int,
) -> Plan:  # fmt: skip
    """The plan of start `number`."""
    if number == 0:
        return solve_one(guess, max_iterations, stop)
    return others(guess + scale * smooth(np.random.default_rng([seed, number]), guess.shape), max_iterations, stop)


def smooth(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A smooth random function of time (N, nu) with an expected RMS of 1."""
    N, nu = shape
    m = np.arange(min(_MODES, N))
    cosines = np.cos(np.pi * m * (np.arange(N)[:, None] + 0.5) / N)
    deviations = 1.0 / (1.0 + m)
    power = np.sum(deviations**2 * np.mean(cosines**2, axis=0))
    return cosines @ (deviations[:, None] * rng.normal(size=(len(m), nu))) / np.sqrt(power)


def _sizes(guess: np.ndarray, later: np.ndarray) -> np.ndarray:
    """RMS (nu,) of each control, the larger of both trajectories; for zero controls the largest of all, or 1."""
    sizes = np.sqrt(np.maximum(np.mean(guess**2, axis=0), np.mean(later**2, axis=0)))
    return np.where(sizes > 0.0, sizes, sizes.max() or 1.0)


def _score(rank: Callable[[Plan], float] | None, plan: Plan) -> float:
    """Rank of a plan, lower is better; inf if not finite."""
    try:
        value = plan.cost if rank is None else rank(plan)
    except StopIteration:  # best_of treats it as an interruption
        raise PlannerError("rank raised StopIteration, expected a number.") from None
    try:
        return float(value) if math.isfinite(value) else math.inf
    except (TypeError, ValueError):
        raise PlannerError(f"rank gave {short_repr(value)}, expected a number.") from None


def _summary(number: int, plan: Plan, score: float) -> Start:
    return Start(number, plan.status, plan.cost, plan.nit, score)
