"""Argument checks. Each returns the value in the form that the kernels need, or raises a PlannerError."""

from __future__ import annotations

import difflib
import json
import math
import operator
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from planner.base.errors import PlannerError

LONGEST_HORIZON = 1_000_000  # stages, upper limit: the gains and linear models of more do not fit into memory
_MAX_COUNT = 2**63 - 1  # largest integer of the kernels
_LONGEST_TEXT = 100  # characters of a value in a message


def short_repr(value: Any) -> str:
    """A value for a message: its repr in one line, cut to 100 characters."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= _LONGEST_TEXT else f"{text[: _LONGEST_TEXT - 3]}..."


_FEW_NUMBERS = 4  # of a row that a message writes out


def _no_number(value: Any) -> bool:
    """Whether a value contains booleans, strings, dates or complex numbers, which NumPy would convert to floats."""
    if isinstance(value, float):  # the usual entry of a list
        return False
    if isinstance(value, (bool, str, bytes, bytearray)):
        return True
    if isinstance(value, Sequence):
        return any(map(_no_number, value))
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    return _no_number(value.tolist()) if kind == "O" else kind in ("b", "S", "U", "M", "m", "c")


def number(
    name: str,
    value: Any,
    *,
    greater_than: float | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
) -> float:
    """Return a finite float, greater than `greater_than`, at least `minimum` and at most `maximum` where given."""
    try:
        result = math.nan if _no_number(value) else float(value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    too_small = (greater_than is not None and result <= greater_than) or (minimum is not None and result < minimum)
    if too_small or (maximum is not None and result > maximum) or not math.isfinite(result):
        bounds = ((" greater than", greater_than), (" of at least", minimum), (" and at most", maximum))
        expected = "".join(f"{words} {bound:g}" for words, bound in bounds if bound is not None)
        raise PlannerError(f"{name} is {short_repr(value)}, expected a finite number{expected}.")
    return result


def count(name: str, value: Any, *, minimum: int = 1, maximum: int | None = None) -> int:
    """Return an integer of at least `minimum` and at most `maximum`, by default the largest integer of the kernels."""
    try:
        result = None if _no_number(value) else operator.index(value)
    except TypeError:
        result = None
    largest = _MAX_COUNT if maximum is None else maximum
    if result is None or not minimum <= result <= largest:
        upper = f" and at most {largest}" if result is not None and result > largest else ""
        raise PlannerError(f"{name} is {short_repr(value)}, expected a whole number of at least {minimum}{upper}.")
    return result


def choice(name: str, value: Any, choices: Collection[str]) -> str:
    """Return the value if it is one of the choices; the error lists them and suggests the most similar."""
    if isinstance(value, str) and value in choices:
        return value
    if not choices:
        raise PlannerError(f"{name} is {short_repr(value)}, expected no name, since nothing of its kind has one.")
    hint = did_you_mean(value, choices)
    raise PlannerError(f"{name} is {short_repr(value)}, expected one of: {', '.join(choices)}.{hint}")


def word_or_numbers(name: str, value: Any, words: Sequence[str], example: str) -> str:
    """Return a word that may stand in place of numbers; the error has an example of these."""
    if isinstance(value, str) and value in words:
        return value
    others = " or ".join(map(repr, words))
    raise PlannerError(
        f"{name} is {short_repr(value)}, expected numbers, e.g. {example}, or {others}.{did_you_mean(value, words)}"
    )


def did_you_mean(value: Any, known: Collection[str]) -> str:
    """Sentence that suggests the most similar known name, with a space before it; "" if none is similar."""
    short = isinstance(value, str) and len(value) <= _LONGEST_TEXT  # the search time is quadratic in its length
    names = [name for name in known if isinstance(name, str)]
    similar = difflib.get_close_matches(value, names, n=1, cutoff=0.8) if short else []
    similar = similar or sorted((name for name in names if short and len(value) > 2 and value in name), key=len)
    similar = similar or (difflib.get_close_matches(value, names, n=1) if short else [])
    return f" Did you mean {similar[0]!r}?" if similar else ""


def numbers(name: str, value: Any) -> np.ndarray:
    """Return an array of floats of any shape."""
    try:
        return _floats(value)
    except (TypeError, ValueError, OverflowError):
        raise PlannerError(_uneven(name, value) or f"{name} is {short_repr(value)}, expected numbers.") from None


def _uneven(name: str, value: Any) -> str:
    """The sentence about rows of different lengths; "" where all are alike."""
    if not isinstance(value, (list, tuple)) or not value or not all(isinstance(row, (list, tuple)) for row in value):
        return ""
    other = next((k for k, row in enumerate(value) if len(row) != len(value[0])), None)
    if other is None:
        return ""
    return (
        f"{name} has {len(value[0])} entries in row 1 and {len(value[other])} in row {other + 1}, expected rows of one "
        f"length: write {len(value[0])} in each."
    )


def _floats(value: Any) -> np.ndarray:
    """A copy as float64 in C order; TypeError, ValueError or OverflowError if an entry is not a number."""
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    if kind == "c":  # NumPy drops imaginary parts with a warning
        raise TypeError
    result = np.array(value, dtype=np.float64, order="C")
    if kind != "f" and _no_number(value):  # np.array above has rejected too deep nesting
        raise TypeError
    return result


def array(name: str, value: Any, shape: tuple[int | str, ...], *, any_value: bool = False) -> np.ndarray:
    """Return a float64 array in C order, finite unless any_value. A letter in `shape` matches any size."""
    try:
        result = _floats(value)
    except (TypeError, ValueError, OverflowError):
        wrong = f"{name} is not an array of numbers, expected shape {_shape_words(shape)}."
        raise PlannerError(_uneven(name, value) or wrong) from None
    n = shape[0] if len(shape) == 1 else None
    if isinstance(value, (list, tuple)) and result.ndim == 1 and isinstance(n, int) and len(result) != n:
        example = f", e.g. [{', '.join(['0.0'] * n)}]" if 0 < n <= _FEW_NUMBERS else ""
        raise PlannerError(f"{name} is {short_repr(value)}, expected {n} number{'' if n == 1 else 's'}{example}.")
    if result.shape != shape and not _matches(result.shape, shape):
        raise PlannerError(f"{name} has shape {result.shape}, expected {_shape_words(shape)}.")
    if not any_value and not np.isfinite(result).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(result))[0])
        raise PlannerError(f"{name}{list(index)} is {result[index]}, expected finite numbers.")
    return result


def _shape_words(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def _matches(has: tuple[int, ...], shape: tuple[int | str, ...]) -> bool:
    sizes = zip(has, shape, strict=False)
    return len(has) == len(shape) and all(isinstance(size, str) or one == size for one, size in sizes)


def unit_vector(name: str, value: np.ndarray, example: str) -> np.ndarray:
    """A vector divided by its length, which must not be zero."""
    length = float(np.linalg.norm(value))
    if length < 1e-12:
        raise PlannerError(f"{name} has length zero, expected e.g. {example}.")
    return value / length


def quaternion(name: str, value: Any) -> np.ndarray:
    """(4,) unit quaternion, w first, of one, or of a table of roll, pitch and yaw in degrees about the world's axes."""
    if not isinstance(value, Mapping):
        given = numbers(name, value)
        if given.shape != (4,):
            raise PlannerError(
                f"{name} is {short_repr(value)}, expected the four numbers of a quaternion, w first, e.g. 1, 0, 0, 0, "
                "or a table of roll, pitch and yaw in degrees."
            )
        return unit_vector(name, array(name, value, (4,)), "1, 0, 0, 0")
    keys = ("roll", "pitch", "yaw")
    for key in value:
        choice(f"an angle of {name}", key, keys)
    angles = [number(f"{key} of {name}", value.get(key, 0.0)) for key in keys]
    from scipy.spatial.transform import Rotation  # 0.4 s that `planner run` need not pay

    return Rotation.from_euler("xyz", angles, degrees=True).as_quat()[[3, 0, 1, 2]]


def first_of(phrases: Sequence[str], most: int) -> str:
    """At most so many phrases for a sentence: "a, b and 3 more"."""
    more = len(phrases) - most
    return ", ".join(phrases[:most]) + (f" and {more} more" if more > 0 else "")


def toml_key(name: str) -> str:
    """A name as a key of a TOML table."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)


def toml_value(value: Any) -> str:
    """A JSON value as TOML."""
    if isinstance(value, dict):
        parts = ", ".join(f"{toml_key(name)} = {toml_value(part)}" for name, part in value.items())
        return f"{{ {parts} }}" if parts else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return json.dumps(value, default=str, ensure_ascii=False)  # strings, numbers and booleans are written alike


def set_fields(record: Any, **values: Any) -> None:
    """Set fields of a frozen dataclass to checked values; arrays become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(record, name, value)
