"""How deep MuJoCo's own soft contact lets a shape sink in under a load at rest, from its solref and solimp.

With r the depth, d(r) the impedance of solimp and A the sum of body_invweight0 of both bodies, MuJoCo's documentation
("Solver parameters") has at rest

    f = k d(r) r / R,   R = A (1 - d(r)) / d(r),   k = 1 / (dmax timeconst dampratio)^2,  or -solref[0] / dmax^2

for a frictionless contact or an elliptic cone. The 2 (condim - 1) edges of a pyramidal cone with friction mu share the
load with R = 2 mu^2 (1 + mu^2) A (1 - d) / d each, mu^2 over impratio in the first place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import Pair

DEEPEST = 0.1  # m: what sinks in further does not stand
_HALVINGS = 50


def rest_penetration(model: Any, pair: Pair, load: float) -> tuple[float, float]:
    """How deep a pair's shapes sink into each other when they press with a load, N, and how stiff they are there.

    Returns:
        m, at most DEEPEST, and N/m.
    """
    low, high = 0.0, DEEPEST
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _force(model, pair, middle) > load else (middle, high)
    step = 1e-4 * high
    return high, (_force(model, pair, high + step) - _force(model, pair, high - step)) / (2.0 * step)


def _force(model: Any, pair: Pair, r: float) -> float:
    """The normal force, N, at rest at a depth r, m."""
    d0, dmax, width, midpoint, power = (float(one) for one in pair.solimp)
    least, most = 1e-4, 0.9999  # mjMINIMP, mjMAXIMP
    d0, dmax = np.clip([d0, dmax], least, most)
    x = min(r / max(width, 1e-15), 1.0)
    midpoint, power = float(np.clip(midpoint, least, most)), max(power, 1.0)
    if x <= midpoint:
        d = d0 + (dmax - d0) * x**power / midpoint ** (power - 1.0)
    else:
        d = dmax - (dmax - d0) * (1.0 - x) ** power / (1.0 - midpoint) ** (power - 1.0)
    if pair.solref[0] > 0.0:
        timeconst = max(float(pair.solref[0]), 2.0 * float(model.opt.timestep))
        k = 1.0 / max((dmax * timeconst * float(pair.solref[1])) ** 2, 1e-15)
    else:
        k = -float(pair.solref[0]) / dmax**2
    A = float(model.body_invweight0[model.geom_bodyid[list(pair.geoms)], 0].sum())
    share = 1.0
    if pair.condim > 1 and model.opt.cone == int(load_mujoco().mjtCone.mjCONE_PYRAMIDAL):
        mu = max(float(pair.friction[0]), 1e-5)
        share = 2.0 * (pair.condim - 1) / (2.0 * mu**2 / float(model.opt.impratio) * (1.0 + mu**2))
    return share * k * d * r * d / (max(A, 1e-15) * (1.0 - d))
