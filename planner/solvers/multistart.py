"""Several starts: SLQ ends in the local minimum that its first guess leads to, so it is asked from more than one.

Start 0 is the problem's own first guess; start k adds a smooth random change, drawn from (seed, k) alone:

    u(n) = guess(n) + spread scale sum over m < 6 of a_m cos(pi m (n + 1/2) / N),   a_m normal, sd falling as 1/(1 + m)

with an RMS of 1 expected of the sum, and a scale per control: the RMS of the guess, or of what five iterations from
it have made of it, whichever is larger. So it is in the control's own units, also where the guess is zero.
Where the cost asks for a whole state at the end, starts from 1 on begin with the straight line to it beside these
controls (solvers.multiple_shooting): a rollout of random controls goes far astray, and few solves find back.
Starts run on threads, or on the executor that is given, and which of them wins does not depend on when each ends. Plans
are ranked one at a time, in the caller's thread.
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

MAX_STARTS = 10_000  # by far more than any machine's local minima; each is a whole solve
SEVERAL = ("starts", "rank", "seed", "spread", "executor")
"""Options of solve() for several starts alone."""
_MODES = 6  # cosines: from a constant to two and a half waves over the horizon
_PILOT = 5  # iterations after which controls have their size


# One solve from a first guess (N, nu), with an iteration limit and a callback.
Descend = Callable[[np.ndarray, int, Callable[[Iteration], object] | None], Plan]


def best_of(
    guess: np.ndarray, descend: Descend, max_iterations: int, starts: int, seed: int, spread: float,
    callback: Callable[[Start], object] | None, rank: Callable[[Plan], float] | None = None,
    sizing: Descend | None = None, others: Descend | None = None, executor: Executor | None = None,
) -> Plan:  # fmt: skip
    """The plan of least rank among the converged of several starts, else among all.

    Args:
        guess: (N, nu) of the first start; the others' are changes of it.
        descend: One solve from a first guess.
        max_iterations: Limit of each solve.
        starts: Number of starts.
        seed: Of the random changes.
        spread: Their size relative to that of the controls.
        callback: Called with each Start, in order, as soon as it and those before it have ended.
        rank: Of a Plan, the less the better; its cost by default.
        sizing: The solve whose first iterations give the controls their size; `descend` by default.
        others: One solve from a changed guess; `descend` by default.
        executor: Where starts are solved; by default threads, one a processor.
    """
    pilot = (sizing or descend)(guess, min(_PILOT, max_iterations), None)
    if pilot.status is Status.INTERRUPTED:
        return replace(pilot, starts=(_summary(0, pilot, pilot.cost),))
    stop = _Stop()
    run = partial(_run, descend, others or descend, guess, spread * _sizes(guess, pilot.us), seed, max_iterations, stop)
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
                    if executor is not None:  # what comes from another process has a copy of the problem
                        plan = replace(plan, problem=pilot.problem)
                    summary = _summary(number, plan, _score(rank, plan))
                    waiting.popleft()
                    if best is None or summary.rank < min(start.rank for start in ended):
                        best = plan
                    ended.append(summary)
                    if callback is not None and not interrupted:
                        callback(ended[-1])
                except (KeyboardInterrupt, StopIteration):
                    interrupted = True
                    stop.event.set()  # those that run end with their next iteration; the others never begin
                    waiting = deque((k, future) for k, future in waiting if not cancel_or_end(pool, future))
        finally:  # also on an error, the user's own for example
            stop.event.set()
            for _, future in waiting:
                cancel_or_end(pool, future)
    if best is None:  # interrupted before any start began
        best, ended = pilot, [_summary(0, pilot, pilot.cost)]
    return replace(best, starts=tuple(ended), status=Status.INTERRUPTED if interrupted else best.status)


class _Stop:
    """A callback that ends all solves with their next iteration; in another process it does nothing."""

    def __init__(self) -> None:
        self.event = Event()

    def __call__(self, _: Iteration) -> None:
        if self.event.is_set():
            raise StopIteration

    def __reduce__(self) -> tuple[type[_Stop], tuple[()]]:
        return _Stop, ()


def _run(
    descend: Descend, others: Descend, guess: np.ndarray, scale: np.ndarray, seed: int, max_iterations: int,
    stop: _Stop, number: int,
) -> Plan:  # fmt: skip
    """One start."""
    if number == 0:
        return descend(guess, max_iterations, stop)
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
    """The size (nu,) of each control; a control that stays zero is given that of the others, or 1."""
    sizes = np.sqrt(np.maximum(np.mean(guess**2, axis=0), np.mean(later**2, axis=0)))
    return np.where(sizes > 0.0, sizes, sizes.max() or 1.0)


def _score(rank: Callable[[Plan], float] | None, plan: Plan) -> float:
    """The number that ranks a plan; infinite where it is not finite."""
    try:
        value = plan.cost if rank is None else rank(plan)
    except StopIteration:  # which here would mean an interruption, and be asked again
        raise PlannerError("rank raised StopIteration, expected a number.") from None
    try:
        return float(value) if math.isfinite(value) else math.inf
    except (TypeError, ValueError):
        raise PlannerError(f"rank gave {short_repr(value)}, expected a number.") from None


def _summary(number: int, plan: Plan, score: float) -> Start:
    return Start(number, plan.status, plan.cost, plan.nit, score)
