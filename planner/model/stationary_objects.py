"""Objects that lie beside a machine: nothing drives them, and what they lie on is not planned.

A plan keeps such an object where it starts. Its weight is carried by gravity compensation, so its coordinates stay in
the state and nothing moves them. In the user's file it lies on whatever is under it.
"""

from __future__ import annotations

import numpy as np

from planner.model.mechanism import Mechanism


def stationary_object_dofs(mechanism: Mechanism) -> np.ndarray:
    """(nv,) the degrees of freedom of trees that float, and that no actuator, contact, tendon or equation reaches."""
    moved = set(np.flatnonzero(np.any(mechanism.actuators.moment != 0.0, axis=0)).tolist())
    moved |= {contact.link for contact in mechanism.contacts}
    moved |= {shape.link for pair in mechanism.body_contacts for shape in (pair.first, pair.second)}
    moved |= {dof for one in (*mechanism.couplings, *mechanism.tendons) for dof in one.dofs}
    moved |= {end for one in mechanism.loops for end in one.links} | {
        end for one in mechanism.polynomial_couplings for end in one.dofs
    }
    root = roots(mechanism)
    lies = np.zeros(mechanism.nv, dtype=bool)
    for first in np.unique(root):
        tree = root == first
        mass, lifted = mechanism.mass[tree].sum(), mechanism.gravcomp_mass[tree].sum()
        begins_free = np.count_nonzero(tree) >= 6 and np.all(mechanism.S[first : first + 3, 3:] == np.eye(3))
        lies[tree] = begins_free and 0.0 < mass <= lifted * (1.0 + 1e-9) and moved.isdisjoint(np.flatnonzero(tree))
    return lies


def roots(mechanism: Mechanism) -> np.ndarray:
    """(nv,) the first link of the tree that each link is part of."""
    root = np.arange(mechanism.nv)
    for i, parent in enumerate(mechanism.parent):
        root[i] = i if parent < 0 else root[parent]
    return root


def stationary_object_bodies(mechanism: Mechanism) -> np.ndarray:
    """(nbody,) whether each body is part of such a tree."""
    links = np.array([frame.link for frame in mechanism.bodies])
    lies = stationary_object_dofs(mechanism)
    return (links >= 0) & lies[np.maximum(links, 0)] if len(lies) else np.zeros(len(links), dtype=bool)
