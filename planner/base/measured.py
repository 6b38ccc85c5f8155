"""Measured values with their bounds, the content of a proof; and findings as codes with values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from planner.base.data_files import finite


@dataclass(frozen=True)
class Measurement:
    """One measured value.

    Attributes:
        name: A snake_case key.
        value: The value; infinite if it could not be measured.
        unit: Its unit, "" if dimensionless.
        bound: Largest value that passes; None for a value without a check.
        note: The origin of the bound, or the meaning of the value.
        holds: Of a value that is 0 or 1, what is so where it is 0; tables then say yes or no.
    """

    name: str
    value: float
    unit: str = ""
    bound: float | None = None
    note: str = ""
    holds: str = ""

    @property
    def words(self) -> str:
        """The name in words, as tables have it."""
        return self.holds or self.name.replace("_", " ")

    @property
    def yes_or_no(self) -> str:
        """Yes or no, where the value is no quantity; else ""."""
        return "" if not self.holds else "no" if self.value else "yes"

    @property
    def passed(self) -> bool:
        """Whether the value is within the bound (a NaN never is)."""
        return self.bound is None or bool(self.value <= self.bound)

    def __str__(self) -> str:
        bound = "" if self.bound is None else f" (bound {self.bound:.3g})"
        return f"{self.name.replace('_', ' ')} {self.value:.5g} {self.unit}".rstrip() + bound

    @property
    def bound_share_text(self) -> str:
        """Name, value and value over bound in percent: "path angle error 0.97 rad (97 % of its bound 1)"."""
        assert self.bound
        share = 100.0 * self.value / self.bound
        part = "less than 0.1" if share < 0.1 else f"{share:.0f}" if share >= 9.5 else f"{share:.1g}"
        value = f"{self.name.replace('_', ' ')} {self.value:.5g} {self.unit}".rstrip()
        return f"{value} ({part} % of its bound {self.bound:.3g})"

    @property
    def over(self) -> float:
        """Value over bound; infinite for a bound of 0, e.g. on the number of warnings, and for NaN."""
        over = self.value / self.bound if self.bound else math.inf
        return math.inf if math.isnan(over) else over

    @property
    def excess_text(self) -> str:
        """Name, value and the multiple of the bound: "path angle error 0.44 rad, 17 times its bound"."""
        name = self.name.replace("_", " ")
        if not math.isfinite(self.value):
            return f"{name} not finite"
        times = f", {self.over:.2g} times its bound" if math.isfinite(self.over) else ""
        return f"{name} {self.value:.2g} {self.unit}".rstrip() + times

    def to_dict(self) -> dict[str, Any]:
        """As JSON values; null if not finite."""
        return {
            "value": finite(float(self.value)),
            "unit": self.unit,
            "bound": None if self.bound is None else float(self.bound),
            "passed": self.passed,
            "note": self.note,
        }


@dataclass(frozen=True)
class Section:
    """One section of a proof: its measured values, or the reason why it does not apply.

    Attributes:
        title: Title of the section, e.g. "refined, open loop".
        measured: The measured values.
        not_applicable: Why the section does not apply to this machine, or "".
    """

    title: str
    measured: tuple[Measurement, ...] = ()
    not_applicable: str = ""

    @property
    def passed(self) -> bool:
        """Whether every value is within its bound. A section that does not apply does not fail."""
        return not self.failures

    @property
    def failures(self) -> tuple[Measurement, ...]:
        """The values that exceed their bounds."""
        return tuple(one for one in self.measured if not one.passed)

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Table rows of the measured values: section, name, value, bound and "ok" or "FAIL"."""
        rows = []
        for one in self.measured:
            bound = "" if one.bound is None or one.yes_or_no else f"{one.bound:g}"
            mark = "" if one.bound is None else ("ok" if one.passed else "FAIL")
            value = one.yes_or_no or f"{one.value:.5g} {one.unit}".rstrip()
            rows.append((self.title, one.words, value, bound, mark))
        return rows

    def judged_rows(self) -> list[tuple[str, str, str, str, str]]:
        """Of rows(), those that fail; else that of the value nearest to its bound. None where nothing is judged."""
        judged = [one for one in self.measured if one.bound is not None]
        nearest = max(judged, key=lambda one: one.over if one.bound else 0.0, default=None)
        return replace(self, measured=self.failures or tuple(filter(None, [nearest]))).rows()

    def to_dict(self) -> dict[str, Any]:
        """The section as JSON values."""
        if self.not_applicable:
            return {"applicable": False, "reason": self.not_applicable}
        return {
            "applicable": True,
            "passed": self.passed,
            "figures": {one.name: one.to_dict() for one in self.measured},
        }


def bound_excess(sections: Iterable[Section]) -> float:
    """Largest ratio of value to bound among failures; 0 if all sections pass."""
    return max((one.over for section in sections for one in section.failures), default=0.0)


def rows_of(sections: Mapping[str, Section]) -> list[tuple[str, str, str, str, str]]:
    """Table rows of all sections: section, name, value, bound and "ok" or "FAIL"."""
    return [row for section in sections.values() for row in section.rows()]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def dicts_of(sections: Mapping[str, Section]) -> dict[str, Any]:
    """Sections as JSON values, by their names."""
    return {name: section.to_dict() for name, section in sections.items()}


class Quantity(NamedTuple):
    """A number with its unit; {depth:.2g} in a template gives "0.02 m"."""

    value: float
    unit: str = ""

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec or '.3g'}} {self.unit}".rstrip()


@dataclass(frozen=True)
class Diagnostic:
    """A finding: a code and the values of its message.

    Attributes:
        code: Key of a message template.
        values: Template fields by name: quantities, names of parts, words.
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def text(self, templates: Mapping[str, str]) -> str:
        """The message, from templates by code."""
        return templates[self.code].format(**self.values)
