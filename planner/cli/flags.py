"""Flags of the command line that several commands share, how a flag is written down, and choices from the sources.

A command line is checked before MuJoCo, Numba or SciPy are imported, which take seconds. But flags, choices and
defaults are those of the cases and of the solver. So value_of() compiles the statement that defines a name alone, with
the names that it uses, found in the same way. Of a function there is only the signature and the docstring.
"""

from __future__ import annotations
import __future__

import argparse
import ast
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

from planner.base.arguments import short_repr

PROBLEM_FILE = "PROBLEM.toml"
"""Stands for any problem file where a case may be named."""

Flags = dict[str, dict[str, Any]]  # options of add_argument() by flag


def _word_as(parse: Callable[[str], Any], expected: str) -> Callable[[str], Any]:
    """A type of add_argument() that names what it expected."""

    def convert(text: str) -> Any:
        try:
            return parse(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{short_repr(text)} is not {expected}") from None

    return convert


def _whole_from(minimum: int, text: str) -> int:
    value = int(text)
    if value < minimum:
        raise ValueError
    return value


def _width_and_height(text: str) -> tuple[int, int]:
    width, height = map(int, text.split("x"))
    return width, height


def _direction(text: str) -> str | tuple[float, float]:
    """A camera's name, or its azimuth and elevation."""
    if "," not in text:
        return text
    azimuth, elevation = map(float, text.split(","))
    return azimuth, elevation


number, whole = _word_as(float, "a number"), _word_as(int, "a whole number")
counted, natural = (_word_as(partial(_whole_from, least), f"a whole number of at least {least}") for least in (1, 0))
size = _word_as(_width_and_height, "a size like 1280x720")
direction = _word_as(_direction, "a camera's name, or azimuth and elevation like 90,-15")


def value_flag(metavar: str, text: str, default: Any = None, kind: Callable[[str], Any] = str) -> dict[str, Any]:
    """Options of add_argument() for a flag with a value."""
    told = text if default is None else f"{text} Default: {default}."
    return {"metavar": metavar, "help": told, "default": default, "type": kind}


def choice_flag(choices: Sequence[str], text: str, default: str) -> dict[str, Any]:
    """Options of add_argument() for a flag with one of some words."""
    return {"choices": choices, "default": default, "help": f"{text} Default: {default}."}


def boolean_flag(text: str) -> dict[str, Any]:
    """Options of add_argument() for a flag without a value."""
    return {"action": "store_true", "help": text}


WORKERS: Flags = {
    "--workers": value_flag("N", "Number of processes. Default: for sweep and paper one per processor, else threads "
                                 "of one process.", kind=counted),
    "--scheduler": value_flag("ADDRESS", "Use the workers of a Dask scheduler, tcp://HOST:8786, or of a new cluster "
                                         "on this machine: local."),
}  # fmt: skip
PROOF: Flags = {
    "--rollouts": value_flag(
        "N", "Number of perturbed simulations, 0 for none; `run` stops them after 20 s.", 512, natural
    ),
    "--hold": value_flag(
        "S", "Also hold the goal for S seconds after the end, by an infinite-horizon LQR.", 0.0, number
    ),
}
ROLLOUT: Flags = {
    "--replay-rollout": value_flag("K", "Show perturbed simulation K in detail.", kind=natural),
    "--mode": choice_flag(("feedback", "open-loop"), "Simulate it with the plan's gains or open loop.", "feedback"),
    "--seed": value_flag("N", "Seed of the perturbations.", 0, natural),
    "--perturb": {"action": "append", "metavar": "NAME=X",
                  "help": "Size of a perturbation, e.g. mass=0.1 or delay=0 (docs/proof.md). May be repeated."},
}  # fmt: skip
BUDGET: Flags = {
    "--work": value_flag("N", "Work that the run may take, about N s of one core; counted, so that the plan is the "
                              "same on any computer. Default: that of the problem file, else about a minute.",
                         kind=number),
    "--budget": value_flag("SECONDS", "Last stop by the clock: solves end, and what is not drawn yet is left out. The "
                                      "plan then depends on the computer, and says so. Default: none.", kind=number),
}  # fmt: skip
LOOKS: Flags = {
    "--size": value_flag("WxH", "Size of the film in pixels. Default: 1280x720, for a strip 1920x540.", kind=size),
    "--camera": value_flag("CAMERA", "Look as this camera of the model does, or at azimuth,elevation in degrees, e.g. "
                                     "--camera=90,-15; from where all of the motion is seen.", kind=direction),
    "--transparent": boolean_flag("The strip of poses without sky and floor, on a transparent ground."),
}  # fmt: skip
NO_VIDEO = {"--no-video": boolean_flag("Make no video and no strip of poses (drawing needs OpenGL).")}
IMPORTS: Flags = {
    "--allow-import": {"action": "append", "metavar": "MODULE", "default": [],
                       "help": "Import this module, or file MODULE.py, for residuals of your own. May be repeated."},
}  # fmt: skip
COMMON: Flags = {
    "--json": boolean_flag("Print one JSON document on stdout."),
    "--quiet": boolean_flag("Print no progress."),
    "--verbose": boolean_flag("Print every measured number and, at a terminal, every iteration."),
    "--confine": value_flag("DIR", "Read no input outside of this folder: for models and problem files of strangers."),
}


def add(parser: argparse.ArgumentParser, *groups: Flags) -> None:
    """Add groups of flags to a command."""
    for group in groups:
        for flag, options in group.items():
            parser.add_argument(flag, **options)


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
