"""Read the force of a compiled model's actuators: gain, affine bias and, beside them, a law of kernels.force_laws."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.actuators import ForceLaw


def affine_force(model: Any, i: int) -> tuple[float, np.ndarray]:
    """Gain, and bias (3,) by 1, length and length rate, of an actuator whose force is known."""
    affine = model.actuator_biastype[i] == int(load_mujoco().mjtBias.mjBIAS_AFFINE)
    return float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i, :3] * affine


def law_of(model: Any, i: int) -> ForceLaw | None:
    """What an actuator exerts beside that; None for nothing."""
    by_state = model.actuator_gainprm[i, 1:3]
    if model.actuator_gaintype[i] == int(load_mujoco().mjtGain.mjGAIN_AFFINE) and np.any(by_state):
        return ForceLaw(i, "affine gain", tuple(by_state.tolist()))
    return None


def unknown_force(model: Any, i: int) -> Iterator[str]:
    """What of an actuator's force is not modelled."""
    gains, biases = load_mujoco().mjtGain, load_mujoco().mjtBias
    for kinds, kind, known in (
        (gains, model.actuator_gaintype[i], (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE)),
        (biases, model.actuator_biastype[i], (biases.mjBIAS_NONE, biases.mjBIAS_AFFINE)),
    ):
        if int(kind) not in map(int, known):
            name = kinds(int(kind)).name
            yield f"{name.split('_')[-1].lower()} {'gain' if kinds is gains else 'bias'}"
