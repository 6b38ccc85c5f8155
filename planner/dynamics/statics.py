"""A machine at rest on the ground: the pose in which the ground carries it, and what its actuators have to hold there.

At rest the bias force of a pose (gravity and springs) is that of actuators, contacts and stops together,

    bias(q, 0) = B u + sum_k J_k' f_k + stops,

of which the law of model.contact.laws gives f_k by how deep contact k is. `settled` moves a pose by what no actuator
drives until this holds in the rows of what it moved: downhill in potential energy, as the machine itself would if its
motors were locked. `supported` asks what u does it in a pose that need not be so exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.contacts import contact_forces, contact_jacobians
from planner.dynamics.kinematics import jacobian
from planner.dynamics.momentum import center_of_mass
from planner.dynamics.quasi_static import weight
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.capabilities import roots, unactuated_basis
from planner.model.mechanism import Frame, Mechanism

STEPS = 200
FIRST_STEP, LONGEST_STEP = 0.02, 0.2  # m or rad, downhill: contacts come and go within millimetres
SHORTEST_STEP = 1e-9  # m or rad: what cannot go downhill by as much does not rest
MAX_SHIFT = 0.5  # m or rad, from the pose that was asked for: what moved as far has fallen over
AT_REST = 1e-9  # of the weight: what is left of it
FLAT = 1e-6  # of the largest, m or rad per m or rad: how little a motion along the ground may lift or tilt
DIFFERENCE = 1e-6  # m or rad, for slopes of forces, on which only the number of steps depends
MANY = 20  # contacts that tell which way is up
UPWARDS = 0.8  # of a plane's normal, against gravity: less is a wall


def static_equilibrium(mechanism: Mechanism, x: Any) -> np.ndarray:
    """The rest state near a pose: the ground carries the machine and its driven joints do not move.

    What no actuator drives (the place of a free trunk, a passive joint) goes downhill from the height at which the
    lowest contact touches; along the ground nothing moves it.

    Args:
        mechanism: With contacts.
        x: (nx,) or (nq,), the pose; its velocities are left out and its activations stay.

    Returns:
        (nx,).

    Raises:
        PlannerError: No contacts, or nothing to move; the pose tips over.
    """
    space, nq, nv = mechanism.space, mechanism.nq, mechanism.nv
    x = np.array(x, dtype=float) if np.shape(x) == (space.nx,) else np.concatenate(
        [array("x", x, (nq,)), np.zeros(space.nx - nq)]
    )  # fmt: skip
    x = array("x", x, (space.nx,))
    x[nq : nq + nv] = 0.0
    if not mechanism.contacts:
        raise PlannerError(
            "the mechanism has no contacts, expected some: Mechanism.from_mjcf(..., contacts=ContactLaw(...))."
        )
    free = unactuated_basis(mechanism)
    if not free.shape[1]:
        raise PlannerError("every joint is driven, expected some that are not: the ground carries nothing here.")
    start = lowered_to_ground(mechanism, x)
    x, rests = _downhill(mechanism, start, free)
    if rests:
        return x
    ground = contact_forces(mechanism, start[:nq], np.zeros(nv))
    centre, lowest = center_of_mass(mechanism, start[:nq]), ground.points[np.argsort(-ground.depths)[:2]]
    raise PlannerError(
        f"the pose does not stay on the ground: its centre of mass is at {_at(centre)} and its lowest contacts at "
        f"{_at(lowest[0])} and {_at(lowest[-1])} (x, y in m), expected driven joints that bring it over them."
    )


def lowered_to_ground(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """A pose (nx,) moved along the ground's normals until the lowest contact of each tree sinks in by its weight.

    Raises:
        PlannerError: No tree with contacts moves up and down as a whole.
    """
    q, free, root = x[: mechanism.nq], unactuated_basis(mechanism), roots(mechanism)
    g = float(np.linalg.norm(mechanism.gravity))
    normals = np.array([contact.plane.normal for contact in mechanism.contacts])
    up = -mechanism.gravity / g if g > 0.0 else np.zeros(3)
    links = np.array([contact.link for contact in mechanism.contacts])
    grounds = normals @ up > UPWARDS if np.any(normals @ up > UPWARDS) else np.ones(len(normals), dtype=bool)
    depths, moves = contact_forces(mechanism, q, np.zeros(mechanism.nv)).depths, 0
    for first in np.unique(root[links[grounds]]):
        own, ways = np.flatnonzero(grounds & (root[links] == first)), free[:, np.any(free[root == first], axis=0)]
        some = own[np.argsort(-depths[own])[:MANY]]
        rise = np.einsum("ka,kaj->kj", normals[some], contact_jacobians(mechanism, q, some)) @ ways
        along = np.linalg.lstsq(rise, np.ones(len(rise)), rcond=None)[0] if ways.shape[1] else np.zeros(0)
        if not np.allclose(rise @ along, 1.0, atol=1e-6):
            continue
        deepest = int(own[np.argmax(depths[own])])
        load = g * float(mechanism.mass[root == first].sum())
        way = depths[deepest] - load / mechanism.contacts[deepest].law.stiffness
        x, moves = mechanism.space.integrate(x, _extended(ways @ (way * along), mechanism.space.ndx)), moves + 1
    if not moves:
        raise PlannerError("the machine cannot be lowered as a whole, expected a trunk on a slide or a free joint.")
    return x


def clearance(mechanism: Mechanism, x: np.ndarray) -> float:
    """How far a pose (nx,) is above the ground, m: its lowest contact; infinite without contacts."""
    depths = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).depths
    return -float(np.max(depths, initial=-np.inf))


def _extended(part: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([part, np.zeros(size - len(part))])


def _downhill(mechanism: Mechanism, x: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, bool]:
    """Move what is free to where no force is left; whether it got there.

    Newton's method where energy curves upwards and a step downhill where it does not, none longer than what proved
    right: a step is one if the energy falls, by the mean of the forces at both ends.
    """
    space = mechanism.space
    steep, enough, longest = _Steepness(mechanism, free), AT_REST * weight(mechanism), FIRST_STEP
    start, uphill = x, steep.uphill(x[None])[0]
    for _ in range(STEPS):
        if np.abs(uphill).max() < enough:
            return x, True
        ways = _across(mechanism, x[: mechanism.nq], free)
        by_q = ways @ ways.T @ steep.slopes(x) @ ways @ ways.T
        while longest > SHORTEST_STEP:
            step = _newton(by_q, ways @ (ways.T @ uphill), longest)
            there = space.integrate(x, _extended(free @ step, space.ndx))
            further = steep.uphill(there[None])[0]
            expected, found = step @ uphill + 0.5 * step @ by_q @ step, 0.5 * step @ (uphill + further)
            if found < 0.0 or np.abs(further).max() < np.abs(uphill).max():
                break
            longest = 0.25 * float(np.abs(step).max())
        else:
            return x, False
        right = abs(found - expected) < 0.3 * abs(expected)
        longest = min(LONGEST_STEP, 2.0 * longest) if right else max(0.5 * longest, 1e-3 * FIRST_STEP)
        x, uphill = there, further
        if np.abs(space.difference(x, start)).max() > MAX_SHIFT:
            break
    return x, False


def _across(mechanism: Mechanism, q: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(n, k) combinations of what is free that lift or tilt: along the ground a machine stands anywhere as well.

    A turn about the vertical of a machine that leans is no pure turn of its coordinates, so far from rest its torques
    would seem to push along the ground.
    """
    links = sorted({contact.link for contact in mechanism.contacts})
    return _complement(along_ground(mechanism, q, free, np.array(links)))


def along_ground(mechanism: Mechanism, q: np.ndarray, free: np.ndarray, links: np.ndarray) -> np.ndarray:
    """(n, m) orthogonal combinations of directions free (nv, n) along level ground: no link is lifted or tilted."""
    if not np.any(mechanism.gravity):
        return np.zeros((free.shape[1], 0))
    up = -mechanism.gravity / np.linalg.norm(mechanism.gravity)
    rows = []
    for link in links:
        J = jacobian(mechanism, q, Frame(int(link), np.eye(4)))
        rows += [up[None] @ J[:3], J[3:] - np.outer(up, up @ J[3:])]
    _, sizes, directions = np.linalg.svd(np.vstack(rows) @ free)
    return directions[int(np.sum(sizes > FLAT * sizes.max(initial=0.0))) :].T


def _complement(basis: np.ndarray) -> np.ndarray:
    return np.linalg.svd(basis)[0][:, basis.shape[1] :] if basis.shape[1] else np.eye(len(basis))


def _newton(by_q: np.ndarray, uphill: np.ndarray, longest: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (by_q + by_q.T))
    along = vectors.T @ uphill
    floor = 1e-8 * np.abs(values).max()
    # along the ground no energy changes, and nothing asks to move there
    step = -vectors @ np.where(np.abs(values) > floor, along / np.maximum(np.abs(values), floor), 0.0)
    return step * min(1.0, longest / max(float(np.abs(step).max()), 1e-300))


class _Steepness:
    """Forces at rest on the degrees of freedom that nothing drives, compiled: how energy rises along them."""

    def __init__(self, mechanism: Mechanism, free: np.ndarray) -> None:
        self._mechanism, self._free = mechanism, free
        self._dynamics = RigidBodyDynamics(mechanism, dt=1e-3)

    def uphill(self, xs: np.ndarray) -> np.ndarray:
        """(K, free) at states (K, nx) at rest: M qdd is the sum of all forces, whatever actuators do elsewhere."""
        m = self._mechanism
        rates = self._dynamics.rates(xs, np.zeros((len(xs), self._dynamics.nu)))[:, m.nv : 2 * m.nv]
        return -np.einsum("kij,kj->ki", mass_matrix(m, xs[:, : m.nq]), rates) @ self._free

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """(free, free) by differences."""
        n, space = self._free.shape[1], self._mechanism.space
        change = np.zeros((2 * n, space.ndx))
        change[:n, : len(self._free)], change[n:, : len(self._free)] = (
            DIFFERENCE * self._free.T,
            -DIFFERENCE * self._free.T,
        )
        uphill = self.uphill(space.integrate(np.tile(x, (2 * n, 1)), change))
        return (uphill[:n] - uphill[n:]).T / (2.0 * DIFFERENCE)


def _at(place: np.ndarray) -> str:
    return f"({place[0]:.3g}, {place[1]:.3g})"
