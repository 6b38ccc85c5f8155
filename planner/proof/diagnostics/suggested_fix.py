"""SuggestedFix: a key of the problem, its new value, and the finding behind it."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

from planner.base.arguments import toml_value
from planner.base.data_files import finite
from planner.base.measured import Diagnostic, Quantity
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.problem_parts import PROBLEM_FILE
from planner.proof.diagnostics.sentences import SENTENCES, TRIED

ITERATIONS = "max_iterations"
TABLES = ("weights", "limits")
FLAGS = (ITERATIONS, "starts", "work")  # of solve() and the command line, for all problems


@dataclass(frozen=True)
class SuggestedFix(Diagnostic):
    """A change of the problem, and its reason.

    Attributes:
        key: As in a problem.toml, with dots for its tables: "limits.margin"; or a whole table of TABLES, with some keys
            to set. "max_iterations" is a flag of the command line and an argument of solve().
        value: The new value, a JSON value; None if no value helps.
        written: The change in the notation of the problem's origin: its file, a command line or Python.
        tried: "passes", "fails" or "undecided" once a repair has tried it, else "".
    """

    key: str = ""
    value: Any = None
    written: str = ""
    tried: str = ""

    @property
    def sentence(self) -> str:
        """The change as text, and its measured reason."""
        text = self.text(SENTENCES)
        return (f"{self.written}: {text}" if self.written else text) + TRIED[self.tried]

    def __str__(self) -> str:
        return self.sentence

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        values = {
            name: {"value": finite(one.value), "unit": one.unit} if isinstance(one, Quantity) else one
            for name, one in self.values.items()
        }
        return {"key": self.key, "value": self.value, "sentence": self.sentence, "code": self.code, "values": values}

    def applied(self, table: dict[str, Any]) -> dict[str, Any]:
        """A problem.toml's table with the fix written into it; the table itself where the fix is no key of it."""
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


def fix(problem: Problem, key: str, value: Any, code: str, **values: Any) -> SuggestedFix:
    """A value to write under a key of the problem, for the finding `code` with its values."""
    value = {name: _short(part) for name, part in value.items()} if isinstance(value, dict) else _short(value)
    parts = {f"{key}.{name}": part for name, part in value.items()} if key in TABLES else {key: value}
    written = ", ".join(f"`{_written(problem, name, part)}`" for name, part in parts.items())
    return SuggestedFix(code, values, key, value, written)


def no_fix(key: str, code: str, **values: Any) -> SuggestedFix:
    """A finding that no value of the key resolves."""
    return SuggestedFix(code, values, key)


def has_searched_duration(plan: Plan) -> bool:
    """Whether a search over durations, which solves at many, made the plan."""
    return "durations" in plan.options


def of_file(problem: Problem) -> bool:
    """Whether the problem comes from a problem.toml."""
    return problem.case == PROBLEM_FILE


def _short(value: Any) -> Any:
    """A number that is computed, without the digits of rounding."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _written(problem: Problem, key: str, value: Any) -> str:
    table, _, name = key.rpartition(".")
    flag = f"--{name.replace('_', '-')} {value}"
    if key in FLAGS and not (of_file(problem) and key != ITERATIONS):
        return f"solve(..., {key}={value})" if problem.case is None else flag
    if key == "durations" and "objective" not in problem.parameters:  # a file has no durations without one
        of_case = f"--durations {','.join(f'{one:g}' for one in value)}"
        return f"solve_for(..., durations={value})" if problem.case is None else of_case
    if of_file(problem):
        return f"{key} = {toml_value(value)}"
    if problem.case is not None and key == "dt" and "horizon" in problem.parameters:
        return f"--horizon {round(problem.duration / value)}"
    if problem.case is not None and name in problem.parameters:
        return flag
    dynamics = type(problem.dynamics).__name__
    if key == "duration":
        return f"{dynamics}(..., dt={value / problem.N:.6g})"
    if key in ("dt", "integrator"):
        return f"{dynamics}(..., {key}={value!r})"
    makers = {"limits": "Limits", "weights": "TrackingCost.joints"}
    return f"{makers[table]}({name}={value!r})" if table in makers else f"{key} = {value!r}"


def rounded_up(value: float, digits: int = 1) -> float:
    """The next larger number with so many digits."""
    if not 0.0 < value < math.inf:
        return value
    step = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    return float(f"{math.ceil(value / step - 1e-9) * step:.{digits}g}")
