"""HTML of the pages: the whole page, its style sheet, and tables of measured values and of names beside values."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from html import escape
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


def write_page(path: Path, title: str, parts: Iterable[str], style: str = "") -> Path:
    """Write a page of the parts that are not empty; `style` adds to the style sheet. Returns the path.

    Raises:
        FileError: It cannot be written.
    """
    body = "\n".join(filter(None, parts))
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
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


def verdict_box(word: str, passed: bool, words: str, more: str = "", *, warns: bool = False) -> str:
    """The verdict in its colour with words beside it, as text, and `more` below, as HTML."""
    span = f"<span>{escape(words)}</span>" if words else ""
    kind = "warn" if warns else "pass" if passed else "fail"
    return f'<div class="verdict {kind}" role="status"><strong>{escape(word)}</strong>{span}{more}</div>'


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


STYLE = """
:root { color-scheme: light dark; --ink: #1d1f21; --soft: #5d6670; --line: #d9dde1; --paper: #ffffff;
  --card: #f6f7f8; --good: #14713a; --bad: #b3261e; --good-tint: #e5f4ea; --bad-tint: #fce9e7;
  --warn: #7a4f00; --warn-tint: #fdf3d8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaed; --soft: #a3abb3; --line: #3a3f45;
  --paper: #17191c; --card: #202327; --good: #6fd394; --bad: #ff8d84; --good-tint: #16301f;
  --bad-tint: #3a1c1a; --warn: #f0c36d; --warn-tint: #362a10; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.2rem; max-width: 62rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .8rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1.08rem; margin: 1.8rem 0 .4rem; border-bottom: 2px solid var(--line); }
h4 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p { margin: .4rem 0; overflow-wrap: anywhere; }
.soft { color: var(--soft); }
.verdict { border-left: .5rem solid; border-radius: .4rem; padding: .8rem 1.1rem; }
.verdict.pass { color: var(--good); background: var(--good-tint); }
.verdict.warn { color: var(--warn); background: var(--warn-tint); }
.verdict.fail { color: var(--bad); background: var(--bad-tint); }
.verdict strong { font-size: 2.3rem; line-height: 1.2; letter-spacing: .02em; margin-right: .6rem; }
.verdict span { font-size: 1.15rem; }
.verdict p { color: var(--ink); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .32rem .7rem .32rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; color: var(--soft); }
th[scope="row"] { width: 11rem; }
td.number, td.verdict-word { width: 8.5rem; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
td small { display: block; color: var(--soft); line-height: 1.35; }
@media (max-width: 40rem) { th[scope="row"] { width: 7rem; } td.number, td.verdict-word { width: auto; } }
td.value { overflow-wrap: anywhere; }
.word { font-weight: 700; white-space: nowrap; }
.word.pass { color: var(--good); }
.word.fail { color: var(--bad); }
.word.none { color: var(--soft); font-weight: 400; }
figure { margin: 0 0 1.2rem; }
figcaption { color: var(--soft); font-size: .9rem; }
img, video { display: block; max-width: 100%; height: auto; max-height: 72vh; border-radius: .4rem; background: #fff; }
details { margin-top: 1.2rem; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; background: var(--card); padding: .8rem; border-radius: .4rem; font-size: .8rem; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(26rem, 100%), 1fr)); gap: .4rem 1rem; }
.charts figure { margin: 0; }
.charts figcaption span { margin-left: .6rem; background: #fff; padding: 0 .25rem; border-radius: .2rem; }
.charts output { display: block; font-size: .78rem; color: var(--soft); min-height: 1.2rem;
  font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
svg[data-chart] { display: block; width: 100%; height: auto; background: #fff; border-radius: .4rem; cursor: crosshair;
  touch-action: pan-y; }
svg[data-chart] text { font: 11px system-ui, sans-serif; fill: #444; }
svg polyline { fill: none; stroke-linejoin: round; stroke-linecap: round; }
svg .open { stroke-width: 4; } svg .gains { stroke-width: 2.2; }
svg .plan { stroke-width: 1.3; stroke-dasharray: 4 2; } svg .bound { stroke-width: 1; stroke-dasharray: 1 3; }
svg .grid { stroke: #ddd; stroke-width: .6; }
svg .cursor { stroke: #d0021b; stroke-width: 1; visibility: hidden; }
.keys { font-size: .85rem; color: var(--soft); }
.key { display: inline-block; width: 1.6rem; vertical-align: middle; border-top: 4px solid #ccc; }
.key.gains { border-top: 3px solid #8a8a8a; } .key.plan { border-top: 2px dashed currentColor; }
.key.bound { border-top: 2px dotted #555; }
#view canvas { display: block; width: 100%; border-radius: .4rem; background: linear-gradient(#cfdcea, #f3f5f7);
  cursor: grab; touch-action: none; }
#view .keys label { margin-right: .9rem; }
button[aria-pressed="true"] { font-weight: 700; }
.bar { display: flex; gap: .8rem; align-items: center; }
.part > summary { font-size: 1.15rem; padding: .4rem 0; border-top: 1px solid var(--line); }
.bar input { flex: 1; } #now { min-width: 7rem; font-variant-numeric: tabular-nums; }
"""
