"""Where closed chains come to rest against their stops, the driven joints held.

The directions of a chain (dynamics.assembly) that no actuator drives go where the energy of gravity, springs and stops
is least: Newton's method, whose steps are cut until the energy sinks (trapezoidal rule on the forces), or the largest
force does.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.algorithms import bias
from planner.dynamics.assembly import assembled, closed_chains, feasible_directions
from planner.dynamics.contacts import generalized_forces, stop_depth
from planner.dynamics.resting_poses import newton_step
from planner.model.mechanism import Mechanism

STEPS, HALVINGS = 100, 20
DIFFERENCE = 1e-6  # rad or m
LONGEST = 0.05  # rad or m
AT_REST, ROUNDING = 1e-9, 1e-5  # of the first force, N m or N, or of 1; the latter where no step brings less


def rest_on_stops(mechanism: Mechanism, x: np.ndarray, given: Collection[int] = ()) -> np.ndarray:
    """The state (nx,) nearest down the energy from x (nx,) at which chains rest on stops that press on them.

    A chain stays as it is in x where it has no stop with a lead or comes to rest on none, where none is found, and
    where one of its undriven degrees of freedom is in `given`.
    """
    stopped = [stop.dof for stop in mechanism.stops if stop.law.lead > 0.0]
    for chain in closed_chains(mechanism) if stopped else ():
        loose = chain & ~mechanism.directly_actuated
        if not chain[stopped].any() or any(loose[dof] for dof in given):
            continue
        try:
            found = _downhill(mechanism, x, chain)
        except PlannerError:  # a step opens the chain
            continue
        if found is not None and (leaning_dofs(mechanism, found[None]) & chain).any():
            x = found
    return x


def leaning_dofs(mechanism: Mechanism, xs: np.ndarray) -> np.ndarray:
    """(nv,) bool, degrees of freedom that a stop with a lead presses on at all states xs (K, nx)."""
    found = np.zeros(mechanism.nv, dtype=bool)
    for stop in mechanism.stops:
        found[stop.dof] |= bool(stop.law.lead > 0.0 and np.all(stop_depth(mechanism, stop, xs) > 0.0))
    return found


def _downhill(mechanism: Mechanism, x: np.ndarray, chain: np.ndarray) -> np.ndarray | None:
    """The state (nx,) at which the forces along a chain's free directions vanish; None where none is found."""
    there, force = x.copy(), _uphill(mechanism, x, chain)
    scale = max(1.0, float(np.abs(force).max(initial=0.0)))
    for _ in range(STEPS):
        if np.abs(force).max(initial=0.0) <= AT_REST * scale:
            return there
        near = [
            _uphill(mechanism, _moved(mechanism, there, DIFFERENCE * one, chain), chain) for one in np.eye(len(force))
        ]
        if any(len(one) != len(force) for one in near):  # where a chain is flat it moves in more directions
            return None
        slopes = (np.array(near) - force).T / DIFFERENCE
        step = newton_step(slopes, force, LONGEST)
        for _ in range(HALVINGS):
            candidate = _moved(mechanism, there, step, chain)
            further = _uphill(mechanism, candidate, chain)
            if len(further) != len(force):
                return None
            if step @ (force + further) < 0.0 or np.abs(further).max() < np.abs(force).max():
                break
            step = 0.5 * step
        else:
            return there if np.abs(force).max() <= ROUNDING * scale else None
        there, force = candidate, further
    return None


def _free(mechanism: Mechanism, x: np.ndarray, chain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (nv, n) in which a chain moves with the driven joints held, and their coordinates (n,)."""
    Z, leading = feasible_directions(mechanism, x[: mechanism.nq])
    loose = chain[leading] & ~mechanism.directly_actuated[leading]
    return Z[:, loose], leading[loose]


def _uphill(mechanism: Mechanism, x: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """Gradient (n,) of the energy along the free directions, N m and N."""
    q, still = x[: mechanism.nq], np.zeros(mechanism.nv)
    return _free(mechanism, x, chain)[0].T @ (bias(mechanism, q, still) - generalized_forces(mechanism, q, still))


def _moved(mechanism: Mechanism, x: np.ndarray, step: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """The state with free coordinates moved by a step (n,) and its chains closed again."""
    change = np.zeros(mechanism.space.ndx)
    Z, coordinates = _free(mechanism, x, chain)
    change[: mechanism.nv] = Z @ step
    held = {*map(int, np.flatnonzero(mechanism.directly_actuated)), *map(int, coordinates)}
    return assembled(mechanism, mechanism.space.integrate(x, change), held)
