"""Checks of what a caller hands in. Each returns the value in the form the kernels need, or raises one sentence."""

from __future__ import annotations

import difflib
import math
import operator
from collections.abc import Collection
from typing import Any

import numpy as np

from planner.errors import PlannerError


def number(
    name: str, value: Any, *, above: float | None = None, least: float | None = None, most: float | None = None
) -> float:
    """A finite float, greater than `above`, at least `least` and at most `most` where given."""
    try:
        result = math.nan if isinstance(value, (bool, str)) else float(value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    too_small = (above is not None and result <= above) or (least is not None and result < least)
    too_large = most is not None and result > most
    if too_small or too_large or not math.isfinite(result):
        expected = "a finite number"
        if above is not None:
            expected += f" greater than {above:g}"
        if least is not None:
            expected += f" of at least {least:g}"
        if most is not None:
            expected += f" and at most {most:g}"
        raise PlannerError(f"{name} is {value!r}, expected {expected}.")
    return result


def count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """An integer of at least `least` and, where given, at most `most`."""
    try:
        result = operator.index(value)
    except TypeError:
        result = None
    if result is None or isinstance(value, bool) or result < least or (most is not None and result > most):
        upper = "" if most is None else f" and at most {most}"
        raise PlannerError(f"{name} is {value!r}, expected a whole number of at least {least}{upper}.")
    return result


def choice(name: str, value: Any, choices: Collection[str]) -> str:
    """One of some names; the message lists them and guesses what was meant."""
    if isinstance(value, str) and value in choices:
        return value
    known = list(choices)
    near = difflib.get_close_matches(str(value), known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise PlannerError(f"{name} is {value!r}, expected one of: {', '.join(known)}.{hint}")


def array(name: str, value: Any, shape: tuple[int | str, ...], *, any_value: bool = False) -> np.ndarray:
    """A float64 array in C order, finite unless any_value. Sizes in `shape` that are letters match anything."""
    wanted = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    try:
        result = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        raise PlannerError(f"{name} is not an array of numbers, expected shape {wanted}.") from None
    fits = result.ndim == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(result.shape, shape, strict=True)
    )
    if not fits:
        raise PlannerError(f"{name} has shape {result.shape}, expected {wanted}.")
    if not any_value and not np.isfinite(result).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(result))[0])
        raise PlannerError(f"{name}{list(index)} is {result[index]}, expected finite numbers.")
    return result
