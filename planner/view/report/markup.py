"""HTML of the pages: the whole page, its style sheet and scripts, and tables of measured values and of names."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from planner.base.files import write_atomically
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


def asset(name: str) -> str:
    """A style sheet or a script of the pages."""
    return (files("planner.view") / "assets" / name).read_text(encoding="utf-8")


def script(name: str) -> str:
    """A script of the pages as an element of one."""
    return f"<script>\n{asset(name)}</script>"


def write_page(path: Path, title: str, parts: Iterable[str], style: str = "") -> Path:
    """Write a page of the parts that are not empty; `style` adds to the style sheet. Returns the path.

    Raises:
        FileError: It cannot be written.
    """
    body = "\n".join(filter(None, parts))
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{asset('page.css')}{style}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )
    with write_atomically(path) as hidden:
        hidden.write_text(page, encoding="utf-8", errors="xmlcharrefreplace")
    return path


def video_player(source: str) -> str:
    """A player of a film: a file beside the page, or a data URL."""
    return (
        f'<video controls loop muted playsinline preload="metadata" src="{source}">'
        "This browser does not play H.264 video.</video>"
    )


def verdict_box(word: str, passed: bool, words: str, *, warns: bool = False) -> str:
    """The verdict in its colour with words beside it."""
    span = f"<span>{escape(words)}</span>" if words else ""
    kind = "warn" if warns else "pass" if passed else "fail"
    return f'<div class="verdict {kind}" role="status"><strong>{escape(word)}</strong>{span}</div>'


def first_screen(verdict: str, motion: str, notes: str) -> str:
    """What is seen at once, of HTML: the verdict, and below it the motion and the notes, side by side where wide."""
    return (
        f'<div class="first">\n{verdict}\n<div class="motion">\n{motion}\n</div>\n'
        f'<div class="notes">\n{notes}\n</div>\n</div>'
    )


def short_paragraph(label: str, text: str, most: int) -> str:
    """A paragraph; what exceeds so many letters is folded, from a word on. Words in `` are code."""
    head = f"<b>{escape(label)}:</b> " if label else ""
    if len(text) <= most:
        return f"<p>{head}{_with_code(text)}</p>"
    cut = max(text.rfind(" ", 0, most), 0) or most
    if text.count("`", 0, cut) % 2:  # within code
        cut = text.rfind("`", 0, cut)
    return f'<details class="long"><summary>{head}{_with_code(text[:cut])}</summary>{_with_code(text[cut:])}</details>'


def _with_code(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


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
