"""Many calls on an executor, with results in order and a limited number submitted at a time.

Any concurrent.futures.Executor will do. Those of planner.sweeps also have `width`, the number of calls worked on at
once, and `end(future)`, which ends the worker of a call. They replace workers that end, and lose one call with each.
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

_AHEAD = 4  # submitted calls per worker, because results wait for those before them


def checked_executor(executor: Any) -> Executor | None:
    """The executor, or None for work in this process.

    Raises:
        PlannerError: It is neither.
    """
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise PlannerError(f"executor is {short_repr(executor)}, expected a concurrent.futures.Executor.")
    return executor


def width_of(executor: Executor) -> int:
    """How many calls an executor works on at once; 1 where it does not say."""
    return int(getattr(executor, "width", getattr(executor, "_max_workers", None) or 1))


def ordered_map(
    executor: Executor | None, call: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[Result]:  # fmt: skip
    """The results of call(item) in the order of the items; without an executor from this process, one by one.

    Raises:
        PlannerError: The work cannot be sent, or a worker ended with it; one of planner.sweeps may end once.
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
    """The result of a call that was submitted; the call is made once more where its worker ended.

    Raises:
        PlannerError: The call cannot be sent, or its worker ended twice, or cannot be replaced.
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
    """Take a call back, with its worker where it is being worked on; False where it goes on to its end."""
    if future.cancel():
        return True
    end = getattr(executor, "end", None)
    if end is None or future.done():
        return False
    end(future)
    return True
