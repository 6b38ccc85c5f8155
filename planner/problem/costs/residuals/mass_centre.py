"""The centre of mass: three rows. The readable twin of kernels.tree.residuals.mass_centre."""

from __future__ import annotations

import numpy as np

from planner.dynamics.kinematics import points_of
from planner.problem.costs.residuals.kinematics_cache import KinematicsCache


def mass_centre(seen: KinematicsCache, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """Value (K, 3) m, and its derivative (K, 3, nv) where asked: the means of the links', weighed by their masses."""
    m = seen.mechanism
    links = np.flatnonzero(m.mass > 0.0)
    share = m.mass[links] / m.mass.sum()
    places, J = points_of(m, seen.q, links, m.com[links], moving=moving)
    return np.einsum("l,nla->na", share, places), np.einsum("l,nlai->nai", share, J) if moving else J
