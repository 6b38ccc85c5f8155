"""Static equilibrium of a machine on the ground.

At rest the bias force of a pose (gravity and springs) is that of actuators, contacts and stops together,

    bias(q, 0) = B u + sum_k J_k' f_k + stops,

where the contact law of model.contact.laws gives f_k by the penetration of contact k. `static_equilibrium` moves the
unactuated degrees of freedom, with the actuated joints fixed, by descent in potential energy until their equations
hold. planner.dynamics.quasi_static computes the controls u.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import bias
from planner.dynamics.contacts import contact_forces, contact_jacobians, generalized_forces
from planner.dynamics.kinematics import jacobian
from planner.dynamics.momentum import center_of_mass
from planner.dynamics.quasi_static import weight
from planner.model.capabilities import roots, unactuated_basis
from planner.model.mechanism import Frame, Mechanism

STEPS = 200  # largest number of iterations
FIRST_STEP, LONGEST_STEP = 0.02, 0.2  # m or rad, step lengths: contacts open and close within millimetres
SHORTEST_STEP = 1e-9  # m or rad: the search fails if no longer step lowers the energy
MAX_SHIFT = 0.5  # m or rad, from the initial pose: a larger displacement counts as a fall
AT_REST = 1e-9  # relative to the weight: largest residual force at convergence
FLAT = 1e-6  # relative to the largest singular value: lift and tilt of directions along the ground
DIFFERENCE = 1e-6  # m or rad, of central differences of forces; affects only the number of iterations
MANY = 20  # largest number of contacts of a tree that determine its vertical displacement
UPWARDS = 0.8  # cosine of a plane's normal to the vertical: planes below it are walls


def static_equilibrium(mechanism: Mechanism, x: Any) -> np.ndarray:
    """The rest state on the ground near a pose, with the actuated joints unchanged.

    Unactuated degrees of freedom (a free base, a passive joint) descend in potential energy from the height at which
    the lowest contact bears the weight; they are not displaced along the ground.

    Args:
        mechanism: A mechanism with contacts.
        x: (nx,) state or (nq,) pose; velocities are set to zero, activations are unchanged.

    Returns:
        (nx,).

    Raises:
        PlannerError: There are no contacts or no unactuated joints, or the pose falls over.
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
    """A state (nx,) displaced along the ground normals until each tree's lowest contact alone bears the tree's weight.

    Raises:
        PlannerError: No tree with contacts can be displaced vertically as a whole.
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
        way = depths[deepest] - mechanism.contacts[deepest].law.rest_depth(load)
        x, moves = mechanism.space.integrate(x, _extended(ways @ (way * along), mechanism.space.ndx)), moves + 1
    if not moves:
        raise PlannerError("the machine cannot be lowered as a whole, expected a trunk on a slide or a free joint.")
    return x


def clearance(mechanism: Mechanism, x: np.ndarray) -> float:
    """Clearance of the lowest contact of a state (nx,) above the ground, m; infinite without contacts."""
    depths = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).depths
    return -float(np.max(depths, initial=-np.inf))


def _extended(part: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([part, np.zeros(size - len(part))])


def _downhill(mechanism: Mechanism, x: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, bool]:
    """Minimize the potential energy over the directions free (nv, n): the state (nx,), and whether it converged.

    Newton's method with the absolute eigenvalues of the Hessian and a limited step length: a step is accepted if the
    energy decreases (trapezoidal rule on the forces at both ends), or the largest force does.
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
    """(n, k) orthonormal combinations of the directions free (nv, n) that lift or tilt links with contacts.

    Displacements along level ground do not change the energy, but for a tilted machine away from equilibrium a yaw
    rotation mixes coordinates, so residual torques would cause spurious displacements along the ground.
    """
    links = sorted({contact.link for contact in mechanism.contacts})
    return _complement(along_ground(mechanism, q, free, np.array(links)))


def along_ground(mechanism: Mechanism, q: np.ndarray, free: np.ndarray, links: np.ndarray) -> np.ndarray:
    """(n, m) orthonormal combinations of the directions free (nv, n) that neither lift nor tilt the links."""
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
    # no step along directions of zero curvature, e.g. along the ground
    step = -vectors @ np.where(np.abs(values) > floor, along / np.maximum(np.abs(values), floor), 0.0)
    return step * min(1.0, longest / max(float(np.abs(step).max()), 1e-300))


class _Steepness:
    """Gradient and Hessian of potential energy, that of contacts and stops too, along the unactuated directions."""

    def __init__(self, mechanism: Mechanism, free: np.ndarray) -> None:
        self._mechanism, self._free = mechanism, free

    def uphill(self, xs: np.ndarray) -> np.ndarray:
        """Energy gradient (K, n) at states xs (K, nx) at rest, N and N m."""
        m = self._mechanism
        q, still = xs[:, : m.nq], np.zeros((len(xs), m.nv))
        return (bias(m, q, still) - generalized_forces(m, q, still)) @ self._free

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Energy Hessian (n, n) at x (nx,) by central differences of uphill."""
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
