"""Data files: problem files (TOML) are found and read and their keys checked, JSON is written as JSON allows it.

Nothing slow is imported, so a wrong problem file is answered at once.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Collection, Mapping
from numbers import Real
from pathlib import Path
from typing import Any

from planner.base.arguments import choice, count, did_you_mean, number, short_repr, word_or_numbers
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable, read_text, write_atomically

# In the wheel mjcf/ lies inside the package, in a checkout beside it.
MODEL_FOLDERS = (Path(__file__).parents[1] / "mjcf", Path(__file__).parents[2] / "mjcf")


def problem_files() -> dict[str, Path]:
    """Problem files by the names of their machines, e.g. "quadrotor"; mjcf/quadrotor/quadrotor.toml."""
    files = (folder / f"{folder.name}.toml" for root in MODEL_FOLDERS for folder in sorted(root.glob("*")))
    return {file.stem: file for file in files if file.is_file()}


def problem_summary(file: Path) -> str:
    """What a problem file says of itself: the comment that it begins with."""
    return file.read_text(encoding="utf-8").split("\n", 1)[0].lstrip("# ")


_FEW = 8  # keys that are listed before the nearest one is suggested
LONGEST = 2**20  # characters; guesses and weights are short, models are files of their own
MAX_DOTS = 20
_PART = r"""(?:"[^"\n]*"|'[^'\n]*'|[\w-]+)"""
_DEEP = re.compile(rf"(?:^|[\[{{,])[ \t]*(?:{_PART}[ \t]*\.[ \t]*){{{MAX_DOTS}}}", re.M)
"""A dotted key of many parts, which takes tomllib the square of their number."""

_VALUE = re.compile(
    r"""\s*(?P<key>[\w-]+)\s*=\s*(?:(?:(?P<number>[-+\d.]+)\s*)?(?P<bare>[A-Za-z_][\w./-]*)\s*(?:\#.*)?$|.)"""
)


def read_table(path: Path) -> dict[str, Any]:
    """The file's table; FileError where it cannot be read."""
    text = read_text(path, "the problem file")
    if len(text) > LONGEST:
        raise FileError(f"{printable(path)} has {len(text)} characters, expected a table of at most {LONGEST}.")
    if _DEEP.search(text):
        raise FileError(
            f"{printable(path)} has a key of more than {MAX_DOTS} parts, expected some of KEY or TABLE.KEY."
        )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path} is not TOML: {_likely_cause(text) or _expected(str(error))}.") from None
    except ValueError:  # Python reads no integers of more than 4300 digits
        raise FileError(f"{path} has a number of thousands of digits, expected numbers that fit 64 bits.") from None
    except RecursionError:
        raise FileError(f"{path} is nested too deeply, expected a table of numbers and names.") from None


_EXPECTED = {
    "Invalid value": "expected a number such as 0.5, a text in quotes, true, false, [ ] around a list or { } around a "
    "table after the =",
    "Cannot overwrite a value": "the key stands twice: leave one out",
    "Duplicate inline table key": "the key stands twice between { and }: leave one out",
    "Cannot declare": "the table stands twice: write the keys of both below one, or [[ ]] for several",
    "Cannot mutate immutable namespace": "the table was written with { } or [ ] before: write all of it there",
    "Cannot redefine namespace": "the key stands as a table already: leave one out",
    "Expected '=' after a key": "expected KEY = VALUE in a line",
    "Invalid initial character for a key": "expected KEY = VALUE, with a key of letters, digits, _ and -",
    "Invalid statement": "expected KEY = VALUE, [TABLE] or # and a remark in a line",
    "Expected newline or end of document": "expected the line to end after its value: write one KEY = VALUE a line",
    "Expected ']": "expected ] after the name of a table, ]] after one of [[",
    "Unclosed array": "expected a comma between numbers and ] after the last",
    "Unclosed inline table": "expected a comma between KEY = VALUE and } after the last, all in one line",
    "Unterminated string": "expected a quote that ends the text",
    "Illegal character": "expected the quote that ends the text in the same line",
    "Unescaped": "expected \\\\ for \\ in a text, or single quotes around it",
}
"""What to write instead, by how the parser's message begins."""


def _expected(message: str) -> str:
    """The parser's message, and what to write instead."""
    advice = next((text for start, text in _EXPECTED.items() if message.startswith(start)), "")
    message = message.removesuffix(".")
    return f"{message}: {advice}" if advice else message


def _likely_cause(text: str) -> str:
    """What most often is wrong in a text that is not TOML; "" for something else."""
    values: dict[str, int] = {}
    for n, line in enumerate(text.splitlines(), 1):
        found = _VALUE.match(line)
        if found and found["bare"] and found["number"]:
            return (
                f"line {n} has a unit, {found['bare']}, expected {found['key']} = {found['number']}: s, m, kg, rad are "
                "what numbers mean"
            )
        if found and found["bare"] and found["bare"] not in ("true", "false", "inf", "nan"):
            return f'line {n} has a text without quotes, expected {found["key"]} = "{found["bare"]}"'
        if line.lstrip().startswith("["):
            name = line.strip().strip("[]").strip()
            if name in values and line.lstrip().startswith("[["):
                return (
                    f"{name} is a value in line {values[name]} and a table [[{name}]] in line {n}, expected one of them"
                )
        elif found:
            values.setdefault(found["key"], n)
    return ""


def check_keys(table: dict[str, Any], keys: Collection[str], where: str) -> None:
    """Refuse a key that is unknown, and suggest the nearest known one."""
    for key in table:
        if key not in keys:
            hint, known = did_you_mean(key, keys), ", ".join(keys)
            if hint and len(keys) > _FEW:  # the cure first: nobody reads on after thirty names
                raise PlannerError(f"{where} has no key {short_repr(key)}.{hint} Its keys are: {known}.")
            raise PlannerError(f"{where} has the key {short_repr(key)}, expected some of: {known}.{hint}")


def check_values(table: Mapping[str, Any], rules: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Those values of a table for which there are rules, checked.

    Args:
        table: Values by key.
        rules: By key, or by TABLE.KEY for a key of a table within, or of each of several; `kind`: it is of this one of
            KINDS; `choices`: it is one of these words; else it is a number with the bounds of number(), or of count()
            where it is `whole`. In place of a word or a number it may be of one of the types `others` (a number that
            may stand in place of a word has its bounds), in place of a number a `word`, or infinite where that is
            `infinite`. With an `example` of numbers, the error of a word shows it.

    Returns:
        The values of the keys, without those of tables within.

    Raises:
        PlannerError: One of them is something else.
    """
    found: dict[str, Any] = {}
    for name, rule in rules.items():
        part, _, key = name.rpartition(".")
        if not part and name in table:
            found[name] = _checked(name, table[name], **rule)
        given = table.get(part)
        for k, one in enumerate(given if isinstance(given, list) else [given], 1):
            if isinstance(one, Mapping) and key in one:
                _checked(f"{key} of {part}" if one is given else f"[[{part}]] {k}'s {key}", one[key], **rule)
    return found


KINDS = {"a text": str, "true or false": bool, "a table": Mapping}


def _checked(
    name: str, value: Any, kind: str = "", choices: Collection[str] = (), others: tuple[type, ...] = (),
    word: str = "", whole: bool = False, example: str = "", infinite: bool = False,
    **bounds: Any,
) -> Any:  # fmt: skip
    """A value by the rule of its key."""
    if kind:
        if not isinstance(value, KINDS[kind]):
            raise PlannerError(f"{name} is {short_repr(value)}, expected {kind}.")
        return value
    if (isinstance(value, others) and not isinstance(value, Real)) or (infinite and value == math.inf):
        return value
    if choices and not (float in others and isinstance(value, Real)):
        return word_or_numbers(name, value, list(choices), example) if example else choice(name, value, choices)
    if isinstance(value, str) and value == word:
        return value
    try:
        return (count if whole else number)(name, value, **bounds)
    except PlannerError as error:
        raise PlannerError(f"{str(error).rstrip('.')}{f', or {word!r}' if word else ''}.") from None


def check_file(
    table: dict[str, Any], keys: Collection[str], parts: Mapping[str, Collection[str]],
    rules: Mapping[str, Mapping[str, Any]], where: str,
) -> None:  # fmt: skip
    """Refuse unknown keys of a file and of its tables, wrong values, and a duration that is missing or no number.

    Args:
        table: Of the file.
        keys: That it may have.
        parts: Keys of its tables by their names; a table `goal`, other than a list of them, has names of joints.
        rules: Of values, as of check_values().
        where: The file's name.

    Raises:
        PlannerError: Also for a key that stands below the heading of a table, to which it then belongs.
    """
    check_keys(table, keys, where)
    for name, known in parts.items():
        given = table.get(name)
        for k, part in enumerate(given if isinstance(given, list) else [given], 1):
            if not isinstance(part, dict):
                continue
            place = f"[[{name}]] number {k}" if part is not given else f"[{name}]"
            joints = name == "goal" and part is given
            for key in part:
                if key not in known and key not in table and key in (("duration",) if joints else keys):
                    raise PlannerError(
                        f"{key} stands in {place} of {where}, expected above the first heading: what stands below a "
                        "heading belongs to its table."
                    )
            if not joints:
                check_keys(part, known, f"{place} of {where}")
    check_values(table, rules)
    if "duration" in table:
        number("duration", table["duration"], greater_than=0.0)
    elif "durations" not in table:
        raise PlannerError(f"{where} has no key 'duration', expected a number of seconds, e.g. duration = 2.0.")


def finite(value: Any) -> Any:
    """Replace nonfinite floats by None, since JSON has no NaN and no infinity."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(content: dict[str, Any]) -> str:
    """The text of a JSON file."""
    return json.dumps(finite(content), indent=2, allow_nan=False) + "\n"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON document atomically."""
    with write_atomically(path) as unfinished:
        unfinished.write_text(json_text(content), encoding="utf-8")
