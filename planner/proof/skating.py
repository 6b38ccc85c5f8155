"""Skating: feet that slide along the ground, beside how far the machine travels.

    slip of a foot = integral of |v_t| over the time in which it bears load,  v_t = tangential part of J qd

with J the Jacobian of the material point in contact, so that a foot that rolls does not slip.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.contact_kinematics import PlaneContactKinematics
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import LinkPlaces, center_of_mass
from planner.dynamics.statics import STRIDE
from planner.model.capabilities import capabilities_of, stands_on_ground
from planner.problem.plan import Plan
from planner.problem.problem import Problem

MAX_SHARE = 0.25  # of the travel: slip above it is named


def skating(plan: Plan, problem: Problem) -> tuple[str, ...]:
    """A phrase about the foot that slips most, if that is more than MAX_SHARE of the travel, and than STRIDE."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not stands_on_ground(mechanism) or not np.isfinite(plan.xs).all():
        return ()
    qs, qds = plan.xs[:, : mechanism.nq], plan.xs[:, mechanism.velocities]
    forces = contact_forces(mechanism, qs, qds).forces
    slip = np.zeros(len(mechanism.contacts))
    for k, contact in enumerate(mechanism.contacts):
        bears = np.flatnonzero(forces[:, k].any(axis=1))
        belt = np.any(contact.plane.velocity) or contact.plane.slide >= 0
        if not bears.size or belt or contact.law.friction == 0.0:
            continue
        at = LinkPlaces(mechanism, qs[bears])
        v, n = PlaneContactKinematics(at, contact, qds[bears]).v, contact.plane.normal
        slip[k] = problem.dynamics.dt * np.linalg.norm(v - (v @ n)[:, None] * n, axis=1).sum()
    if slip.max() <= STRIDE:
        return ()
    centres = center_of_mass(mechanism, qs)
    travel = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    worst = int(np.argmax(slip))
    if slip[worst] <= MAX_SHARE * travel:
        return ()
    return (f"{mechanism.contacts[worst].name} slides {slip[worst]:.2g} m while the machine travels {travel:.2g} m",)
