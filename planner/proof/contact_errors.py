"""How far contacts put a replay off its path, where the plan's step explains little of it: no finer step helps then."""

from __future__ import annotations

from typing import NamedTuple

from planner.problem.rediscretize import step_error
from planner.proof.error_propagation import FACTOR, SMALL
from planner.proof.error_scales import SMOOTHED, has_contacts, is_path_judged, worst_by_unit
from planner.proof.verdict import Proof

FALLEN = 100.0  # bounds: a machine that has fallen open loop says nothing of its gains


class ContactError(NamedTuple):
    """The largest error of the path with gains, and what the step makes of it, both in bounds of the path."""

    off: float
    by_step: float


def contact_error(proof: Proof) -> ContactError | None:
    """The error that contacts make; None without them, or where it is small or the step's."""
    run = proof.replays["feedback"]
    if not has_contacts(run.plan):
        return None
    off = max(one.share for one in worst_by_unit(run.plan, run.error) if is_path_judged(run.plan, one.unit))
    by_step = step_error(run.plan) / SMOOTHED
    small = not (SMALL < off < FALLEN and off > FACTOR * by_step)  # another plan may bring it within its bound
    return None if small else ContactError(off, by_step)
