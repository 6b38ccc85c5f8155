"""The flag --allow-import: modules whose residuals a stored plan may have."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.cases.plan_file import load_plan
from planner.problem.plan import Plan
from planner.problem.residual import Residual


def load_allowed(path: str | Path, arguments: argparse.Namespace) -> Plan:
    """The plan of a file, with the residuals of the modules that --allow-import names."""
    return load_plan(path, residuals=allowed_residuals(arguments))


def allowed_residuals(arguments: argparse.Namespace) -> dict[str, type[Residual]]:
    """Classes of residuals by name, of the modules that --allow-import names.

    Raises:
        PlannerError: A module that cannot be imported, or has no residual.
    """
    found: dict[str, type[Residual]] = {}
    for name in arguments.allow_import:
        named = f"--allow-import {short_repr(name)}"
        try:
            module = _imported(name)
        except Exception as error:  # a module may raise anything
            raise PlannerError(
                f"{named} cannot be imported ({type(error).__name__}: {short_repr(str(error))}), expected a module, or "
                "a file MODULE.py."
            ) from None
        own = {key: one for key, one in vars(module).items() if isinstance(one, type) and issubclass(one, Residual)}
        found |= {one.__name__: one for one in own.values() if one is not Residual}
        if not found:
            raise PlannerError(f"{named} has no residual, expected a class that derives from planner.Residual.")
    return found


def _imported(name: str) -> Any:
    if not name.endswith(".py"):
        if "" not in sys.path and str(Path.cwd()) not in sys.path:  # as python -m has it
            sys.path.insert(0, str(Path.cwd()))
        return importlib.import_module(name)
    module_name = Path(name).stem
    spec = importlib.util.spec_from_file_location(module_name, name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses and pickle look it up there
    spec.loader.exec_module(module)
    return module
