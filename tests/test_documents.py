"""The pages of docs/: every public name has its place, every page is in the table of contents."""

import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"
NAMESPACES = ["", "cases", "constraints", "contact", "costs", "dynamics", "paper", "proof"]


@pytest.mark.parametrize("space", NAMESPACES)
def test_every_public_name_is_on_its_page_of_the_reference(space):
    package = f"planner.{space}" if space else "planner"
    page = (DOCS / "api" / f"{space or 'planner'}.md").read_text(encoding="utf-8")
    described = set(re.findall(rf"^\.\. (?:auto|py:)\w+:: {package}\.(\w+)$", page, re.M))
    elsewhere = set(re.findall(r"\[`(?:planner\.)?(\w+)`\]\(", page))
    names = set(importlib.import_module(package).__all__)
    assert names - described - elsewhere == set()
    assert described - names == set()


@pytest.mark.parametrize("space", NAMESPACES)
def test_every_public_name_says_what_it_is(space):
    package = importlib.import_module(f"planner.{space}" if space else "planner")
    public = {name: getattr(package, name) for name in package.__all__}
    kinds = {name: thing for name, thing in public.items() if callable(thing)}  # numbers and tables: on their page
    silent = [name for name, thing in kinds.items() if not inspect.getdoc(thing)]
    for name, kind in kinds.items():
        told = re.findall(r"^ +(\w+):", kind.__doc__ or "", re.M)  # attributes and arguments
        for member, thing in vars(kind).items() if isinstance(kind, type) else ():
            shown = callable(thing) or isinstance(thing, (property, classmethod, staticmethod))
            if shown and member[0] != "_" and member not in told and not inspect.getdoc(getattr(kind, member)):
                silent.append(f"{name}.{member}")
    assert silent == []
    assert all(len(inspect.getdoc(thing).splitlines()[0]) > 15 for thing in kinds.values())


def test_every_namespace_has_a_page():
    import planner

    modules = {name for name in planner.__all__ if getattr(planner, name).__class__.__name__ == "module"}
    assert modules == set(NAMESPACES) - {""}


def test_every_page_is_in_the_table_of_contents():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    entries = [line for block in re.findall(r"```{toctree}\n(.*?)```", index, re.S) for line in block.splitlines()]
    listed = {page for entry in entries if entry and entry[0] != ":" for page in DOCS.glob(f"{entry}.md")}
    pages = {page for page in DOCS.rglob("*.md") if "_build" not in page.parts}
    assert pages - listed == {DOCS / "index.md"}


@pytest.mark.slow
def test_the_figures_of_the_concepts_are_drawn_from_the_machines(tmp_path):
    script = DOCS / "figures" / "draw.py"
    subprocess.run([sys.executable, script, tmp_path], check=True, env={**os.environ, "PYTHONPATH": str(DOCS.parent)})
    assert {one.name for one in tmp_path.iterdir()} == {one.name for one in script.parent.glob("*.png")}
    shown = (DOCS / "concepts.md").read_text(encoding="utf-8")
    assert all(f"(figures/{one.name})" in shown for one in tmp_path.iterdir())
