"""The largest of some levels of an error that a machine survives, by bisection, as if it survived all below."""

from __future__ import annotations

from collections.abc import Callable


def largest_survived(count: int, survives: Callable[[int], bool], near: int | None = None) -> int:
    """The number of the largest level that is survived, -1 for none.

    Args:
        count: Of levels.
        survives: Whether a level, by its number, is survived.
        near: A level, or -1, that the answer is probably near: it and the next are tried first, then those at twice
            the distance and so on, which takes two tries where the guess is right. None halves all of them.
    """
    low, high, reach = -1, count, 1
    while high - low > 1:
        if near is None or (low >= 0 and high < count):
            level = (low + high) // 2
        elif high == count:  # all that were tried are survived
            level = min(max(near, 0) if low < 0 else low + reach, count - 1)
        else:
            level = max(high - reach, 0)
        reach = reach if near is None or level == near else 2 * reach
        low, high = (level, high) if survives(level) else (low, level)
    return low
