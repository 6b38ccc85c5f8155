"""Write the pages: the templates of templates/, and how they write numbers and measured values."""

from __future__ import annotations

import json
import math
import re
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from planner.base.files import write_atomically
from planner.base.measured import Measurement

if TYPE_CHECKING:
    from jinja2 import Environment

NBSP = "\N{NO-BREAK SPACE}"


def render(template: str, **values: Any) -> Markup:
    """The HTML of a template; text among the values is escaped, Markup is HTML already."""
    return Markup(_environment().get_template(template).render(values))


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Write the page of a template and return its path.

    Raises:
        FileError: It cannot be written.
    """
    page = render(template, **values)
    with write_atomically(path) as hidden:
        hidden.write_text(page + "\n", encoding="utf-8", errors="xmlcharrefreplace")
    return path


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # 0.1 s, and only pages need it

    made = Environment(
        loader=PackageLoader("planner.view.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {"capital": _capital, "code": _with_code, "quantity": _quantity, "text": _text, "title_of": _name}
    made.globals["asset"] = asset
    return made


def asset(name: str) -> Markup:
    """A style sheet or a script of the pages."""
    return Markup((files("planner.view") / "assets" / name).read_text(encoding="utf-8").replace("</", "<\\/"))


def json_block(data: Any) -> Markup:
    """Values as JSON that no name in them can end."""
    return Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))


def split_after_word(text: str, most: int) -> tuple[str, str]:
    """The first letters of a text, at most so many, up to a word's end and no end within ``; and the rest.

    Where that would leave less than a quarter of them, as before a long name, it ends at a word, or else anywhere.
    """
    if len(text) <= most:
        return text, ""
    cut = text.rfind(" ", 0, most)
    cut = cut if 4 * cut >= most else most
    code = text.rfind("`", 0, cut)
    if text.count("`", 0, cut) % 2 and "`" in text[cut:] and 4 * code >= most:  # within code
        cut = code
    return text[:cut], text[cut:]


def _with_code(text: str) -> Markup:
    """Text in which words in `` are code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


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
    return f"{number(value)}{NBSP}{unit}".rstrip()


def _name(one: Measurement) -> str:
    """The key of a measured number in words."""
    return _capital(re.sub(r"\brms\b", "RMS", one.words))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
