"""The examples of docs/api: every public name is in one, and each prints what its page says."""

import ast
import doctest
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NAMESPACES = ["planner", "cases", "constraints", "contact", "costs", "dynamics", "paper", "proof"]


def examples_of(space):
    """The pycon blocks of a page, in order, as one doctest."""
    page = ROOT / "docs" / "api" / f"{space}.md"
    blocks = re.findall(r"```pycon\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    return doctest.DocTestParser().get_doctest("\n".join(blocks), {}, page.name, str(page), 0)


def used_names(source):
    """Names and attributes that code uses; an import alone uses nothing."""
    nodes = list(ast.walk(ast.parse(source)))
    return {n.id for n in nodes if isinstance(n, ast.Name)} | {n.attr for n in nodes if isinstance(n, ast.Attribute)}


@pytest.mark.parametrize("space", NAMESPACES)
def test_every_public_name_is_in_an_example(space):
    package = importlib.import_module("planner" if space == "planner" else f"planner.{space}")
    names = {name for name in package.__all__ if getattr(package, name).__class__.__name__ != "module"}
    assert names - set().union(*(used_names(example.source) for example in examples_of(space).examples)) == set()


@pytest.mark.render
@pytest.mark.parametrize("space", NAMESPACES)
def test_examples_of_the_reference_print_what_they_say(space, monkeypatch):
    monkeypatch.chdir(ROOT)  # for the files of examples/
    told = []
    runner = doctest.DocTestRunner(verbose=False)
    runner.run(examples_of(space), out=told.append)
    assert runner.failures == 0, "".join(told)
