"""Find the stops and clamps that change a replay and that its plan does not know.

A plan whose limits are its model's own touches them exactly, and rounding is no fault: so what the plan itself asks for
has a tolerance of rounding. Gains correct what MuJoCo does otherwise than the plan, by a little everywhere: what they
ask for beyond a range counts only above a hundredth of it.

A clamp that bounds the controls of a plan is known to it. The plan must keep it, at the knots exactly and between them
to a hundredth, since the force of a servo changes while its control is held. What gains ask for beyond such a clamp
MuJoCo cuts off as the machine would: the motion that comes of it is judged, not the cut.
"""

from __future__ import annotations

import numpy as np

from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import named
from planner.proof.replays.ranges import Excess, efforts_in, joints_in, tendons_in
from planner.proof.replays.replaying import Replay, stopped_dofs

ROUNDING = 1e-6  # of a clamp's range, as far as the plan itself is concerned
OVERLAP = 1e-3  # of a joint's range: a plan that keeps its limits at the knots bulges out between them
LEANING = 1e-2  # rad or m: the margin of limits, within which a start or a goal is at the end of a range
CORRECTION = 1e-2  # of a range, of the replay with gains


def clamps_hit(run: Replay) -> list[str]:
    """Actuators that the plan, or with gains the replay, asks for more than they give, one sentence each."""
    model, twin, compiled = run.compiled.model, run.twin, run.compiled
    planned = compiled.commands(np.repeat(run.plan.us, run.substeps, axis=0))
    own = efforts_in(model, twin.sim_of(run.plan_xs), planned)
    replayed = efforts_in(model, _states(run), compiled.commands(run.ctrl))
    known, found = _known(run), []
    for planned, real in zip(own, replayed, strict=True):
        if planned.name in known:
            said = planned.sentence(run.t, CORRECTION * _scale(planned, planned))
        else:
            said = _sentence(run, planned, real, ROUNDING, 0.0)
        found += [said] if said else []
    return found


def _known(run: Replay) -> set[str]:
    """Names of the actuators and joints whose clamps in the model bound the plan's controls."""
    problem, model = run.plan.problem, run.compiled.model
    mechanism = getattr(getattr(problem, "dynamics", None), "mechanism", None)
    limits = getattr(problem, "limits", None)
    if not isinstance(mechanism, Mechanism) or limits is None or not limits.keeps_clamps:
        return set()
    free = limits.without_clamps(mechanism)
    moment, places = mechanism.actuators.moment, np.arange(model.nu)[run.compiled.controls]
    held, unheld = (
        np.any(moment[[a for a in range(mechanism.nu) if (a in free) == out]], axis=0) for out in (False, True)
    )
    joints = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    alone = {name for name, links in joints if np.any(held[links]) and not np.any(unheld[links])}
    kept = {named(model, "actuator", int(places[a])) for a in range(mechanism.nu) if a not in free}
    return kept | {named(model, "joint", j) for j in range(model.njnt) if model.joint(j).name in alone - {""}}


def stops_hit(run: Replay) -> list[str]:
    """Joints and tendons that the plan, or the replay, moves beyond a range that has no stop in it, in sentences."""
    model, stopped, limits = run.compiled.model, stopped_dofs(run.plan), getattr(run.plan.problem, "limits", None)
    own, replayed = (
        [*joints_in(model, w, stopped), *tendons_in(model, w)] for w in (run.twin.sim_of(run.plan_xs), _states(run))
    )
    tolerance, found = 0.0 if limits is None else limits.tolerance, []
    for planned, real in zip(own, replayed, strict=True):
        # MuJoCo's stops are soft: a joint that begins or ends at one leans on it, which is what it is asked to do.
        leans = limits is not None and limits.position is not None and bool(_at_end(planned).any())
        said = _sentence(run, planned, real, OVERLAP, tolerance + LEANING * leans)
        found += [said] if said else []
    return found


def _at_end(planned: Excess) -> np.ndarray:
    """Whether the plan begins, and ends, at an end of a range."""
    values = planned.values[[0, -1]]
    return np.abs(values[:, None] - np.asarray(planned.range)).min(axis=1) <= LEANING


def _states(run: Replay) -> np.ndarray:
    return np.concatenate([run.qpos, run.qvel, run.act], axis=1)


def _sentence(run: Replay, planned: Excess, real: Excess, part: float, least: float) -> str:
    scale = _scale(planned, real)
    return planned.sentence(run.t, least + part * scale) or real.sentence(run.t, least + CORRECTION * scale)


def _scale(planned: Excess, real: Excess) -> float:
    """The width of a range, or the largest value that there is in a range that is wider than that."""
    used = np.abs(np.concatenate([planned.values, real.values]))
    return min(float(np.ptp(planned.range)), float(np.nanmax(used, initial=0.0)))
