"""A plan that swings its joints far away, because its cost asks for little effort and for nothing else.

Weights of velocities keep the way short, and final weights must then be large beside what the way costs. Both follow
from the smooth motion (diagnostics.min_jerk): its effort, its velocities, and how near to the goal the end must be.
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

MAX_EXCURSION = 1.0  # times the longest way of a joint: as far beyond start and goal, a plan swings
VELOCITY_SHARE = 10.0  # times the effort of the smooth motion: what its velocities are to cost
TARGET_SHARE = 0.25  # of what passes: the miss that final weights leave


def penalize_velocity(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Weights for a plan that swings beyond its whole way, where that leaves a range or the solve came to no end."""
    machine, cost = machine_of(problem), tracking_of(problem.cost)
    if machine is None or cost is None or not np.isfinite(plan.xs).all():
        return []
    q, ends = plan.xs[:, : machine.nq], np.stack([problem.x0[: machine.nq], cost.x_ref[-1][: machine.nq]])
    beyond = np.maximum(ends.min(axis=0) - q, q - ends.max(axis=0)).max(axis=0)
    worst, way = int(np.argmax(beyond)), float(np.abs(ends[1] - ends[0]).max())
    low, high = machine.joint_range[:, 0], machine.joint_range[:, 1]
    outside = bool(np.any((q < low) | (q > high)))
    if beyond[worst] <= MAX_EXCURSION * way or (plan.success and not outside):
        return []
    name = machine.joint_names[worst] or f"joint {worst}"
    return straightened(problem, "excursion", joint=name, excess=float(beyond[worst]))


def straightened(problem: Problem, code: str, **values: Any) -> list[SuggestedFix]:
    """Weights that make the way nearly straight; none where it is not known, or velocities cost something already."""
    machine, cost = machine_of(problem), tracking_of(problem.cost)
    if machine is None or cost is None or np.any(np.diagonal(cost.Q[0])[machine.nv :]):
        return []
    motion = smooth_motion(problem, machine, problem.duration)
    us = motion.controls(machine) - cost.u_ref
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
        if np.isfinite(least) and np.ptp(now) == 0.0:  # a miss of `least` is to cost as much as the way changes
            value[key] = max(rounded_up(2.0 * running / (scale * TARGET_SHARE * least)), float(now[0]))
    return [fix(problem, "weights", value, code, **values)]
