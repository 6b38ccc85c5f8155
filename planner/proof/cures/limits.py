"""Ranges of joints and actuators that the plan goes beyond, because it does not know them or keeps too near to them."""

from __future__ import annotations

import numpy as np

from planner.model.mjcf.survey import disabled
from planner.problem.limits import MODEL
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.cures.cure import Cure, cure, rounded_up
from planner.proof.replays.limits_hit import OVERLAP, ROUNDING
from planner.proof.replays.ranges import Excess, efforts_in, joints_in
from planner.proof.replays.replaying import Replay, stopped_dofs
from planner.proof.verdict import Proof

ASIDE = 1.5  # times what a joint was beyond its range


def within_limits(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """The limits that the plan is to know, or a wider margin where it knows them."""
    if proof is None:
        return []
    return [*_joints(plan, problem, proof), *_efforts(plan, problem, proof.replay)]


def _joints(plan: Plan, problem: Problem, proof: Proof) -> list[Cure]:
    run = proof.replay
    if not _fails(proof, "unknown_stops") and not _fails_range(proof):
        return []
    stopped, model = stopped_dofs(plan), run.compiled.model
    if disabled(model, "constraint", "limit"):
        return []
    limits = problem.limits
    unknown = limits is None or limits.position is None
    own = list(joints_in(model, run.twin.sim_of(run.plan_xs), stopped))
    found = [one for one in own if one.beyond.max() > OVERLAP * np.ptp(one.range)]
    if unknown and found:
        worst = max(found, key=lambda one: one.beyond.max() / np.ptp(one.range))
        return [cure(problem, "limits.position", MODEL, f"the plan does not know that {_excess(worst, run.t)}")]
    states = np.concatenate([run.qpos, run.qvel, run.act], axis=1)
    replayed = list(joints_in(model, states, stopped))
    worst = max(own + replayed, key=lambda one: one.beyond.max(), default=None)
    if worst is None or worst.beyond.max() <= 0.0 or not np.isfinite(states).all():
        return []
    margin = getattr(limits, "margin", None)
    value = rounded_up((margin if isinstance(margin, (int, float)) else 0.0) + ASIDE * float(worst.beyond.max()))
    return [cure(problem, "limits.margin", value, f"{_excess(worst, run.t)}, between the knots or in MuJoCo")]


def _efforts(plan: Plan, problem: Problem, run: Replay) -> list[Cure]:
    limits = problem.limits
    if limits is not None and limits.control is not None:
        return []
    planned = run.compiled.commands(np.repeat(plan.us, run.substeps, axis=0))
    own = list(efforts_in(run.compiled.model, run.twin.sim_of(run.plan_xs), planned))
    beyond = [one for one in own if one.beyond.max() > ROUNDING * min(np.ptp(one.range), np.abs(one.values).max())]
    if not beyond:
        return []
    worst = max(beyond, key=lambda one: one.beyond.max() / np.ptp(one.range))
    low, high = worst.range
    most = float(worst.values[np.argmax(worst.beyond)])
    why = f"{worst.name} {worst.what}: {most:.3g} of {low:.3g} to {high:.3g}"
    return [cure(problem, "limits.control", MODEL, why)]


def _excess(one: Excess, t: np.ndarray) -> str:
    """The range and how far beyond it a joint goes, for a sentence."""
    last = int(np.argmax(one.beyond))
    side = one.range[0] if one.values[last] < one.range[0] else one.range[1]
    when = t[min(last, len(t) - 1)]
    return f"{one.name} goes {one.beyond.max():.3g} {one.unit} beyond {side:.4g} {one.unit} at t = {when:.3g} s"


def _fails(proof: Proof, name: str) -> bool:
    return any(one.name == name for one in proof.your_file.failures)


def _fails_range(proof: Proof) -> bool:
    judged = (proof.refined_open_loop, proof.refined_feedback)
    return proof.mode is None and any(
        one.name == "position_range_violation" for section in judged for one in section.failures
    )
