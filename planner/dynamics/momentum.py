"""Centre of mass and angular momentum of a mechanism, which internal forces cannot change.

In flight only gravity acts, so the centre of mass follows a parabola and the angular momentum about it is constant,
whatever the joints do; a plan satisfies both to the order of its integrator.

    m c = sum m_i c_i,    L = sum R_i I_i R_i' w_i + m_i (c_i - c) x (v_i - v)    over the links i, in the world's axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics.batch import KernelCall
from planner.dynamics.kinematics import link_places, points_of
from planner.model.mechanism import Mechanism


def center_of_mass(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Position of the centre of mass in the world, (..., 3), m.

    Args:
        mechanism: The machine; bodies fixed to the world do not count.
        q: (..., nq) configurations, m and rad.

    Raises:
        PlannerError: A wrong shape, a number that is not finite, or a machine without mass.
    """
    masses, offsets, links = _massive(mechanism)
    places, _ = points_of(mechanism, q, links, offsets, moving=False)
    return np.einsum("l,...li->...i", masses, places) / masses.sum()


def center_of_mass_jacobian(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Derivative of center_of_mass by the velocities at q (..., nq): (..., 3, nv), in m per unit of each.

    Raises:
        PlannerError: As center_of_mass.
    """
    masses, offsets, links = _massive(mechanism)
    _, J = points_of(mechanism, q, links, offsets)
    return np.einsum("l,...lij->...ij", masses, J) / masses.sum()


def angular_momentum(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Angular momentum about the centre of mass, in the world's axes, (..., 3), kg m^2/s.

    Args:
        mechanism: The machine; bodies fixed to the world do not count.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.

    Raises:
        PlannerError: A wrong shape, a number that is not finite, or a machine without mass.
    """
    masses, offsets, links = _massive(mechanism)
    b = KernelCall(mechanism, q=q, qd=qd)
    T, screws, origin = link_places(b)
    twists = screws * b["qd"][:, :, None]  # of each link, relative to its parent
    for i, parent in enumerate(mechanism.parent):
        if parent >= 0:
            twists[:, i] += twists[:, parent]
    T, origin, spin, moving = T[:, links], origin[:, links], twists[:, links, :3], twists[:, links, 3:]
    R = T[..., :3, :3]
    places = np.einsum("klij,lj->kli", R, offsets) + T[..., :3, 3]
    speeds = moving + np.cross(spin, places - origin)
    own = np.einsum("klji,klj->kli", R, spin)  # angular velocity in the link's own axes
    spins = np.einsum("klij,ljm,klm->ki", R, mechanism.inertia[links], own)
    c, v = (np.einsum("l,kli->ki", masses, values)[:, None] / masses.sum() for values in (places, speeds))
    return b.out(spins + np.einsum("l,kli->ki", masses, np.cross(places - c, speeds - v)))


def _massive(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Links with mass: mass (L,), kg, centre of mass (L, 3) in the link's frame, m, and indices (L,)."""
    if not isinstance(mechanism, Mechanism):
        raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism.")
    links = np.flatnonzero(mechanism.mass > 0.0)
    if not len(links):
        raise PlannerError("the mechanism has no mass, expected at least one link that has.")
    return mechanism.mass[links], mechanism.com[links], links
