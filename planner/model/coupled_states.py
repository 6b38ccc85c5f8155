"""States of a machine with couplings: close them, or say by how much they are not on the couplings."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from planner.base.errors import PlannerError
from planner.model.couplings import CLOSED, Reduction, reduce
from planner.model.mechanism import Mechanism


def closed_state(mechanism: Mechanism, x: np.ndarray, given: Collection[int] = ()) -> np.ndarray:
    """The state (nx,) with the coordinates that follow others where these put them.

    Degrees of freedom that are `given` stay where they are, even if they contradict a coupling: see check_closed.
    """
    reduction = _reduction(mechanism, given)
    if reduction is None:
        return x.copy()
    closed, stay = _closed(mechanism, reduction, x), mechanism.q_address[np.array([*given], dtype=int)]
    closed[stay] = x[stay]
    return closed


def _reduction(mechanism: Mechanism, given: Collection[int]) -> Reduction | None:
    if mechanism.reduction is None or not given:
        return mechanism.reduction
    keep = np.zeros(mechanism.nv, dtype=bool)
    keep[list(given)] = True
    return reduce(mechanism.couplings, mechanism.nv, keep)


def _closed(mechanism: Mechanism, reduction: Reduction, x: np.ndarray) -> np.ndarray:
    q, qd, act = np.split(x, [mechanism.nq, mechanism.nq + mechanism.nv])
    return np.concatenate([*reduction.closed(q, qd, mechanism.q_address), act])


def check_closed(name: str, x: np.ndarray, mechanism: Mechanism, most: float = CLOSED) -> None:
    """Raise a PlannerError with the value to write, unless a state (nx,) misses no coupling by more than `most`."""
    if mechanism.reduction is None:
        return
    dependent, nq = mechanism.reduction.dependent, mechanism.nq
    at = np.concatenate([mechanism.q_address[dependent], nq + dependent])
    wanted, given = _closed(mechanism, mechanism.reduction, x)[at], x[at]
    missed = np.abs(wanted - given)
    if np.all(missed <= most):
        return
    worst = int(np.nanargmax(missed))
    dof = int(dependent[worst % len(dependent)])
    others = [mechanism.joint_of(int(i)) for i in mechanism.reduction.independent[_followed(mechanism, dof)]]
    turns = bool(np.any(mechanism.S[dof, :3] != 0.0))
    unit = ("rad" if turns else "m") + ("/s" if worst >= len(dependent) else "")
    what = "velocity" if worst >= len(dependent) else "position"
    why = f"follows {' and '.join(others)}" if others else "is locked"
    raise PlannerError(
        f"{name} has the {what} {given[worst]:.6g} {unit} of {mechanism.joint_of(dof)}, which {why}: expected "
        f"{wanted[worst]:.9g}, {missed[worst]:.3g} {unit} away."
    )


def _followed(mechanism: Mechanism, dof: int) -> np.ndarray:
    assert mechanism.reduction is not None  # who asks has couplings
    return np.flatnonzero(mechanism.reduction.G[dof])
