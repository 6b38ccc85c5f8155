"""Start and goal of a problem file on the ground, for settle = true, or where settle = "auto" finds them near it."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import shown
from planner.base.errors import PlannerError
from planner.dynamics.statics import clearance, settled
from planner.model.mechanism import Mechanism

IN_THE_AIR = 0.05  # m above the ground: files put feet down to some centimetres


def on_ground(
    mechanism: Mechanism, start: np.ndarray, goal: np.ndarray, settle: Any, stands: bool
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Start and goal (nx,) as they are planned, and sentences about what was done to them.

    With settle = "auto" nothing is done unless the machine `stands` on a ground; what moves, and what is in the air,
    stays so.

    Raises:
        PlannerError: settle is none of true, false and "auto"; true, and a pose does not stay on the ground.
    """
    if not (isinstance(settle, bool) or settle == "auto"):
        raise PlannerError(f"settle is {shown(settle)}, expected true, false or 'auto'.")
    if settle is False or (settle == "auto" and not stands):
        return start, goal, ()
    states, notes = [], []
    for name, x in (("start", start), ("goal", goal)):
        states.append(x)
        moves = bool(np.any(x[mechanism.nq : mechanism.nq + mechanism.nv]))
        height = clearance(mechanism, x) if settle == "auto" else 0.0
        if settle == "auto" and (moves or height > IN_THE_AIR):
            why = "it moves" if moves else f"it is {height:.3g} m above the ground; settle = true puts it down"
            notes.append(f"{name} stays as it is: {why}.")
            continue
        try:
            states[-1] = settled(mechanism, x)
        except PlannerError as error:
            if settle is True:
                raise PlannerError(f"settle of {name}: {error}") from None
            notes.append(f"{name} is not settled: {error}")
        else:
            way = float(np.abs(mechanism.space.difference(states[-1], x)).max())
            if way > 1e-3:
                notes.append(f"{name} is put on the ground, which moves it by up to {way:.2g} m or rad.")
    return states[0], states[1], tuple(notes)
