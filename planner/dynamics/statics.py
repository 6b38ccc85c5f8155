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
from planner.dynamics.algorithms import bias, bias_derivatives
from planner.dynamics.contacts import (
    contact_forces,
    contact_jacobians,
    generalized_force_derivatives,
    generalized_forces,
)
from planner.dynamics.momentum import center_of_mass
from planner.model.mechanism import Mechanism

LONGEST_STEP = 0.02  # m or rad, downhill: less than the millimetres in which contacts come and go, times ten
STEPS = 500
TIPPED = 0.5  # m or rad, from the pose that was asked for: what moved as far has fallen over
AT_REST = 1e-9  # of the weight: what is left of it
LAW_SHARE = 1e-3  # how much less it matters that a force is the law's than that it holds the pose


def settled(mechanism: Mechanism, x: Any) -> np.ndarray:
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
    free = _undriven(mechanism)
    if not len(free):
        raise PlannerError("every joint is driven, expected some that are not: the ground carries nothing here.")
    x = _touching(mechanism, x, free)
    start, enough = x.copy(), AT_REST * _weight(mechanism)
    for _ in range(STEPS):
        q, still = x[:nq], np.zeros(nv)
        uphill = (bias(mechanism, q, still) - generalized_forces(mechanism, q, still))[free]
        if np.abs(uphill).max() < enough:
            return x
        by_q = bias_derivatives(mechanism, q, still)[0] - generalized_force_derivatives(mechanism, q, still)[0]
        x = space.integrate(x, _extended(_downhill(by_q[np.ix_(free, free)], uphill), free, space.ndx))
        if np.abs(space.difference(x, start)).max() > TIPPED:
            break
    places = contact_forces(mechanism, start[:nq], np.zeros(nv)).points
    centre, lowest = center_of_mass(mechanism, start[:nq]), places[np.argsort(places[:, 2])[:2]]
    raise PlannerError(
        f"the pose does not stay on the ground: its centre of mass is at {_at(centre)} and its lowest contacts at "
        f"{_at(lowest[0])} and {_at(lowest[-1])} (x, y in m), expected driven joints that bring it over them."
    )


def clearance(mechanism: Mechanism, x: np.ndarray) -> float:
    """How far a pose (nx,) is above the ground, m: its lowest contact; infinite without contacts."""
    depths = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).depths
    return -float(np.max(depths, initial=-np.inf))


def supported(mechanism: Mechanism, q: np.ndarray, reach: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Controls (nu,) that together with the ground give a generalized force.

    Contacts near the ground push as they must, within their cones of friction (pyramids of four edges); where several
    ways do, as the law would at this depth. Least squares: what nothing reaches is left.

    Args:
        mechanism: The machine.
        q: (nq,) pose.
        reach: (nv, nu) generalized forces per control.
        tau: (nv,) what is wanted of controls, contacts and stops.
    """
    from scipy.optimize import lsq_linear

    still, nu = np.zeros(mechanism.nv), reach.shape[1]
    law = contact_forces(mechanism, q, still)
    J = contact_jacobians(mechanism, q)
    near = np.flatnonzero(law.depths > [-_weight(mechanism) / c.law.stiffness for c in mechanism.contacts])
    tau = tau - generalized_forces(mechanism, q, still) + np.einsum("kaj,ka->j", J, law.forces)  # less stops
    edges = [_edges(mechanism.contacts[k]) for k in near]
    columns = [reach, *(J[k].T @ edge for k, edge in zip(near, edges, strict=True))]
    rows = [np.hstack(columns)]
    wanted = [tau]
    at = nu
    for k, edge in zip(near, edges, strict=True):
        row = np.zeros((3, rows[0].shape[1]))
        row[:, at : at + edge.shape[1]] = LAW_SHARE * edge
        rows.append(row)
        wanted.append(LAW_SHARE * law.forces[k])
        at += edge.shape[1]
    least = np.where(np.arange(at) < nu, -np.inf, 0.0)
    return lsq_linear(np.vstack(rows), np.concatenate(wanted), (least, np.inf), method="bvls").x[:nu]


def _edges(contact: Any) -> np.ndarray:
    """(3, 1 or 4) the forces whose sums with positive factors a contact can give at rest."""
    n = contact.plane.normal
    if contact.law.friction == 0.0:
        return n[:, None]
    across = np.linalg.svd(n[None])[2][1:]
    return np.array([n + side * contact.law.friction * t for t in across for side in (-1.0, 1.0)]).T


def _undriven(mechanism: Mechanism) -> np.ndarray:
    """The degrees of freedom that no actuator moves."""
    return np.flatnonzero(~np.any(mechanism.actuators.moment != 0.0, axis=0))


def _weight(mechanism: Mechanism) -> float:
    return float(mechanism.mass.sum() * np.linalg.norm(mechanism.gravity))


def _extended(part: np.ndarray, places: np.ndarray, size: int) -> np.ndarray:
    whole = np.zeros(size)
    whole[places] = part
    return whole


def _touching(mechanism: Mechanism, x: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The state moved along the planes' normals, as a whole, until its lowest contact sinks in by its weight."""
    q = x[: mechanism.nq]
    normals = np.array([contact.plane.normal for contact in mechanism.contacts])
    rise = np.einsum("ka,kaj->kj", normals, contact_jacobians(mechanism, q))[:, free]
    up = np.linalg.lstsq(rise, np.ones(len(rise)), rcond=None)[0]
    if not np.allclose(rise @ up, 1.0, atol=1e-6):
        raise PlannerError("the machine cannot be lowered as a whole, expected a trunk on a slide or a free joint.")
    depths = contact_forces(mechanism, q, np.zeros(mechanism.nv)).depths
    lowest = int(np.argmax(depths))
    way = depths[lowest] - _weight(mechanism) / mechanism.contacts[lowest].law.stiffness
    return mechanism.space.integrate(x, _extended(way * up, free, mechanism.space.ndx))


def _downhill(by_q: np.ndarray, uphill: np.ndarray) -> np.ndarray:
    """Newton's step where energy curves upwards, a step downhill where it does not; none too long."""
    values, vectors = np.linalg.eigh(0.5 * (by_q + by_q.T))
    along = vectors.T @ uphill
    floor = 1e-9 * np.abs(values).max()
    # along the ground no energy changes, and nothing asks to move there
    step = -vectors @ np.where(np.abs(values) > floor, along / np.maximum(np.abs(values), floor), 0.0)
    return step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))


def _at(place: np.ndarray) -> str:
    return f"({place[0]:.3g}, {place[1]:.3g})"
