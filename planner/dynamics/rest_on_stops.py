"""Where closed chains come to rest against their stops, the driven joints held.

The free directions Z y of a chain (dynamics.assembly) that no actuator drives go where the energy of gravity, springs
and stops is least: Newton's method, whose steps are cut until the energy sinks (trapezoidal rule on the forces), or the
largest force does.
"""

from __future__ import annotations

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.algorithms import bias
from planner.dynamics.assembly import assembled, feasible_directions
from planner.dynamics.contacts import generalized_forces
from planner.model.mechanism import Mechanism

STEPS, HALVINGS = 100, 20
DIFFERENCE = 1e-6  # rad or m
LONGEST = 0.05  # rad or m
AT_REST = 1e-9  # N m or N, relative to the largest force on the way, and absolute


def rest_on_stops(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """The state (nx,) at rest nearest down the energy from x (nx,); x where no chain has a stop, or none is found."""
    if not (mechanism.has_closed_chains and any(stop.law.lead > 0.0 for stop in mechanism.stops)):
        return x
    try:
        found = _downhill(mechanism, x)
    except PlannerError:  # a step opens the chain
        found = None
    return x if found is None else found


def _downhill(mechanism: Mechanism, x: np.ndarray) -> np.ndarray | None:
    there, force = x.copy(), _uphill(mechanism, x)
    enough = AT_REST * max(1.0, float(np.abs(force).max(initial=0.0)))
    for _ in range(STEPS):
        if np.abs(force).max(initial=0.0) <= enough:
            return there
        near = [_uphill(mechanism, _moved(mechanism, there, DIFFERENCE * one)) for one in np.eye(len(force))]
        if any(len(one) != len(force) for one in near):  # where a chain is flat it moves in more directions
            return None
        slopes = (np.array(near) - force).T / DIFFERENCE
        values, vectors = np.linalg.eigh(0.5 * (slopes + slopes.T))
        step = -vectors @ (vectors.T @ force / np.maximum(np.abs(values), 1e-8 * np.abs(values).max()))
        step *= min(1.0, LONGEST / float(np.abs(step).max()))
        for _ in range(HALVINGS):
            candidate = _moved(mechanism, there, step)
            further = _uphill(mechanism, candidate)
            if len(further) != len(force):
                return None
            if step @ (force + further) < 0.0 or np.abs(further).max() < np.abs(force).max():
                break
            step = 0.5 * step
        else:
            return None
        there, force = candidate, further
    return None


def _free(mechanism: Mechanism, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (nv, n) in which chains move with the driven joints held, and their coordinates (n,)."""
    Z, leading = feasible_directions(mechanism, x[: mechanism.nq])
    loose = ~mechanism.directly_actuated[leading]
    return Z[:, loose], leading[loose]


def _uphill(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """Gradient (n,) of the energy along the free directions, N m and N."""
    q, still = x[: mechanism.nq], np.zeros(mechanism.nv)
    return _free(mechanism, x)[0].T @ (bias(mechanism, q, still) - generalized_forces(mechanism, q, still))


def _moved(mechanism: Mechanism, x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The state with free coordinates moved by a step (n,) and its chains closed again."""
    change = np.zeros(mechanism.space.ndx)
    Z, coordinates = _free(mechanism, x)
    change[: mechanism.nv] = Z @ step
    held = {*map(int, np.flatnonzero(mechanism.directly_actuated)), *map(int, coordinates)}
    return assembled(mechanism, mechanism.space.integrate(x, change), held)
