"""Diagnostic: what was found, as a code and its values. A sentence is made from it only where text is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple


class Quantity(NamedTuple):
    """A number with its unit; in a template {depth:.2g} makes "0.02 m"."""

    value: float
    unit: str = ""

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec or '.3g'}} {self.unit}".rstrip()


@dataclass(frozen=True)
class Diagnostic:
    """What was found.

    Attributes:
        code: Of the finding, a key of the templates of its subject.
        values: By name: quantities, names of parts, words.
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def text(self, templates: Mapping[str, str]) -> str:
        """The sentence, by the templates of the subject."""
        return templates[self.code].format(**self.values)
