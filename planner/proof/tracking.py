"""Steps 3 and 4 of a proof: whether MuJoCo at a refined step repeats the plan, and whether it gets to the goal.

Both by the machine's own rules or by the general ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.base.measured import Measured, Section
from planner.model.mechanism import Mechanism
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.proof.replaying import Replay
from planner.proof.scales import COST_BOUND, STATE_BOUND, cost_scale, limit_violations

_NO_RANGES = "of joints, controls and forces: a plan knows none, MuJoCo holds them"
_LARGEST = "largest component, rad, m, rad/s, m/s"


def tracking(run: Replay, problem: Problem) -> Section:
    """Compare one replay with the plan."""
    common = (
        Measured("simulator_warnings", float(len(run.warnings)), "", 0.0, " ".join(run.warnings)),
        Measured("ranges_reached", float(len(run.reached)), "", None, " ".join(run.reached) or _NO_RANGES),
        *limit_violations(problem, run.xs[:: run.substeps], _controls(run), "of the replay", judged=False),
    )  # fmt: skip
    if problem.requirements is not None and problem.requirements.tracking is not None:
        section = problem.requirements.tracking(run)
        return replace(section, measured=(*section.measured, *common))
    error = np.abs(run.error)
    with np.errstate(all="ignore"):
        cost = 100.0 * abs(run.cost - run.plan.cost) / cost_scale(run.plan, problem)
    judged = (
        Measured("end_state_error", float(error[-1].max()), "", STATE_BOUND, _LARGEST),
        Measured("cost_error", cost, "%", COST_BOUND, "cost reached in MuJoCo against the plan's"),
    )
    return Section(run.title, (*judged, *common, *_along_the_path(error, problem)))


def _controls(run: Replay) -> np.ndarray | None:
    """(N, nu) the controls at the knots, where they are of the plan's machine."""
    return run.ctrl[:: run.substeps] if run.ctrl.shape[1] == run.plan.us.shape[1] else None


def _along_the_path(error: np.ndarray, problem: Problem) -> tuple[Measured, ...]:
    """The largest errors over the whole replay, by kind where the plan's states are a mechanism's."""
    mechanism = getattr(problem.dynamics, "mechanism", None)
    if not isinstance(mechanism, Mechanism):
        return (Measured("largest_state_error", float(error.max()), "", None, "over the path, largest component"),)
    turns, nv = np.any(mechanism.S[:, :3] != 0.0, axis=1), mechanism.nv
    kinds = {
        "largest_angle_error": (error[:, :nv][:, turns], "rad"),
        "largest_distance_error": (error[:, :nv][:, ~turns], "m"),
        "largest_angular_velocity_error": (error[:, nv : 2 * nv][:, turns], "rad/s"),
        "largest_velocity_error": (error[:, nv : 2 * nv][:, ~turns], "m/s"),
    }
    return tuple(
        Measured(name, float(values.max()), unit, None, "over the path") for name, (values, unit) in kinds.items()
        if values.size
    )  # fmt: skip


def costs_with_goals(problem: Problem) -> list[TrackingCost]:
    """The terms of a problem's cost with a final weight, and so with a goal state."""
    costs = getattr(problem.cost, "costs", (problem.cost,))
    return [cost for cost in costs if isinstance(cost, TrackingCost) and np.any(cost.Q[-1])]


def goal(run: Replay, problem: Problem) -> Section:
    """Judge one replay's end by the machine's own rule, or show how far from the cost's goal it is."""
    if problem.requirements is not None and problem.requirements.goal is not None:
        return problem.requirements.goal(run)
    wanted = costs_with_goals(problem)
    if not wanted:
        return Section("goal", not_applicable="the problem states no goal apart from its cost")

    def distance(x: np.ndarray) -> float:
        errors = (np.abs(run.plan.space.difference(x, c.x_ref[-1]))[np.any(c.Q[-1], axis=0)].max() for c in wanted)
        return float(max(errors))

    note = "largest component that the cost's final weight acts on, against its reference; shown, not judged"
    errors = {"planned_goal_error": run.plan.xs[-1], "replayed_goal_error": run.xs[-1]}
    return Section("goal", tuple(Measured(name, distance(x), "", None, note) for name, x in errors.items()))
