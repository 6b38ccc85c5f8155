"""Diagnose a plan with joint excursions far outside start and goal, because its cost only penalizes effort.

Velocity weights keep the path short, and final weights must then be large relative to the path's cost. Both follow
from the minimum-jerk trajectory (diagnostics.min_jerk): its effort, velocities, and the tolerance of the goal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import goals_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.diagnostics.min_jerk import machine_of, smooth_motion
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, rounded_up
from planner.proof.verdict import Proof

MAX_EXCURSION = 1.0  # largest excursion outside start and goal, relative to the largest joint displacement
VELOCITY_SHARE = 10.0  # cost of the minimum-jerk trajectory's velocities relative to its effort
TARGET_SHARE = 0.25  # of the tolerance: the final error to aim at


def penalize_velocity(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Weights for a plan with a large excursion, where it leaves a joint range or the solve did not converge."""
    machine, cost = machine_of(problem), tracking_of(problem.cost)
    if machine is None or cost is None or not np.isfinite(plan.xs).all():
        return []
    q, ends = plan.xs[:, : machine.nq], np.stack([problem.x0[: machine.nq], cost.x_ref[-1][: machine.nq]])
    beyond = np.maximum(ends.min(axis=0) - q, q - ends.max(axis=0)).max(axis=0)
    worst, way = int(np.argmax(beyond)), float(np.abs(ends[1] - ends[0]).max())
    low, high = machine.joint_range[:, 0], machine.joint_range[:, 1]
    outside = bool(np.any((q < low) | (q > high)))
    if beyond[worst] <= MAX_EXCURSION * way or (plan.converged and not outside):
        return []
    name = machine.joint_names[worst] or f"joint {worst}"
    return straightened(problem, "excursion", joint=name, excess=float(beyond[worst]))


def straightened(problem: Problem, code: str, **values: Any) -> list[SuggestedFix]:
    """Weights for a nearly straight path; none without a minimum-jerk trajectory, or with velocity weights already."""
    machine, cost = machine_of(problem), tracking_of(problem.cost)
    if machine is None or cost is None or np.any(np.diagonal(cost.Q[0])[machine.nv :]):
        return []
    motion = smooth_motion(problem, machine, problem.duration)
    us = motion.controls - cost.u_ref
    effort = 0.5 * float(np.einsum("ni,nij,nj->", us, cost.R, us))
    speeds = 0.5 * float(np.sum(motion.qd**2)) * problem.dynamics.dt
    if speeds == 0.0 or effort == 0.0:
        return []
    value = {"velocity": rounded_up(VELOCITY_SHARE * effort / speeds)}
    running = (1.0 + VELOCITY_SHARE) * effort
    own = np.diagonal(cost.Q[-1])
    scales = {
        "final_position": (float(np.abs(motion.q - problem.x0[: machine.nq]).max()), own[: machine.nv]),
        "final_velocity": (float(np.abs(motion.qd).max()), own[machine.nv : 2 * machine.nv]),
    }
    for key, (scale, now) in scales.items():
        passing = [one.tolerance for one in goals_of(problem) if one.unit.endswith("/s") == key.endswith("velocity")]
        least = min(passing, default=np.inf)
        if np.isfinite(least) and np.ptp(now) == 0.0:  # a final error of `least` is to cost as much as the path's cost
            value[key] = max(rounded_up(2.0 * running / (scale * TARGET_SHARE * least)), float(now[0]))
    return [fix(problem, "weights", value, code, **values)]
