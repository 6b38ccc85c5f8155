"""Store a problem without a recipe in a plan's file: its machine as MJCF text, costs and constraints as arrays.

The machine is of RigidBodyDynamics, the cost a TrackingCost, alone or with LeastSquares. A residual is stored by the
name of its class and its parameters; to build it again, load_plan must be given the class of one that is not of the
library, also where it is called as one that is. A problem with a recipe is rebuilt from its recipe instead. Other
dynamics and costs are user-defined Python, which is not stored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import twin_of
from planner.model.mjcf.read import read
from planner.model.twin import Twin
from planner.problem.constraints import forces, quantities
from planner.problem.constraints.constraint import Constraint
from planner.problem.costs.least_squares import TABLES, LeastSquares
from planner.problem.costs.terms import SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.default_appearance import default_appearance
from planner.problem.goals import terms_of
from planner.problem.problem import Problem
from planner.problem.problem_parts import Periodic, Recipe
from planner.problem.residual import Residual

NAME = "mechanism and tracking cost"
_COST = ("Q", "R", "x_ref", "u_ref")
ARRAYS = (*_COST, "x0", "us")
_BOUNDS = ("equal", "lower", "upper")  # of a constraint
LIBRARY: dict[str, type[Residual]] = {
    name: getattr(module, name) for module in (forces, quantities) for name in module.__all__
}
"""Residuals that are known without being named to load_plan."""


def to_arrays(problem: Problem) -> tuple[Recipe, dict[str, np.ndarray]] | None:
    """A recipe and arrays by name for a file; None if they cannot describe the whole problem."""
    dynamics = problem.dynamics
    if unstorable_part(problem) or not isinstance(dynamics, RigidBodyDynamics):
        return None
    facts: dict[str, Any] = {"dt": dynamics.dt, "integrator": dynamics.integrator}
    if dynamics.prescribed:
        facts["prescribed"] = list(dynamics.prescribed)
    if dynamics.substeps > 1:
        facts["substeps"] = dynamics.substeps
    if problem.periodic is not None:
        facts["periodic"] = problem.periodic.to_dict()
    tracking, *terms = terms_of(problem.cost)
    arrays = {name: getattr(tracking, name) for name in _COST} | {"x0": problem.x0, "us": problem.first_guess}
    uses: dict[str, Sequence[Any]] = {"costs": terms, "constraints": problem.constraints}
    for use, parts in uses.items():
        if parts:
            facts[use] = []
        for i, part in enumerate(parts):
            residual, tables = (part.residual, TABLES) if use == "costs" else (part.of, _BOUNDS)
            fact = {"residual": type(residual).__name__, "parameters": residual.parameters()}
            if LIBRARY.get(fact["residual"], type(residual)) is not type(residual):
                fact["own"] = True  # though the library has one of this name
            fact |= {"goal": part.has_goal} if use == "costs" else {
                name: getattr(part, name) for name in ("when", "tolerance", "name", "unit")
            }  # fmt: skip
            facts[use].append(fact)
            arrays |= {f"{use}:{i}:{name}": getattr(part, name) for name in tables if getattr(part, name) is not None}
    arrays = {name: np.asarray(value, dtype=np.float64, order="C") for name, value in arrays.items()}
    return Recipe(NAME, facts), arrays


def unstorable_part(problem: Problem) -> str:
    """Text naming the first part of a problem without a recipe that a file cannot store; "" for none."""
    dynamics, twin = problem.dynamics, problem.twin
    if type(dynamics) is not RigidBodyDynamics:
        return f"its dynamics ({type(dynamics).__name__})"
    terms = terms_of(problem.cost)
    kinds = [type(term) for term in terms]
    if kinds != [TrackingCost] + [LeastSquares] * (len(terms) - 1):
        other = next((one for one in kinds if one not in (TrackingCost, LeastSquares)), type(problem.cost))
        return f"its cost ({other.__name__})"
    if problem.requirements is not None:
        return "its own rule of success"
    if other := [one.name for one in problem.constraints if not isinstance(one.of, Residual) or one.states is not None]:
        return f"its constraints ({', '.join(other)})"
    classes: dict[str, type] = {}
    for residual in (*(term.residual for term in terms[1:]), *(one.of for one in problem.constraints)):
        name = type(residual).__name__
        if classes.setdefault(name, type(residual)) is not type(residual):
            return f"its residuals, two classes of which are called {name}"
        try:
            residual.parameters()
        except PlannerError:
            return f"its residual {residual}, whose arguments are not all attributes and JSON values"
    own = twin_of(dynamics.mechanism, dynamics.prescribed)
    if twin is None or any(getattr(twin, part) != getattr(own, part) for part in ("mjcf", "source", "curves")):
        return "its model in MuJoCo, which is not the mechanism's own"
    return ""


def residual_names(facts: dict[str, Any]) -> list[str]:
    """Names of the residuals of a stored problem that are not of the library."""
    stored = [one for use in ("costs", "constraints") for one in facts.get(use, ())]
    return list(dict.fromkeys(one["residual"] for one in stored if one.get("own") or one["residual"] not in LIBRARY))


def from_arrays(
    facts: dict[str, Any], arrays: dict[str, np.ndarray], twin: Twin | None, residuals: Mapping[str, type[Residual]]
) -> Problem:
    """The problem that to_arrays() described; `residuals` are the classes of those that are not of the library."""
    missing = [name for name in ARRAYS if name not in arrays]
    if twin is None or missing:
        what = f"without {', '.join(missing)}" if missing else "without a model"
        raise PlannerError(f"its problem is {what}, expected {NAME} with {', '.join(ARRAYS)} and a model.")
    mechanism: Mechanism = read(twin.planned, assets=twin.assets).with_curves(twin.curves)
    mechanism = replace(mechanism, original=twin.original)
    prescribed = facts.get("prescribed", [])
    step: dict[str, Any] = {"integrator": facts.get("integrator"), "substeps": facts.get("substeps", 1)}
    dynamics = RigidBodyDynamics(mechanism, facts.get("dt"), prescribed=prescribed, **step)  # pyright: ignore
    cost: Any = TrackingCost(*(arrays[name] for name in _COST), space=dynamics.space)
    own = residual_names(facts)
    classes = LIBRARY | {name: residuals[name] for name in own}
    for residual, fact, tables in _stored("costs", facts, arrays, classes):
        final = tables["weight"][-1] if fact["goal"] else None
        cost = SumCost(
            cost, LeastSquares(dynamics, cost.N, residual, weight=1.0, final_weight=final).with_tables(**tables)
        )
    constraints = [
        Constraint(
            residual, when=fact["when"], tolerance=fact["tolerance"], name=fact["name"], unit=fact["unit"], **tables
        )
        for residual, fact, tables in _stored("constraints", facts, arrays, classes)
    ]
    return Problem(
        dynamics, cost, arrays["x0"], us=arrays["us"], twin=twin,
        appearance=default_appearance(mechanism, prescribed), constraints=constraints,
        periodic=Periodic.from_dict(facts["periodic"]) if facts.get("periodic") is not None else None,
    )  # fmt: skip


def _stored(
    use: str, facts: dict[str, Any], arrays: dict[str, np.ndarray], classes: Mapping[str, type[Residual]]
) -> Iterator[tuple[Residual, dict[str, Any], dict[str, Any]]]:
    """The residuals of the costs or of the constraints, what else is stored of each, and its arrays by name."""
    for i, fact in enumerate(facts.get(use, ())):
        known = TABLES if use == "costs" else _BOUNDS
        tables = {name: arrays[key] for name in known if (key := f"{use}:{i}:{name}") in arrays}
        yield classes[fact["residual"]](**fact["parameters"]), fact, tables
