"""A problem of our own parts in a plan's file: a mechanism's dynamics and a tracking cost are numbers and an MJCF text.

What has a case or a problem.toml is rebuilt from its parameters instead. Any other dynamics or cost is its maker's
Python, which no file holds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.driven import twin_of
from planner.model.twin import Twin
from planner.problem.costs.tracking import TrackingCost
from planner.problem.default_appearance import default_appearance
from planner.problem.periodicity import Periodic
from planner.problem.problem import Problem

KIND = "mechanism and tracking cost"
DRIVEN = "mechanism with prescribed joints and tracking cost"
_COST = ("Q", "R", "x_ref", "u_ref")
PARTS = (*_COST, "x0", "us")


def stored(problem: Problem | None) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """What a file must hold of a problem: JSON values and arrays by name; None where that is not enough."""
    if problem is None or problem.case is not None or type(problem.cost) is not TrackingCost:
        return None
    dynamics, twin = problem.dynamics, problem.twin
    if type(dynamics) is not RigidBodyDynamics or problem.requirements is not None:
        return None
    own = twin_of(dynamics.mechanism, dynamics.prescribed)
    parts = ("mjcf", "source", "curves")  # where the file's model is not the mechanism's, it is no such problem
    if twin is None or any(getattr(twin, part) != getattr(own, part) for part in parts):
        return None
    arrays = {name: getattr(problem.cost, name) for name in _COST} | {"x0": problem.x0, "us": problem.first_guess}
    facts = {"kind": KIND, "dt": dynamics.dt, "integrator": dynamics.integrator}
    if dynamics.prescribed:
        facts |= {"kind": DRIVEN, "prescribed": list(dynamics.prescribed)}
    if problem.periodic is not None:
        facts["periodic"] = problem.periodic.to_dict()
    return facts, {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in arrays.items()}


def rebuilt(facts: dict[str, Any], arrays: dict[str, np.ndarray], twin: Twin | None) -> Problem:
    """The problem that stored() described.

    Raises:
        PlannerError: A part is missing or does not fit.
    """
    missing = [name for name in PARTS if name not in arrays]
    prescribed = facts.get("prescribed", []) if facts.get("kind") == DRIVEN else []
    if facts.get("kind") not in (KIND, DRIVEN) or twin is None or missing:
        what = f"without {', '.join(missing)}" if missing else f"of the kind {facts.get('kind')!r}"
        raise PlannerError(f"its problem is {what}, expected {KIND} with {', '.join(PARTS)} and a model.")
    from planner.model.mjcf.read import read  # the one module that needs MuJoCo's compiler

    mechanism: Mechanism = read(twin.planned, assets=twin.assets).with_curves(twin.curves)
    dynamics = RigidBodyDynamics(mechanism, facts.get("dt"), facts.get("integrator"), prescribed)  # pyright: ignore
    cost = TrackingCost(*(arrays[name] for name in _COST), space=dynamics.space)
    periodic = None if facts.get("periodic") is None else Periodic.from_dict(facts["periodic"])
    appearance = default_appearance(mechanism, prescribed)
    return Problem(
        dynamics, cost, arrays["x0"], us=arrays["us"], twin=twin, appearance=appearance, periodic=periodic
    )  # fmt: skip
