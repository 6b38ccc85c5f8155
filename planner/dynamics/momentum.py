"""Centre of mass and angular momentum of a mechanism: what nothing inside it can change.

In flight gravity acts at the centre of mass alone, so that this moves on a parabola and the angular momentum about it
stays what it was, whatever the joints do; a plan keeps both to the order of its integrator.

    m c = sum m_i c_i,    L = sum R_i I_i R_i' w_i + m_i (c_i - c) x (v_i - v)    over the links i, in the world's axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array, shown
from planner.base.errors import PlannerError
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.model.mechanism import Frame, Mechanism


def center_of_mass(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Where the centre of mass is in the world, (..., 3), m.

    Args:
        mechanism: The machine; what is fixed to the world is not part of it.
        q: (..., nq).

    Raises:
        PlannerError: A wrong shape, a number that is not finite, or a machine without mass.
    """
    q = np.asarray(q, dtype=float)
    weighed = [m * frame_pose(mechanism, q, centre)[..., :3, 3] for _, m, centre in _massive(mechanism)]
    return np.sum(weighed, axis=0) / mechanism.mass.sum()


def angular_momentum(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Angular momentum about the centre of mass, in the world's axes, (..., 3), kg m^2/s.

    Args:
        mechanism: The machine; what is fixed to the world is not part of it.
        q: (..., nq).
        qd: (..., nv), as many states as q.

    Raises:
        PlannerError: A wrong shape, a number that is not finite, or a machine without mass.
    """
    q = np.asarray(q, dtype=float)
    qd = array("qd", qd, (*q.shape[:-1], mechanism.nv))
    links = _massive(mechanism)
    total = mechanism.mass.sum()
    places, speeds, spins = [], [], []
    for link, _, centre in links:
        T, V = frame_pose(mechanism, q, centre), np.einsum("...ij,...j->...i", jacobian(mechanism, q, centre), qd)
        places.append(T[..., :3, 3])
        speeds.append(V[..., :3])
        own = np.einsum("...ji,...j->...i", T[..., :3, :3], V[..., 3:])  # the turning in the link's own axes
        spins.append(np.einsum("...ij,jk,...k->...i", T[..., :3, :3], mechanism.inertia[link], own))
    masses = np.array([m for _, m, _ in links]).reshape(-1, *[1] * q.ndim)
    c, v = (np.sum(masses * values, axis=0) / total for values in (places, speeds))
    return np.sum(spins, axis=0) + np.sum(masses * np.cross(np.array(places) - c, np.array(speeds) - v), axis=0)


def _massive(mechanism: Mechanism) -> list[tuple[int, float, Frame]]:
    """The links with mass: which, kg, and a frame at the centre of mass in the link's axes."""
    if not isinstance(mechanism, Mechanism):
        raise PlannerError(f"mechanism is {shown(mechanism)}, expected a Mechanism.")
    found = []
    for link in np.flatnonzero(mechanism.mass > 0.0):
        T = np.eye(4)
        T[:3, 3] = mechanism.com[link]
        found.append((int(link), float(mechanism.mass[link]), Frame(int(link), T)))
    if not found:
        raise PlannerError("the mechanism has no mass, expected at least one link that has.")
    return found
