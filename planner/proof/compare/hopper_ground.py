"""Contact force of the hopper: the plan's leg spring, against MuJoCo's ground force on the foot.

Forces are per mass of the machine, in/s^2, lengths in inches, as in the paper. The plan's leg has no foot; MuJoCo's
foot penetrates its ground a little. So the foot's height is solved for zero vertical acceleration.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.dynamics.hopper import HopperDynamics
from planner.proof.compare.coefficients import Coefficient, compared
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.simulation import set_state

STATES = 3
_HALVINGS = 60
_OF_REST = 0.02
_DEEPEST = 0.5  # Largest penetration of the foot, relative to the leg's compression


def hopper_ground(dynamics: HopperDynamics, compiled: CompiledTwin, seed: int) -> Iterator[Coefficient]:
    """The coefficients of the hopper's leg on the ground, at seeded states."""
    rng, name = np.random.default_rng(seed), "the leg on the ground"
    k, smooth = dynamics.stiffness, dynamics.smoothing
    for _ in range(STATES):
        # Outside the smoothing, and of the size of the static compression, gravity / k.
        height, c = rng.uniform(0.0, 20.0), max(smooth, _OF_REST * dynamics.gravity / k) * rng.uniform(2.0, 20.0)
        speed = -c * np.sqrt(k)

        def both(compression: float, rate: float, height: float = height) -> tuple[float, float]:
            x = np.array([height, rate, height + compression])
            ours = float(dynamics.rates(x[None], np.zeros((1, 1)))[0, 1]) + dynamics.gravity
            return ours, _ground_force(compiled, x, compression)

        held, deeper, closing = both(c, 0.0), both(2.0 * c, 0.0), both(c, speed)
        K = [(two - one) / c for one, two in zip(held, deeper, strict=True)]
        B = [(moved - one) / -speed for one, moved in zip(held, closing, strict=True)]
        begins = [float(c - np.divide(one, slope)) for one, slope in zip(held, K, strict=True)]  # NaN: no force
        yield compared("contact_stiffness", name, K[1], K[0], k)
        # The compression at which the force begins; a damping of 0 except for the foot's own inertia.
        yield compared("contact_surface", name, c - begins[1], c - begins[0], c)
        yield compared("contact_damping", name, B[1], B[0], 1e3 * np.sqrt(k))


def _ground_force(compiled: CompiledTwin, x: np.ndarray, compression: float) -> float:
    """Normal force on the foot per mass at zero foot acceleration; NaN where no height gives it."""
    mujoco, model = load_mujoco(), compiled.model
    data, w = mujoco.MjData(model), compiled.twin.sim_of(x)
    w[model.nq + 1] = w[model.nq]  # zero foot velocity

    def rises(sunk: float) -> bool:
        at = w.copy()
        at[1] += sunk  # a longer leg lowers the foot
        set_state(model, data, at)
        mujoco.mj_forward(model, data)
        return bool(data.qacc[0] - data.qacc[1] > 0.0)

    least, most = 0.0, _DEEPEST * compression
    if not rises(most):
        return np.nan
    for _ in range(_HALVINGS):
        middle = 0.5 * (least + most)
        least, most = (least, middle) if rises(middle) else (middle, most)
    rises(most)
    return _normal_force(model, data) / float(model.body_subtreemass[0])


def _normal_force(model: Any, data: Any) -> float:
    wrench, total = np.empty(6), 0.0
    for c in range(data.ncon):
        load_mujoco().mj_contactForce(model, data, c, wrench)
        total += float(wrench[0])
    return total
