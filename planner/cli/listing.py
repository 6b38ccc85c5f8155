"""The command `list`: the machines with their flags, and the keys of a problem file."""

from __future__ import annotations

import argparse
import inspect
import json
import textwrap
from typing import get_type_hints

from planner import cases
from planner.cases.problem_file import keys as problem_keys
from planner.cli.console import Console
from planner.cli.parser import PROBLEM_FILE, documented_arguments, has_flag, summary

COLUMNS = 100  # width of what is printed


def list_cases(arguments: argparse.Namespace, console: Console) -> int:
    """List the machines, their summaries and their parameters."""
    document = []
    for name, case in cases.CASES.items():
        texts, hints = documented_arguments(case), get_type_hints(case)
        shown = [p for p in inspect.signature(case).parameters.values() if has_flag(hints[p.name])]
        console.say(textwrap.fill(f"{name}: {summary(case)}", COLUMNS))
        rows = []
        for parameter in shown:
            default = "" if parameter.default is None else str(parameter.default)
            rows.append((f"  --{parameter.name.replace('_', '-')}", default, texts.get(parameter.name, "")))
        console.table(("  flag", "default", ""), rows, COLUMNS)
        parameters = {parameter.name: parameter.default for parameter in shown}
        document.append({"case": name, "summary": summary(case), "parameters": parameters})
    tables = {
        "weights": problem_keys.WEIGHTS, "goal": problem_keys.GOAL, "follow": problem_keys.FOLLOW,
        "attach": problem_keys.ATTACH,
    }  # fmt: skip
    more = {f"{table}.{name}": text for table, names in tables.items() for name, text in names.items()}
    keys = problem_keys.KEYS | more
    defaults = problem_keys.DEFAULTS
    console.say(f"{PROBLEM_FILE}: A machine of your own, an MJCF file; see docs/own-machine.md")
    lines = [(f"  {key}", json.dumps(defaults[key]) if key in defaults else "", text) for key, text in keys.items()]
    console.table(("  key", "default", ""), lines, COLUMNS)
    return console.finish("list", 0, cases=document, problem_file={"keys": keys, "defaults": defaults})
