"""Store a problem without a recipe in a plan's file: RigidBodyDynamics and a TrackingCost, as arrays and MJCF text.

A problem with a recipe is rebuilt from its recipe instead. Any other dynamics or cost is user-defined Python, which is
not stored.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import twin_of
from planner.model.mjcf.read import read
from planner.model.twin import Twin
from planner.problem.costs.tracking import TrackingCost
from planner.problem.default_appearance import default_appearance
from planner.problem.periodicity import Periodic
from planner.problem.problem import Problem
from planner.problem.recipe import Recipe

NAME = "mechanism and tracking cost"
_COST = ("Q", "R", "x_ref", "u_ref")
ARRAYS = (*_COST, "x0", "us")


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
    arrays = {name: getattr(problem.cost, name) for name in _COST} | {"x0": problem.x0, "us": problem.first_guess}
    arrays = {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()}
    return Recipe(NAME, facts), arrays


def unstorable_part(problem: Problem) -> str:
    """Text naming the first part of a problem without a recipe that a file cannot store; "" for none."""
    dynamics, twin = problem.dynamics, problem.twin
    if type(dynamics) is not RigidBodyDynamics:
        return f"its dynamics ({type(dynamics).__name__})"
    if type(problem.cost) is not TrackingCost:
        return f"its cost ({type(problem.cost).__name__})"
    if problem.requirements is not None:
        return "its own rule of success"
    if problem.constraints:
        return f"its constraints ({', '.join(one.name for one in problem.constraints)})"
    own = twin_of(dynamics.mechanism, dynamics.prescribed)
    if twin is None or any(getattr(twin, part) != getattr(own, part) for part in ("mjcf", "source", "curves")):
        return "its model in MuJoCo, which is not the mechanism's own"
    return ""


def from_arrays(facts: dict[str, Any], arrays: dict[str, np.ndarray], twin: Twin | None) -> Problem:
    """The problem that to_arrays() described."""
    missing = [name for name in ARRAYS if name not in arrays]
    if twin is None or missing:
        what = f"without {', '.join(missing)}" if missing else "without a model"
        raise PlannerError(f"its problem is {what}, expected {NAME} with {', '.join(ARRAYS)} and a model.")
    mechanism: Mechanism = read(twin.planned, assets=twin.assets).with_curves(twin.curves)
    mechanism = replace(mechanism, original=twin.original)
    prescribed = facts.get("prescribed", [])
    step: dict[str, Any] = {"integrator": facts.get("integrator"), "substeps": facts.get("substeps", 1)}
    dynamics = RigidBodyDynamics(mechanism, facts.get("dt"), prescribed=prescribed, **step)  # pyright: ignore
    cost = TrackingCost(*(arrays[name] for name in _COST), space=dynamics.space)
    return Problem(
        dynamics, cost, arrays["x0"], us=arrays["us"], twin=twin,
        appearance=default_appearance(mechanism, prescribed),
        periodic=Periodic.from_dict(facts["periodic"]) if facts.get("periodic") is not None else None,
    )  # fmt: skip
