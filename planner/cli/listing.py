"""The command `list`: a line for each machine; of one that is named its flags, or the keys of a problem file."""

from __future__ import annotations

import argparse
import inspect
import json
import textwrap
from typing import Any, get_type_hints

from planner import cases
from planner.base.arguments import choice
from planner.cases.problem_file import keys as problem_keys
from planner.cli.case_flags import documented_arguments, has_flag, summary
from planner.cli.console import Console
from planner.cli.flags import PROBLEM_FILE

COLUMNS = 100  # width of what is printed

_OWN = "a machine of your own: its MJCF or URDF, a start, a goal"


def list_cases(arguments: argparse.Namespace, console: Console) -> int:
    """List the machines, or the flags of one, or the keys of a problem file."""
    name = arguments.machine
    if name is not None:
        choice("the machine", name, (*cases.CASES, PROBLEM_FILE))
    shown = cases.CASES if name is None else {} if name == PROBLEM_FILE else {name: cases.CASES[name]}
    document = [_described(one, case) for one, case in shown.items()]
    if name is None:
        width = max(map(len, (*shown, PROBLEM_FILE)))
        for row in (*document, {"case": PROBLEM_FILE, "summary": _OWN}):
            text = textwrap.shorten(row["summary"], COLUMNS - width - 2, placeholder=" ...")
            console.write_result(f"{row['case']:{width}}  {text}")
        console.write_result(
            f"\nplanner list NAME shows the flags of one, planner list {PROBLEM_FILE} the keys of a problem file."
        )
    elif name in shown:
        _show_flags(name, console)
    keys = _keys()
    if name == PROBLEM_FILE:
        console.write_result(f"{PROBLEM_FILE}: {_OWN}; see docs/own-machine.md")
        defaults = problem_keys.DEFAULTS
        lines = [(f"  {key}", json.dumps(defaults[key]) if key in defaults else "", text) for key, text in keys.items()]
        console.table(("  key", "default", ""), lines, COLUMNS)
    return console.finish("list", 0, cases=document, problem_file={"keys": keys, "defaults": problem_keys.DEFAULTS})


def _described(name: str, case: Any) -> dict[str, Any]:
    """Name, summary and parameters of a case, as JSON values."""
    return {"case": name, "summary": summary(case), "parameters": {p.name: p.default for p in _flags(case)}}


def _flags(case: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(case)
    return [parameter for parameter in inspect.signature(case).parameters.values() if has_flag(hints[parameter.name])]


def _show_flags(name: str, console: Console) -> None:
    case = cases.CASES[name]
    texts = documented_arguments(case)
    console.write_result(textwrap.fill(f"{name}: {summary(case)}", COLUMNS))
    rows = []
    for parameter in _flags(case):
        default = "" if parameter.default is None else str(parameter.default)
        rows.append((f"  --{parameter.name.replace('_', '-')}", default, texts.get(parameter.name, "")))
    console.table(("  flag", "default", ""), rows, COLUMNS)
    console.write_result(f"\nplanner run {name} --help shows the solver's flags too.")


def _keys() -> dict[str, str]:
    """Every key of a problem file and what it means."""
    tables = {
        "weights": problem_keys.WEIGHTS, "goal": problem_keys.GOAL, "follow": problem_keys.FOLLOW,
        "attach": problem_keys.ATTACH,
    }  # fmt: skip
    more = {f"{table}.{name}": text for table, names in tables.items() for name, text in names.items()}
    return problem_keys.KEYS | more
