"""Cure: a key of the problem, the value to write there, and why."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import dataclass
from typing import Any

from planner.problem.problem import Problem
from planner.problem.recipe import PROBLEM_FILE

FILE = PROBLEM_FILE
ITERATIONS = "max_iterations"
TABLES = ("weights", "limits")
FLAGS = (ITERATIONS, "starts")  # of solve() and the command line, for all problems


@dataclass(frozen=True)
class Cure:
    """What to write, and why.

    Attributes:
        key: As a problem.toml has it, with dots for its tables: "limits.margin"; or a whole table of TABLES, of which
            some keys are to be written. "max_iterations" is a flag of the
            command line and an argument of solve().
        value: What to write there, a JSON value; None where no value helps, and the sentence says why.
        sentence: How to write it, and the measured reason.
    """

    key: str
    value: Any
    sentence: str

    def __str__(self) -> str:
        return self.sentence

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {"key": self.key, "value": self.value, "sentence": self.sentence}

    def applied(self, table: dict[str, Any]) -> dict[str, Any]:
        """A problem.toml's table with the cure written into it; the table itself where the cure is no key of it."""
        table = copy.deepcopy(table)
        if self.value is None or self.key == ITERATIONS:
            return table
        inside, (*tables, last) = table, self.key.split(".")
        for name in tables:
            part = inside.get(name)
            inside[name] = part = part if isinstance(part, dict) else {}
            inside = part
        value = copy.deepcopy(self.value)
        inside[last] = {**inside.get(last, {}), **value} if self.key in TABLES else value
        return table


def cure(problem: Problem, key: str, value: Any, why: str) -> Cure:
    """A cure of a problem, told in the words of where the problem comes from: its file, a command line or Python."""
    value = {name: _short(part) for name, part in value.items()} if isinstance(value, dict) else _short(value)
    parts = {f"{key}.{name}": part for name, part in value.items()} if key in TABLES else {key: value}
    written = ", ".join(f"`{_written(problem, name, part)}`" for name, part in parts.items())
    return Cure(key, value, f"{written}: {why}")


def _short(value: Any) -> Any:
    """A number that is computed, without the digits of rounding."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def no_cure(key: str, why: str) -> Cure:
    """A reason that no value of the key takes away."""
    return Cure(key, None, why)


def _written(problem: Problem, key: str, value: Any) -> str:
    if key in FLAGS and not (problem.case == FILE and key == "starts"):
        if problem.case is not None:
            return f"--{key.replace('_', '-')} {value}"
        return f"solve(..., {key}={value})"
    if problem.case == FILE:
        return f"{key} = {_toml(value)}"
    if problem.case is not None and key == "dt" and "horizon" in problem.parameters:
        return f"--horizon {round(problem.duration / value)}"
    if problem.case is not None and key.split(".")[-1] in problem.parameters:
        return f"--{key.split('.')[-1].replace('_', '-')} {value}"
    dynamics = type(problem.dynamics).__name__
    if key == "duration":
        return f"{dynamics}(..., dt={value / problem.N:.6g})"
    if key in ("dt", "integrator"):
        return f"{dynamics}(..., {key}={value!r})"
    table, _, name = key.rpartition(".")
    if table == "limits":
        return f"Limits({name}={value!r})"
    if table == "weights":
        return f"TrackingCost.joints({name}={value!r})"
    return f"{key} = {value!r}"


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        parts = (f"{name if _is_bare(name) else json.dumps(name)} = {_toml(part)}" for name, part in value.items())
        return "{ " + ", ".join(parts) + " }" if value else "{}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _is_bare(name: str) -> bool:
    bare = name.replace("_", "").replace("-", "")
    return bare.isascii() and bare.isalnum()


def rounded_up(value: float, digits: int = 1) -> float:
    """The next larger number with so many digits."""
    if not 0.0 < value < math.inf:
        return value
    step = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    return float(f"{math.ceil(value / step - 1e-9) * step:.{digits}g}")
