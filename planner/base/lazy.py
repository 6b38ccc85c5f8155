"""Packages whose public names are imported on first access (PEP 562).

The package's `__init__.pyi` lists each name once: `from planner.X import NAME as NAME`. Type checkers read that file,
and this module takes the source of each name from it. So `import planner` is fast and does not choose an OpenGL
library.
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
            import difflib  # local, so that `import planner` is fast

            similar = difflib.get_close_matches(name, home, n=1)
            hint = f". Did you mean {similar[0]!r}?" if similar else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{hint}")
        if home[name] == package:  # a submodule of the package
            return import_module(f"{package}.{name}")
        value = getattr(import_module(home[name]), name)
        setattr(module, name, value)
        return value

    return get, lambda: sorted({*vars(module), *home}), sorted(home)
