"""Figures: a measured value beside the bound it is held to. Proofs are made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from planner.base.jsonable import finite


@dataclass(frozen=True)
class Measured:
    """One measured number.

    Attributes:
        name: What was measured, as a snake_case key.
        value: The measured value; infinite when the thing to be measured did not happen.
        unit: Its unit, "" for a pure number.
        bound: The largest value that passes; None for a number that is shown, not judged.
        note: Where the bound comes from, or what the number means.
    """

    name: str
    value: float
    unit: str = ""
    bound: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value is within the bound (a NaN never is)."""
        return self.bound is None or bool(self.value <= self.bound)

    def __str__(self) -> str:
        bound = "" if self.bound is None else f" (bound {self.bound:.3g})"
        return f"{self.name.replace('_', ' ')} {self.value:.5g} {self.unit}".rstrip() + bound

    def to_dict(self) -> dict[str, Any]:
        """The figure as JSON values; what is not finite becomes null (JSON has no infinity)."""
        return {
            "value": finite(float(self.value)),
            "unit": self.unit,
            "bound": None if self.bound is None else float(self.bound),
            "passed": self.passed,
            "note": self.note,
        }


@dataclass(frozen=True)
class Section:
    """One step of a proof: its measured, or the reason why it does not apply.

    Attributes:
        title: The step, e.g. "refined, open loop".
        measured: What was measured.
        not_applicable: Why the step does not apply to this machine; "" when it does.
    """

    title: str
    measured: tuple[Measured, ...] = ()
    not_applicable: str = ""

    @property
    def passed(self) -> bool:
        """Whether every figure is within its bound. A step that does not apply does not fail."""
        return all(figure.passed for figure in self.measured)

    @property
    def failures(self) -> tuple[Measured, ...]:
        """The measured beyond their bounds."""
        return tuple(figure for figure in self.measured if not figure.passed)

    def to_dict(self) -> dict[str, Any]:
        """The section as JSON values."""
        if self.not_applicable:
            return {"applicable": False, "reason": self.not_applicable}
        return {
            "applicable": True,
            "passed": self.passed,
            "figures": {figure.name: figure.to_dict() for figure in self.measured},
        }
