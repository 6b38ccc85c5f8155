"""Skating: feet that slide along the ground, beside the way that they go on it.

    slip of a foot = integral of |v_t| over the time in which it bears load,  v_t = tangential part of J qd

with J the Jacobian of the material point in contact, so that a foot that rolls does not slip. Its way is that of its
centre along the ground from each knot at which it bears load to the next: a step counts from where it leaves the ground
to where it lands, however it swings, and a trunk that sways does not count.

Soft ground of a file lets small feet sink in by more than half of their radius when they land, which no floor does.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.contact_kinematics import PlaneContactKinematics
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import LinkPlaces, center_of_mass
from planner.dynamics.statics import STRIDE
from planner.model.capabilities import capabilities_of, roots, stands_on_ground
from planner.model.mechanism import Frame, Mechanism
from planner.problem.plan import Plan
from planner.problem.problem import Problem

MAX_SHARE = 0.25  # of a foot's way: slip above it is named
MAX_PENETRATION_SHARE = 0.5  # of a foot's radius: deeper is named
ROLL_SHARE = 0.1  # of the height of the centre of mass: slip below it, and below STRIDE, is that of feet that deform


def skating(plan: Plan, problem: Problem) -> tuple[str, ...]:
    """A phrase about the foot that slips most of those whose slip is above allowed_slip and MAX_SHARE of their way."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not stands_on_ground(mechanism) or not np.isfinite(plan.xs).all():
        return ()
    qs, qds = plan.xs[:, : mechanism.nq], plan.xs[:, mechanism.velocities]
    forces = contact_forces(mechanism, qs, qds).forces
    slip, way = np.zeros((2, len(mechanism.contacts)))
    for k, contact in enumerate(mechanism.contacts):
        bears = np.flatnonzero(forces[:, k].any(axis=1))
        belt = np.any(contact.plane.velocity) or contact.plane.slide >= 0
        if not bears.size or belt or contact.law.friction == 0.0:
            continue
        at, n = LinkPlaces(mechanism, qs[bears]), contact.plane.normal
        v = PlaneContactKinematics(at, contact, qds[bears]).v
        steps = np.diff(at.pose(Frame.at(contact.link, contact.centre))[:, :3, 3], axis=0)
        slip[k] = problem.dynamics.dt * _along(v, n).sum()
        way[k] = _along(steps, n).sum()
    skates = (slip > allowed_slip(mechanism, qs[0])) & (slip > MAX_SHARE * way)
    if not skates.any():
        return ()
    worst = int(np.argmax(np.where(skates, slip, 0.0)))
    name = mechanism.contacts[worst].name
    return (f"{name} slides {slip[worst]:.2g} m while it goes {way[worst]:.2g} m along the ground",)


def foot_penetration(plan: Plan, problem: Problem) -> tuple[str, ...]:
    """A phrase about the round foot that sinks deepest, beside its radius, if above MAX_PENETRATION_SHARE."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not mechanism.contacts or not np.isfinite(plan.xs).all():
        return ()
    qs, qds = plan.xs[:, : mechanism.nq], plan.xs[:, mechanism.velocities]
    depths = contact_forces(mechanism, qs, qds).depths.max(axis=0)
    radii = np.array([contact.radius for contact in mechanism.contacts])
    tree = roots(mechanism)
    driven = np.isin(tree, tree[mechanism.directly_actuated])  # objects may be of anything
    counts = (radii > 0.0) & driven[[contact.link for contact in mechanism.contacts]]
    shares = np.divide(depths, radii, out=np.zeros_like(depths), where=counts)
    worst = int(np.argmax(shares))
    if shares[worst] <= MAX_PENETRATION_SHARE:
        return ()
    name = mechanism.contacts[worst].name
    # A spring stops what lands within a depth in proportion to its time constant.
    stiffer = float(shares[worst] / MAX_PENETRATION_SHARE)
    return (
        f"{name} sinks {depths[worst]:.2g} m into the ground, with a radius of {radii[worst]:.2g} m: in the file its "
        f"`solref` lacks a time constant {stiffer:.2g} times shorter",
    )


def allowed_slip(mechanism: Mechanism, q: np.ndarray) -> float:
    """The slip, m, that is not named, of a machine at q (nq,): ROLL_SHARE of its height, at most STRIDE.

    The height is that of the centre of mass from the lowest contact, in the air too.
    """
    ground = contact_forces(mechanism, q, np.zeros(mechanism.nv))
    lowest = int(np.argmax(ground.depths))
    height = mechanism.contacts[lowest].plane.normal @ (center_of_mass(mechanism, q) - ground.points[lowest])
    return min(STRIDE, ROLL_SHARE * abs(float(height)))


def _along(vectors: np.ndarray, n: np.ndarray) -> np.ndarray:
    """(K,) the lengths of vectors (K, 3) along a plane of normal n (3,)."""
    return np.linalg.norm(vectors - np.outer(vectors @ n, n), axis=1)
