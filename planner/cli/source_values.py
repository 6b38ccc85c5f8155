"""Constants and signatures of the package from its sources, without importing the modules that hold them.

A command line is checked before MuJoCo, Numba or SciPy are imported, which take seconds. But flags, choices and
defaults are those of the cases and of the solver. So the statement that defines a name is compiled alone, with the
names that it uses, found in the same way. Of a function there is only the signature and the docstring.
"""

from __future__ import annotations
import __future__

import ast
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


@cache
def value_of(module: str, name: str) -> Any:
    """What a name of a module stands for, e.g. "HESSIANS" of "planner.solvers.options"."""
    statement = _statements(module).get(name)
    if statement is None:
        raise LookupError(f"{module} does not define {name}")
    if isinstance(statement, ast.Import):
        return import_module(next(one.name for one in statement.names if name in (one.asname, one.name)))
    if isinstance(statement, ast.ImportFrom):
        source = str(statement.module)
        imported = next(one.name for one in statement.names if name in (one.asname, one.name))
        return value_of(source, imported) if _files(source) else getattr(import_module(source), imported)
    if isinstance(statement, ast.FunctionDef):
        statement = _signature(statement)
    elif isinstance(statement, ast.AnnAssign) and statement.value is not None:  # its annotation is not needed
        statement = ast.copy_location(ast.Assign([statement.target], statement.value), statement)
    loaded = (node for node in ast.walk(statement) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load))
    used = {node.id for node in loaded} & set(_statements(module)) - {name}
    names = {"__name__": module} | {one: value_of(module, one) for one in used}
    code = compile(ast.Module([statement], []), module, "exec", __future__.annotations.compiler_flag)
    exec(code, names)
    return names[name]


def _signature(function: ast.FunctionDef) -> ast.FunctionDef:
    docstring = ast.Expr(ast.Constant(ast.get_docstring(function, clean=False) or ""))
    bare = ast.FunctionDef(function.name, function.args, [docstring], [], None)
    return ast.fix_missing_locations(ast.copy_location(bare, function))


@cache
def _statements(module: str) -> dict[str, ast.stmt]:
    """The statements at the top of a module by the names that they define."""
    found: dict[str, ast.stmt] = {}
    for statement in [one for file in _files(module) for one in ast.parse(file.read_text(encoding="utf-8")).body]:
        if isinstance(statement, (ast.Import, ast.ImportFrom)):
            found |= {one.asname or one.name: statement for one in statement.names}
        elif isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
            found[statement.name] = statement
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            found[statement.target.id] = statement
        elif isinstance(statement, ast.Assign):
            targets = [node for target in statement.targets for node in ast.walk(target)]  # also of A, B = 1, 2
            found |= {one.id: statement for one in targets if isinstance(one, ast.Name)}
    return found


def _files(module: str) -> list[Path]:
    """The sources of a module of the package, none of another; the stub has names that are imported on first access."""
    if module.split(".")[0] != "planner":
        return []
    base = ROOT.joinpath(*module.split("."))
    return [path for path in (base / "__init__.pyi", base / "__init__.py", base.with_suffix(".py")) if path.is_file()]
