"""Map calls over an executor, with ordered results and a limited number of submitted calls.

Any concurrent.futures.Executor works. Those of planner.sweeps also have `width`, the number of concurrent calls, and
`end(future)`, which ends the worker of a call. They replace workers that end; each loses one call.
"""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from itertools import islice
from typing import Any, TypeVar

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 4  # submitted calls per worker, since results are returned in order


def checked_executor(executor: Any) -> Executor | None:
    """The checked executor, or None for calls in this process.

    Raises:
        PlannerError: The value is neither an Executor nor None.
    """
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise PlannerError(f"executor is {short_repr(executor)}, expected a concurrent.futures.Executor.")
    return executor


def width_of(executor: Executor) -> int:
    """Number of concurrent calls of an executor; 1 if unknown."""
    return int(getattr(executor, "width", getattr(executor, "_max_workers", None) or 1))


def ordered_map(
    executor: Executor | None, call: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[Result]:  # fmt: skip
    """Results of call(item) in the order of the items; without an executor sequentially in this process.

    Raises:
        PlannerError: A call cannot be pickled, or its worker ended, twice for executors of planner.sweeps.
    """
    if executor is None:
        yield from map(call, items)
        return
    following, waiting = iter(items), deque[tuple[Item, Future[Result]]]()
    try:
        while True:
            for item in islice(following, _AHEAD * width_of(executor) - len(waiting)):
                waiting.append((item, executor.submit(call, item)))
            if not waiting:
                return
            item, future = waiting[0]
            result = result_or_retry(executor, future, call, item)
            waiting.popleft()
            yield result
    finally:  # on an error or Ctrl-C
        for _, future in waiting:
            cancel_or_end(executor, future)


def result_or_retry(executor: Executor, future: Future[Result], call: Callable[..., Result], *arguments: Any) -> Result:
    """The result of a submitted call; the call is repeated once if its worker ended.

    Raises:
        PlannerError: The call cannot be pickled, or its worker ended twice, or cannot be replaced.
    """
    try:
        return future.result()
    except BrokenExecutor:
        if not hasattr(executor, "end"):
            raise PlannerError("a worker of the executor ended in the middle, and it takes no more work.") from None
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        if "pickle" not in str(error).lower():
            raise
        raise PlannerError(
            f"the work cannot be sent to processes ({error}), expected functions that they can import."
        ) from None
    try:
        return executor.submit(call, *arguments).result()
    except BrokenExecutor:
        raise PlannerError("a worker ended twice in the middle of the same work: killed, or out of memory.") from None


def cancel_or_end(executor: Executor, future: Future[Any]) -> bool:
    """Cancel a call, or end the worker that runs it; False if neither is possible."""
    if future.cancel():
        return True
    end = getattr(executor, "end", None)
    if end is None or future.done():
        return False
    end(future)
    return True
