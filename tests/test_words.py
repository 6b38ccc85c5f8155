"""The tree uses the words of docs/architecture.md: names that were retired are not defined again."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

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
