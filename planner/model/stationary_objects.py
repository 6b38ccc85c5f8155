"""Objects that lie beside a machine: nothing drives them, and what they lie on is not planned.

A plan keeps such an object where it starts. Its weight is carried by gravity compensation, so its coordinates stay in
the state and nothing moves them. In the user's file it lies on whatever is under it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from planner.model.mechanism import Mechanism


def stationary_object_dofs(mechanism: Mechanism) -> np.ndarray:
    """(nv,) the degrees of freedom of unreached trees that float, whose weight is carried, outside closed chains."""
    unreached, root = unreached_dofs(mechanism), roots(mechanism)
    chained = {end for loop in mechanism.loops for end in loop.links}
    chained |= {end for one in mechanism.polynomial_couplings for end in one.dofs}
    lies = np.zeros(mechanism.nv, dtype=bool)
    for first in np.unique(root[unreached]):
        tree = root == first
        mass, lifted = mechanism.mass[tree].sum(), mechanism.gravcomp_mass[tree].sum()
        begins_free = np.count_nonzero(tree) >= 6 and np.all(mechanism.S[first : first + 3, 3:] == np.eye(3))
        lies[tree] = begins_free and 0.0 < mass <= lifted * (1.0 + 1e-9) and chained.isdisjoint(np.flatnonzero(tree))
    return lies


def unreached_dofs(mechanism: Mechanism, prescribed: Iterable[int] = ()) -> np.ndarray:
    """(nv,) the degrees of freedom of trees that no actuator, contact, coupling or tendon reaches.

    A closed chain makes one tree of two, and one with the world reaches its tree.

    Args:
        mechanism: The machine.
        prescribed: Degrees of freedom whose accelerations are controls.
    """
    root = roots(mechanism)
    reached = {*map(int, np.flatnonzero(mechanism.directly_actuated)), *map(int, prescribed)}
    reached |= {contact.link for contact in mechanism.contacts}
    reached |= {shape.link for pair in mechanism.body_contacts for shape in (pair.first, pair.second)} - {-1}
    reached |= {dof for one in (*mechanism.couplings, *mechanism.tendons) for dof in one.dofs}
    for first, second in (
        *(loop.links for loop in mechanism.loops), *(one.dofs for one in mechanism.polynomial_couplings),
    ):  # fmt: skip
        if -1 in (first, second):
            reached.add(max(first, second))
        else:
            root[root == root[first]] = root[second]
    return ~np.isin(root, root[sorted(reached)])


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
