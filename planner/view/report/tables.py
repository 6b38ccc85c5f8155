"""Tables of the page: measured numbers beside their bounds, and names beside values."""

from __future__ import annotations

import json
import math
import re
from html import escape
from typing import Any

from planner.base.measured import Measurement, Section

NBSP = "\N{NO-BREAK SPACE}"


def measured_table(section: Section) -> str:
    """A step of a proof: every measured number beside its bound."""
    title = f"<h4>{escape(_capital(section.title))} {_mark(section)}</h4>"
    if section.not_applicable:
        return f'{title}\n<p class="soft">{escape(_capital(section.not_applicable))}</p>'
    if not section.measured:
        return f'{title}\n<p class="soft">Nothing was measured.</p>'
    rows = "\n".join(_row(one) for one in section.measured)
    head = "<tr><th>Measured</th><th>Value</th><th>Bound</th><th>Verdict</th></tr>"
    return f'{title}\n<div class="scroll"><table>\n{head}\n{rows}\n</table></div>'


def _mark(section: Section) -> str:
    if section.not_applicable:
        return '<span class="word none">not applicable</span>'
    if all(one.bound is None for one in section.measured):
        return ""
    return _pass_or_fail(section.passed)


def _row(one: Measurement) -> str:
    word = '<span class="word none">shown</span>' if one.bound is None else _pass_or_fail(one.passed)
    bound = "" if one.bound is None else f"≤{NBSP}{_quantity(one.bound, one.unit)}"
    note = f"<small>{escape(one.note)}</small>" if one.note else ""
    return (
        f"<tr><td>{escape(_name(one))}{note}</td>"
        f'<td class="number">{_quantity(one.value, one.unit)}</td>'
        f'<td class="number">{bound}</td><td class="verdict-word">{word}</td></tr>'
    )


def _pass_or_fail(passed: bool) -> str:
    return f'<span class="word {"pass" if passed else "fail"}">{"pass" if passed else "FAIL"}</span>'


def table(rows: dict[str, Any]) -> str:
    """Names beside values."""
    lines = "\n".join(
        f'<tr><th scope="row">{escape(str(name))}</th><td class="value">{escape(_text(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f'<div class="scroll"><table>\n{lines}\n</table></div>'


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return number(value)
    return json.dumps(value, default=str, ensure_ascii=False)


def number(value: float, digits: int = 4) -> str:
    """A number as text; NaN and infinity in words."""
    if math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return "∞" if value > 0 else "\N{MINUS SIGN}∞"
    return f"{value:.{digits}g}"


def _quantity(value: float, unit: str) -> str:
    return escape(f"{number(value)}{NBSP}{unit}".rstrip())


def _name(one: Measurement) -> str:
    """The key of a measured number in words."""
    return _capital(re.sub(r"\brms\b", "RMS", one.name.replace("_", " ")))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
