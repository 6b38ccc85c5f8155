"""Clamps and stops of the user's file that a replay reaches, or a plan beyond its own limits.

A plan with the model's ranges as limits reaches them exactly, so the plan itself has a tolerance of rounding, and its
gains' request beyond a range counts only above a hundredth of it. A clamp that bounds the plan's controls is a bound of
the plan: it must be satisfied exactly at the knots and to a hundredth between them, since a servo's force changes while
its control is constant. MuJoCo clamps the gains' request beyond it as the machine would: the resulting trajectory is
judged, not the request.
"""

from __future__ import annotations

import numpy as np

from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import named
from planner.proof.replays.ranges import Excess, efforts_in, joints_in, tendons_in
from planner.proof.replays.replaying import Replay, stopped_dofs

ROUNDING = 1e-6  # of a clamp's range, tolerance of the plan itself
OVERLAP = 1e-3  # of a joint's range: tolerance of the plan between knots, where limits do not apply
LEANING = 1e-2  # rad or m: margin of limits; a start or goal within it is at the end of a range
CORRECTION = 1e-2  # of a range, tolerance of the replay with gains


def clamps_hit(run: Replay) -> list[str]:
    """Actuators whose requested effort, of the plan or with gains of the replay, exceeds a clamp, a sentence each."""
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
    acts_on, places = mechanism.actuators.acts_on, np.arange(model.nu)[run.compiled.controls]
    held, unheld = (
        np.any(acts_on[[a for a in range(mechanism.nu) if (a in free) == out]], axis=0) for out in (False, True)
    )
    joints = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    alone = {name for name, links in joints if np.any(held[links]) and not np.any(unheld[links])}
    kept = {named(model, "actuator", int(places[a])) for a in range(mechanism.nu) if a not in free}
    return kept | {named(model, "joint", j) for j in range(model.njnt) if model.joint(j).name in alone - {""}}


def stops_hit(run: Replay) -> list[str]:
    """Joints and tendons that the plan, or the replay, moves outside a range without a modelled stop, in sentences."""
    found = []
    for planned, real, least in _stops(run):
        said = _sentence(run, planned, real, OVERLAP, least)
        found += [said] if said else []
    return found


def stop_excess(run: Replay, wider: float = 1.0) -> tuple[Excess, float] | None:
    """The joint or tendon that the replay moves farthest beyond a range without a modelled stop, and what passes.

    Farthest as a multiple of what passes: of a stop, CORRECTION of its range as for a replay with gains, `wider` times
    that. None where nothing has such a range.
    """
    found = [(real, least + wider * CORRECTION * _scale(planned, real)) for planned, real, least in _stops(run)]
    return max(found, key=lambda one: one[0].beyond.max(initial=0.0) / max(one[1], ROUNDING), default=None)


def _stops(run: Replay) -> list[tuple[Excess, Excess, float]]:
    """Ranges without a modelled stop along the plan and the replay, and the excess that the plan's limits allow."""
    model, stopped, limits = run.compiled.model, stopped_dofs(run.plan), getattr(run.plan.problem, "limits", None)
    own, replayed = (
        [*joints_in(model, w, stopped), *tendons_in(model, w)] for w in (run.twin.sim_of(run.plan_xs), _states(run))
    )
    tolerance, found = 0.0 if limits is None else limits.tolerance, []
    for planned, real in zip(own, replayed, strict=True):
        # MuJoCo's stops are soft: a joint that starts or ends at its stop penetrates it, as the problem requires.
        leans = limits is not None and limits.position is not None and bool(_at_end(planned).any())
        found.append((planned, real, tolerance + LEANING * leans))
    return found


def largest_excess(run: Replay) -> Excess | None:
    """The joint that the replay moves farthest beyond a range without a modelled stop; None where none is."""
    found = [
        one for one in joints_in(run.compiled.model, _states(run), stopped_dofs(run.plan)) if one.beyond.max() > 0.0
    ]
    return max(found, key=lambda one: one.beyond.max(), default=None)


def _at_end(planned: Excess) -> np.ndarray:
    """Whether the plan starts, and ends, at an end of a range."""
    values = planned.values[[0, -1]]
    return np.abs(values[:, None] - np.asarray(planned.range)).min(axis=1) <= LEANING


def _states(run: Replay) -> np.ndarray:
    return np.concatenate([run.qpos, run.qvel, run.act], axis=1)


def _sentence(run: Replay, planned: Excess, real: Excess, part: float, least: float) -> str:
    scale = _scale(planned, real)
    return planned.sentence(run.t, least + part * scale) or real.sentence(run.t, least + CORRECTION * scale)


def _scale(planned: Excess, real: Excess) -> float:
    """The width of a range, or the largest magnitude in it if that is smaller; of a joint at most 1 rad or 1 m."""
    used = np.abs(np.concatenate([planned.values, real.values]))
    most = 1.0 if planned.unit else np.inf  # however many turns or metres a joint has
    return min(float(np.ptp(planned.range)), float(np.nanmax(used, initial=0.0)), most)
