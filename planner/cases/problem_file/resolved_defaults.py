"""What a problem file left to be chosen: for each, the values and the reason."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.cases.problem_file.keys import RAMP, RESOLVED
from planner.cases.problem_file.states import carried_along
from planner.cases.problem_file.tasks import ResolvedTask, walking_weights, weights_of
from planner.dynamics import RigidBodyDynamics
from planner.problem.default_weights import default_weights
from planner.problem.limits import Limits
from planner.solvers.waypoints import WAYPOINTS


def with_resolved(
    table: dict[str, Any], dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, reasons: dict[str, str],
    way: ResolvedTask | None, limits: Limits | None, paths: np.ndarray | None, ramp: float | None,
) -> dict[str, Any]:  # fmt: skip
    """The table with what was chosen by itself: weights and their reasons. A stored plan has them already.

    `paths`: (nv,) rad or m, the way of each degree of freedom where feet step and no task says more; else None.
    """
    if RESOLVED in table:
        return table
    given = table["weights"]
    if way is not None:
        default = weights_of(table, dynamics, x0, way, limits)
    else:
        default = default_weights(
            dynamics, x0, goal, table["duration"], tolerance=table["tolerance"], named="objective" in table,
            stays="position" not in given, jerk=table.get("objective", {}).get("jerk", 0.0),
            displacement=paths, carried_along=carried_along(table["goal"], dynamics),
        )  # fmt: skip
        default = default if paths is None else walking_weights(default)
    filled = {name: weight.tolist() for name, weight in default.weights.items() if name not in given}
    reasons = reasons | {name: reason for name, reason in default.reasons.items() if name not in given}
    waypoints = {} if way is None or not way.waypoints else {WAYPOINTS: list(way.waypoints)}
    ramps = {} if ramp is None else {RAMP: ramp}
    return table | {RESOLVED: {"weights": {**filled, **given}, "reasons": reasons, **waypoints, **ramps}}


def resolved_defaults(parameters: Mapping[str, Any]) -> dict[str, str]:
    """A sentence for each thing that was chosen by itself, by its key; none for plans without a problem file."""
    resolved = parameters.get(RESOLVED, {})
    weights, reasons = resolved.get("weights", {}), resolved.get("reasons", {})
    return {
        f"weights.{name}" if name in weights else name: f"{_values(weights.get(name))}{reason}"
        for name, reason in reasons.items()
    }


def _values(weight: Any) -> str:
    """The range of the numbers of a weight, and ": "."""
    numbers = np.atleast_1d(np.asarray(weight, dtype=float)) if isinstance(weight, (list, float, int)) else np.empty(0)
    if not numbers.size or not np.any(numbers):
        return ""
    low, high = numbers.min(), numbers.max()
    return f"{low:.3g}: " if low == high else f"{low:.3g} to {high:.3g}: "
