"""The pages of docs/: every public name has its place, every page is in the table of contents."""

import importlib
import re
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
