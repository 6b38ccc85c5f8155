"""Import the public names of a package at their first use (PEP 562), so that `import planner` is quick.

The names are written once, in the package's `__init__.pyi`, as `from planner.X import NAME as NAME`. Type checkers read
that file; here it says where each name is defined.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def public_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package, from its `__init__.pyi`."""
    module = sys.modules[package]
    stub = Path(str(module.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    lines = [line for line in ast.parse(stub).body if isinstance(line, ast.ImportFrom)]
    home = {alias.name: str(line.module) for line in lines for alias in line.names}

    def get(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if home[name] == package:  # a part of the package itself
            return import_module(f"{package}.{name}")
        value = getattr(import_module(home[name]), name)
        setattr(module, name, value)
        return value

    return get, lambda: sorted({*vars(module), *home}), sorted(home)
