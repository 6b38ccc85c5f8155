"""The tree uses the words of docs/architecture.md: names that were retired are not defined again."""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from planner.cases.problem_file import keys
from planner.cases.problem_file.reference_guess import GUESSES
from planner.cli.parser import build

ROOT = Path(__file__).parents[1]
PLANNER = ROOT / "planner"


def retired() -> dict[str, list[str]]:
    """Retired names and files by folder of planner/."""
    found: dict[str, list[str]] = {}
    folder = ""
    for line in (ROOT / "tests" / "retired_names.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("#") or not line.strip():
            continue
        if not line.startswith(" "):
            folder, _, line = line.partition(":")
        found.setdefault(folder, []).extend(line.split())
    return found


@cache
def defined(folder: str) -> set[str]:
    """Names of functions, classes and variables that files below a folder define, and those files."""
    names = set()
    for path in (PLANNER / folder).rglob("*.py"):
        names.add(path.relative_to(PLANNER / folder).as_posix())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                names.add(node.name)
            elif isinstance(node, (ast.Assign, ast.AnnAssign)):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


@pytest.mark.parametrize("folder", retired())
def test_no_retired_name_is_defined(folder):
    assert len(defined(folder)) > 10  # the folder is there
    assert not defined(folder).intersection(retired()[folder])


RETIRED_KEYS = {"least", "most", "bend", "sink", "more", "measure"}
RETIRED_GUESSES = {"led", "around"}
RETIRED_FLAGS = {"--rubbing", "--heavier", "--map", "--continue", "--replay-case"}


def flags_of(parser: argparse.ArgumentParser) -> Iterator[str]:
    """The flags of a parser and of its commands."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from flags_of(command)


def test_no_retired_key_guess_or_flag_is_taken():
    tables = [value for name, value in vars(keys).items() if name.isupper() and isinstance(value, dict)]
    assert not RETIRED_KEYS.intersection(set().union(*tables))
    assert not RETIRED_GUESSES.intersection(GUESSES)
    flags = set(flags_of(build()))
    assert "--rollouts" in flags
    assert not RETIRED_FLAGS & flags
