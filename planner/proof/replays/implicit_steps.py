"""Steps of the plan's Rosenbrock method (kernels.tree.rosenbrock) with MuJoCo's forces and masses.

MuJoCo takes damping implicitly, too, by methods of first order: after a control jumps, its first step is a fifth of the
jump off where damping is as fast as the step. So here MuJoCo computes the accelerations, of a model whose armatures are
heavier by the damping that a step takes, and the second stage's forces are applied as MuJoCo lets users apply them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.damping import implicit_damping
from planner.model.mechanism import Mechanism

GAMMA = 1.0 - 0.5**0.5  # as in kernels.tree.rosenbrock
INTEGRATOR = "rosenbrock"
NATIVE = "IMPLICITFAST"  # MuJoCo's own, stable, of first order

Step = Callable[[Any], None]  # moves MuJoCo's data
Acceleration = Callable[[Any, Any], np.ndarray]  # (model, data) after mj_forward -> (nv,)


def damping_of(dynamics: Any) -> np.ndarray | None:
    """(nv,) what a plan's dynamics take implicitly; None where they take nothing so."""
    mechanism = getattr(dynamics, "mechanism", None)
    if getattr(dynamics, "integrator", "") != INTEGRATOR or not isinstance(mechanism, Mechanism):
        return None
    return implicit_damping(mechanism)


def implicit_step(
    model: Any, h: float, damping: np.ndarray, parts: int = 1, acceleration: Acceleration | None = None
) -> Step:
    """A function that moves data of a model by h s in equal parts.

    Args:
        model: MuJoCo's; it is not changed.
        h: s.
        damping: (nv,) of damping_of().
        parts: Steps of the method.
        acceleration: What to take for MuJoCo's qacc.
    """
    mujoco, h = load_mujoco(), h / parts
    added, heavier = GAMMA * h * damping, copy.copy(model)
    heavier.dof_armature[:] += added
    heavier.dof_M0[:] += added  # MuJoCo reads it in place of armatures for bodies whose masses never change

    def forward(data: Any) -> tuple[np.ndarray, np.ndarray]:
        mujoco.mj_forward(heavier, data)
        a = data.qacc if acceleration is None else acceleration(heavier, data)
        return a.copy(), data.act_dot.copy()

    def step(data: Any) -> None:
        for _ in range(parts):
            q, v, act, applied = data.qpos.copy(), data.qvel.copy(), data.act.copy(), data.qfrc_applied.copy()
            a, rate = forward(data)
            data.qvel[:], data.act[:] = v + h * a, act + h * rate
            data.qfrc_applied[:] = applied + 2.0 * added * a
            mujoco.mj_integratePos(heavier, data.qpos, v + GAMMA * h * a, h)
            w, later = forward(data)
            data.qpos[:] = q
            mujoco.mj_integratePos(heavier, data.qpos, v + 0.5 * h * ((1.0 - GAMMA) * a + GAMMA * w), h)
            data.qvel[:], data.act[:] = v + 0.5 * h * (a + w), act + 0.5 * h * (rate + later)
            data.qfrc_applied[:] = applied
            data.time += h

    return step
