"""Diagnostic: a finding as a code and values, formatted as a sentence only for output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple


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
