"""Packages whose public names are imported when they are first asked for (PEP 562).

The names stand once, in the package's `__init__.pyi`, a line each: `from planner.X import NAME as NAME`. Type checkers
read that file as it is; here it says where each name is found. So `import planner` is quick and chooses no OpenGL.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def public_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package, from its `__init__.pyi`."""
    module = sys.modules[package]
    with open(f"{module.__file__}i", encoding="utf-8") as stub:
        lines = [line.split() for line in stub if line.startswith("from ")]
    home = {name: source for _, source, _, name, *_ in lines}

    def get(name: str) -> Any:
        if name not in home:
            import difflib  # here, so that `import planner` stays quick

            similar = difflib.get_close_matches(name, home, n=1)
            hint = f". Did you mean {similar[0]!r}?" if similar else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{hint}")
        if home[name] == package:  # a part of the package itself
            return import_module(f"{package}.{name}")
        value = getattr(import_module(home[name]), name)
        setattr(module, name, value)
        return value

    return get, lambda: sorted({*vars(module), *home}), sorted(home)
