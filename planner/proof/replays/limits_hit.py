"""Find the stops and clamps that change a replay and that its plan does not know.

A plan whose limits are its model's own touches them exactly, and rounding is no fault: so what the plan itself asks for
has a tolerance of rounding. Gains correct what MuJoCo does otherwise than the plan, by a little everywhere: what they
ask for beyond a range counts only above a hundredth of it.
"""

from __future__ import annotations

import numpy as np

from planner.proof.replays.ranges import Excess, efforts_in, joints_in, tendons_in
from planner.proof.replays.replaying import Replay, stopped_dofs

ROUNDING = 1e-6  # of a clamp's range, as far as the plan itself is concerned
OVERLAP = 1e-3  # of a joint's range: a plan that keeps its limits at the knots bulges out between them
CORRECTION = 1e-2  # of a range, of the replay with gains


def clamps_hit(run: Replay) -> list[str]:
    """Actuators that the plan, or with gains the replay, asks for more than they give, one sentence each."""
    model, twin, compiled = run.compiled.model, run.twin, run.compiled
    planned = compiled.commands(np.repeat(run.plan.us, run.substeps, axis=0))
    own = efforts_in(model, twin.sim_of(run.plan_xs), planned)
    replayed = efforts_in(model, _states(run), compiled.commands(run.ctrl))
    return _sentences(run, list(own), list(replayed), ROUNDING, 0.0)


def stops_hit(run: Replay) -> list[str]:
    """Joints and tendons that the plan, or the replay, moves beyond a range that has no stop in it, in sentences."""
    model, stopped, limits = run.compiled.model, stopped_dofs(run.plan), getattr(run.plan.problem, "limits", None)
    own, replayed = (
        [*joints_in(model, w, stopped), *tendons_in(model, w)] for w in (run.twin.sim_of(run.plan_xs), _states(run))
    )
    return _sentences(run, own, replayed, OVERLAP, 0.0 if limits is None else limits.tolerance)


def _states(run: Replay) -> np.ndarray:
    return np.concatenate([run.qpos, run.qvel, run.act], axis=1)


def _sentences(run: Replay, own: list[Excess], replayed: list[Excess], part: float, least: float) -> list[str]:
    """A sentence for each range that the plan exceeds by a part of it and `least`, or the replay by CORRECTION."""
    found = []
    for planned, real in zip(own, replayed, strict=True):
        scale = _scale(planned, real)
        said = planned.sentence(run.t, least + part * scale) or real.sentence(run.t, CORRECTION * scale)
        found += [said] if said else []
    return found


def _scale(planned: Excess, real: Excess) -> float:
    """The width of a range, or the largest value that there is in a range that is wider than that."""
    used = np.abs(np.concatenate([planned.values, real.values]))
    return min(float(np.ptp(planned.range)), float(np.nanmax(used, initial=0.0)))
