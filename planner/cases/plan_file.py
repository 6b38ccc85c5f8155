"""load_plan(): a plan from its file, with its problem built again by its recipe."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.base.arguments import choice, short_repr
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable
from planner.cases import problem_file
from planner.model.space import space_of
from planner.model.twin import Twin, moved
from planner.problem import stored_problem
from planner.problem.archive import FILE, HINGES, PART, read_archive
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.limits import Limits
from planner.problem.objective import base_problem, with_objective
from planner.problem.plan import Iteration, Plan, Start, Status
from planner.problem.problem import Problem
from planner.problem.problem_parts import Recipe
from planner.problem.residual import Residual
from planner.problem.touch_downs import TouchDown

_SMOOTHING = {"smoothing": 1.0}  # W, of the energy in plans that do not say: they were made before it was found


def load_plan(
    path: str | Path, *, problem: Problem | None = None, residuals: Mapping[str, type[Residual]] | None = None
) -> Plan:
    """Read a plan.npz and build its problem again.

    Args:
        path: The file.
        problem: The problem that was solved, for a plan whose dynamics or cost is its maker's own Python.
        residuals: Classes of residuals by name, for a plan with residuals of its maker's own. A file names them, but
            nothing is imported because of a file.

    Raises:
        FileError: No such file, not a plan, damaged, written in another version's format, or with a residual that
            `residuals` has not.
        PlannerError: The problem given is not of the plan's sizes.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise FileError(f"cannot read a plan from a {type(path).__name__}, expected the path of a plan.npz.")
    arrays, meta = read_archive(Path(path), len(Iteration._fields))
    residuals = {} if residuals is None else residuals
    _check_residuals(path, meta["recipe"], residuals, problem)
    try:
        plan = _plan(arrays, meta, Path(path).parent)
        if problem is not None:
            return replace(plan, problem=_fitting(plan, problem), recipe=problem.recipe)
        built = _problem(plan, arrays, meta, residuals)
        return plan if built is None else replace(plan, problem=_fitting(plan, built), recipe=built.recipe)
    except PlannerError as error:
        raise FileError(f"{printable(path)} is damaged or of a case that cannot be built again: {error}") from None
    except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError, MemoryError) as error:
        reason = " ".join(f"{type(error).__name__} in its meta, {error}".split()).rstrip(" ,.")
        raise FileError(f"{printable(path)} is damaged: {reason}.") from None


def _twin(meta: dict[str, Any], files: dict[str, bytes], folder: Path) -> Twin:
    """The twin, with the paths of its origin relative to the plan's folder."""
    twin = Twin.from_dict(meta["mjcf"], meta["twin"], files)
    return replace(twin, origin=moved(twin.origin, lambda path: os.path.abspath(folder / path)))


def _plan(arrays: dict[str, np.ndarray], meta: dict[str, Any], folder: Path) -> Plan:
    """The plan without its problem."""
    files = {name: arrays[FILE + digest].tobytes() for name, digest in meta["files"].items()}
    return Plan(
        *(arrays[name] for name in ("t", "xs", "us", "K")),
        cost=_number(meta["cost"]),
        gradient_norm=_number(meta["gradient_norm"]),
        status=_status(meta["status"]),
        history=tuple(Iteration(int(row[0]), *map(float, row[1:])) for row in arrays["history"]),
        recipe=None if meta["recipe"] is None else Recipe(**meta["recipe"]),
        twin=None if meta["twin"] is None else _twin(meta, files, folder),
        made_with=meta["versions"],
        starts=tuple(
            Start(index, _status(status), _number(cost), iterations, _number(score))
            for index, status, cost, iterations, score in meta["starts"]
        ),
        stored_space=meta["space"],
        options=meta["options"],
        changed=meta["changed"],
        bound_penalties=BoundPenalties(*(arrays[name] for name in HINGES)) if HINGES[0] in arrays else None,
        stored_touch_downs=tuple(map(TouchDown.from_dict, meta["touch_downs"])),
    )


def _check_residuals(
    path: str | Path, recipe: dict[str, Any] | None, residuals: Mapping[str, type[Residual]], problem: Problem | None
) -> None:
    """Raise an error unless the classes of all residuals that are not of the library are known."""
    for name, one in residuals.items():
        if not (isinstance(one, type) and issubclass(one, Residual)):
            raise PlannerError(f"residuals has {short_repr(one)} as {name!r}, expected a class of planner.Residual.")
    if problem is not None or recipe is None or recipe["name"] != stored_problem.NAME:
        return
    try:
        unknown = [name for name in stored_problem.residual_names(recipe["parameters"]) if name not in residuals]
    except (TypeError, LookupError, AttributeError):
        raise FileError(f"{printable(path)} is damaged: its meta has no usable residuals.") from None
    if unknown:
        name = printable(unknown[0])
        raise FileError(
            f"{printable(path)} has the residual {name!r} of its maker's own, expected its class: "
            f"load_plan(path, residuals={{{name!r}: Class}}), or --allow-import MODULE in a command."
        )


def _problem(
    plan: Plan, arrays: dict[str, np.ndarray], meta: dict[str, Any], residuals: Mapping[str, type[Residual]]
) -> Problem | None:
    """The problem of a stored plan, with its limits and its objective; None where it is its maker's own Python."""
    if plan.recipe is None:
        return None
    name, parameters = plan.recipe.name, plan.recipe.parameters
    own = {part.removeprefix(PART): array for part, array in arrays.items() if part.startswith(PART)}
    if name == stored_problem.NAME:
        problem = stored_problem.from_arrays(parameters, own, plan.twin, residuals)
    elif name == problem_file.NAME:
        problem = problem_file.of_table(parameters, plan.twin, own)
    else:
        problem = cases.build(name, **parameters)
    if problem.recipe is not None and problem.recipe.parameters != parameters:
        missing = sorted(set(problem.recipe.parameters) - set(parameters))
        raise PlannerError(f"its parameters are not complete (missing: {', '.join(missing) or 'none, but changed'}).")
    limits = problem.limits if meta["limits"] is None else Limits.from_dict(meta["limits"])
    problem = replace(base_problem(problem), limits=limits)
    if meta["tolerance"] is not None:
        problem = replace(problem, tolerance=meta["tolerance"])
    return problem if meta["objective"] is None else with_objective(problem, _SMOOTHING | meta["objective"])


def _fitting(plan: Plan, problem: Problem) -> Problem:
    """The problem, when a plan's arrays and maps are of its sizes."""
    if plan.stored_space != space_of(problem.dynamics) or plan.us.shape != (problem.N, problem.dynamics.nu):
        raise PlannerError(f"its arrays do not fit its {f'case {plan.recipe.name!r}' if plan.recipe else 'problem'}.")
    if plan.bound_penalties is not None and (
        problem.trajectory_constraints is None
        or plan.bound_penalties.weight.shape[1] != problem.trajectory_constraints.size
    ):
        raise PlannerError("the penalties of its ranges and constraints do not fit those of its problem.")
    if plan.twin is not None and len(plan.twin.to_x) != problem.dynamics.nx:
        raise PlannerError(f"its twin is of {len(plan.twin.to_x)} states, expected {problem.dynamics.nx}.")
    return problem


def _number(value: float | None) -> float:
    """A number of a JSON file, where null stands for a number that is not finite."""
    return math.nan if value is None else float(value)


def _status(name: str) -> Status:
    return Status[choice("status", name, Status.__members__)]
