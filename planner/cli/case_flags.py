"""Flags of a case and of its solver, and the command `list`, which shows them.

A case's signature gives the names, types and defaults of its own flags.
"""

from __future__ import annotations

import argparse
import inspect
import json
import re
import textwrap
from collections.abc import Callable
from typing import Any, get_args, get_type_hints

from planner.base.arguments import choice
from planner.base.data_files import problem_files, problem_summary
from planner.cli.console import Console
from planner.cli.flags import (
    COMMON,
    PROBLEM_FILE,
    Flags,
    add,
    boolean_flag,
    choice_flag,
    counted,
    natural,
    number,
    value_flag,
    value_of,
    whole,
)

CASES: dict[str, Callable[..., Any]] = value_of("planner.cases", "CASES")
"""The cases, with their signatures and docstrings alone."""
INTEGRATORS = value_of("planner.kernels.integrators", "INTEGRATORS")
OBJECTIVES = value_of("planner.problem.problem_parts", "OBJECTIVES")
HESSIANS, LINE_SEARCHES, UPDATES = (
    value_of("planner.solvers.options", name) for name in ("HESSIANS", "LINE_SEARCHES", "UPDATES")
)
DEFAULTS = value_of("planner.cases.problem_file.keys", "DEFAULTS")
_OWN = "A machine of your own: an MJCF file, a start, a goal, weights (docs/problem-file.md)."

_LIMITS: Flags = {
    "--control-limit": value_flag("X", "Largest magnitude of every control.", kind=number),
    "--exact-goal": boolean_flag("Reach the goal to 1e-4 instead of weighing the distance to it."),
}
_SOLVER: Flags = {
    "--update": choice_flag(UPDATES, "New controls: feedback, us + step k + K (x - xs), or open-loop, the paper's "
                                     "Eq. 36.",
                        "feedback"),
    "--line-search": choice_flag(LINE_SEARCHES, "Rule that accepts a step length.", "armijo"),
    "--hessian": choice_flag(HESSIANS, "exact adds second derivatives of the dynamics (hinges, slides, hopper).",
                         "gauss-newton"),
    "--max-iterations": value_flag("N", "Largest number of iterations of the solver.", 1000, counted),
    "--starts": value_flag("N", "Number of first guesses to try: the problem's own and smooth random changes of it; "
                                "the best plan wins. Default: 1.", kind=counted),
    "--seed": value_flag("N", "Seed of the random first guesses. Default: 0.", kind=natural),
    "--rank": choice_flag(("cost", "proven-cost"), "Rank starts by cost of the plan, or of its replay in MuJoCo.",
                      "cost"),
    "--objective": value_flag("NAME", f"Minimize one of {', '.join(OBJECTIVES)}, or weights, e.g. effort=1,time=2. "
                                  "Default: effort."),
    "--durations": value_flag("A,B", "Shortest and longest duration, s, for an objective with time."),
}  # fmt: skip
_URDF: Flags = {
    "--package-path": value_flag(
        "DIR", "Folder of the packages that the file's URDF names, instead of its package_path."
    ),
}


def add_cases(parser: argparse.ArgumentParser, *groups: Flags) -> None:
    """Give a command its machines, each with its own flags, those of the solver and some others."""
    machines = parser.add_subparsers(dest="case", metavar="CASE", required=True)
    shared: set[str] = set()
    for case, build_case in CASES.items():
        child = machines.add_parser(
            case, help=summary(build_case), description=f"{parser.description} {summary(build_case)}"
        )
        child.set_defaults(parser=child)
        _add_case(child, build_case)
        add(child, _LIMITS, _SOLVER, *groups, COMMON)
        shared = set(child._option_string_actions) - {"-h", "--help"}
    keys = f"Its keys: {', '.join(value_of('planner.cases.problem_file.keys', 'KEYS'))}."
    for name, file in {**problem_files(), PROBLEM_FILE: None}.items():
        text = _OWN if file is None else problem_summary(file)
        own = machines.add_parser(name, help=text, description=f"{parser.description} {text}", epilog=keys)
        own.set_defaults(parser=own, control_limit=None, exact_goal=False)
        if file is None:
            own.add_argument("problem", metavar="FILE", help="A problem.toml.")
        else:
            own.set_defaults(case=PROBLEM_FILE, problem=str(file))
        add(own, _URDF, _SOLVER, *groups, COMMON)
        if file is None:  # the last one: all of them share the same
            parser.set_defaults(shared=[one for one in own._actions if not shared.isdisjoint(one.option_strings)])


def documented_arguments(case: Callable[..., Any]) -> dict[str, str]:
    """Descriptions of the arguments of a case, from the Args section of its docstring."""
    doc = inspect.getdoc(case) or ""
    section = doc.split("Args:\n", 1)[-1].split("\n\n", 1)[0]
    return {name: " ".join(text.split()) for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.M)}


def summary(case: Callable[..., Any]) -> str:
    """The first line of a case's docstring."""
    return (inspect.getdoc(case) or "").split("\n", 1)[0]


def _add_case(parser: argparse.ArgumentParser, case: Callable[..., Any]) -> None:
    texts, hints = documented_arguments(case), get_type_hints(case)
    for parameter in _flags(case):
        name, default = parameter.name, parameter.default
        words = [word for word in _leaves(hints[name]) if isinstance(word, str)]
        options: dict[str, Any] = {"default": argparse.SUPPRESS, "help": texts.get(name, "")}
        if default is not None:
            options["help"] += f" Default: {default}."
        if name == "integrator":
            options["choices"] = INTEGRATORS
        elif words:
            options["choices"] = words
        elif str in _leaves(hints[name]):
            options |= {"metavar": "FILE"}
        elif int in _leaves(hints[name]):
            options |= {"type": whole, "metavar": "N"}
        else:
            options |= {"type": number, "metavar": "X"}
        parser.add_argument(f"--{name.replace('_', '-')}", dest=f"case_{name}", **options)


def _leaves(hint: Any) -> tuple[Any, ...]:
    """Types and words in a type hint: "a", "b" and None for `Literal["a", "b"] | None`."""
    parts = get_args(hint)
    return (hint,) if not parts else tuple(leaf for part in parts for leaf in _leaves(part))


COLUMNS = 100  # width of what is printed

_OWN_SUMMARY = "a machine of your own: its MJCF or URDF, a start, a goal"


def list_cases(arguments: argparse.Namespace, console: Console) -> int:
    """List the machines, or the flags of one, or the keys of a problem file."""
    name, files = arguments.machine, problem_files()
    if name in files:
        console.write_result(f"{files[name]}:\n\n{files[name].read_text(encoding='utf-8')}")
        return console.finish("list", 0, cases=[], problem_file={"path": str(files[name])})
    if name is not None:
        name = PROBLEM_FILE if name.lower().endswith(".toml") else name  # whoever has one asks for its keys
        choice("the machine", name, (*CASES, *files, PROBLEM_FILE))
    shown = CASES if name is None else {} if name == PROBLEM_FILE else {name: CASES[name]}
    document = [_described(one, case) for one, case in shown.items()]
    if name is None:
        rows = {row["case"]: row["summary"] for row in document}
        rows |= {one: problem_summary(file) for one, file in files.items()} | {PROBLEM_FILE: _OWN_SUMMARY}
        width = max(map(len, rows))
        for one, text in rows.items():
            console.write_result(f"{one:{width}}  {textwrap.shorten(text, COLUMNS - width - 2, placeholder=' ...')}")
        console.write_result(
            f"\nplanner list NAME shows the flags or the file of one, planner list {PROBLEM_FILE} the keys of a file."
        )
    elif name in shown:
        _show_flags(name, console)
    keys = _keys()
    if name == PROBLEM_FILE:
        console.write_result(f"{PROBLEM_FILE}: {_OWN_SUMMARY}; see docs/problem-file.md")
        lines = [(f"  {key}", json.dumps(DEFAULTS[key]) if key in DEFAULTS else "", text) for key, text in keys.items()]
        console.table(("  key", "default", ""), lines, COLUMNS)
    return console.finish("list", 0, cases=document, problem_file={"keys": keys, "defaults": DEFAULTS})


def _described(name: str, case: Any) -> dict[str, Any]:
    """Name, summary and parameters of a case, as JSON values."""
    return {"case": name, "summary": summary(case), "parameters": {p.name: p.default for p in _flags(case)}}


def _flags(case: Any) -> list[inspect.Parameter]:
    """The parameters of a case that one word can hold; arrays have no flag."""
    hints, parameters = get_type_hints(case), inspect.signature(case).parameters
    return [parameter for name, parameter in parameters.items() if ... not in _leaves(hints[name])]


def _show_flags(name: str, console: Console) -> None:
    case = CASES[name]
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
        name: value_of("planner.cases.problem_file.keys", name.upper())
        for name in ("weights", "goal", "follow", "attach", "obstacle")
    }
    more = {f"{table}.{name}": text for table, names in tables.items() for name, text in names.items()}
    return value_of("planner.cases.problem_file.keys", "KEYS") | more
