"""Parity of a machine with prescribed joints and of the model in which MuJoCo drives them
(planner.model.mjcf.prescribed_joints).

Two comparisons at random states. First the machines with a moderate armature in place of the H that makes the driven
joints heavy: mass matrix, bias and actuator forces, accelerations as of any mechanism, since beside H a wrong mass
would not be seen. Then the model as it is replayed: its motors leave

    a_p = u - tau_p / H

of the accelerations asked for, tau_p being the force that they take, so MuJoCo's accelerations are those of the plan's
own dynamics at such controls, to rounding. How much that is, is shown beside it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.dynamics import algorithms as rigid_body
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, prescribed_dofs, with_force_inputs
from planner.model.mjcf.read import mechanism_of_model
from planner.proof.compare.constrained import constrained_acceleration
from planner.proof.compare.differences import differences
from planner.proof.compare.rigid_parity import random_states, rigid_parity, rounded, unlimited
from planner.proof.replays.simulation import set_state

_ROUNDS = 3  # of u - tau(u) / H: each is H times nearer than the last


def driven_parity(
    mechanism: Mechanism, prescribed: Collection[str], model: Any, states: int, bound: float, seed: int
) -> Section:
    """Compare a mechanism whose joints are prescribed with the MuJoCo model that drives them.

    The model's ranges and contacts are switched off; `bound` is what passes, relative.
    """
    dofs, free = prescribed_dofs(mechanism, prescribed), with_force_inputs(mechanism, prescribed)
    inertias = rigid_body.mass_matrix(free, mechanism.qpos0).diagonal()
    armature = free.armature.copy()
    armature[dofs] = inertias.max()  # a driven joint may carry next to nothing
    free = replace(free, armature=armature)
    if model.nv != mechanism.nv or not np.all(model.dof_armature[dofs] == PRESCRIBED_ARMATURE):
        raise ModelError(
            f"the model does not drive {', '.join(prescribed)}, expected an armature of {PRESCRIBED_ARMATURE:g} there: it is another "
            "machine."
        )
    model.dof_armature[dofs] = armature[dofs]
    losses = tuple(_losses(free, mechanism_of_model(model), bound))  # while its constraints are on
    spread = np.where(np.arange(free.nu) < mechanism.nu, 1.0, 1.0 / PRESCRIBED_ARMATURE)  # forces of size one
    section = rigid_parity(free, model, None, states, bound, seed, spread)
    model.dof_armature[dofs] = PRESCRIBED_ARMATURE
    measured = (*section.measured, *_driven(mechanism, prescribed, model, states, bound, seed))
    return replace(section, measured=(*measured, *losses))


def _losses(ours: Mechanism, theirs: Mechanism, bound: float) -> Iterator[Measurement]:
    """Friction losses beside each other; their slopes differ, for MuJoCo takes them from the driven model's inertia."""
    largest = np.maximum(ours.friction_loss, theirs.friction_loss)
    if np.any(largest):
        off = np.abs(theirs.friction_loss - ours.friction_loss) / np.where(largest > 0.0, largest, 1.0)
        note = "" if off.max() <= bound else f"{differences(ours, theirs)}, "
        yield Measurement("friction_loss_error", float(off.max()), "", bound, f"{note}of the loss, relative to it")


def _driven(
    mechanism: Mechanism, prescribed: Collection[str], model: Any, states: int, bound: float, seed: int
) -> tuple[Measurement, Measurement]:
    """The error of the driven model's accelerations against the plan's dynamics, and how far its motors fall short."""
    smooth = replace(mechanism, contacts=(), stops=(), friction_loss=np.zeros(mechanism.nv))
    dynamics = RigidBodyDynamics(smooth, 1.0, prescribed=prescribed)
    rng = np.random.default_rng(seed)
    xs = random_states(mechanism, rng, states)
    us = rng.normal(size=(states, dynamics.nu))
    accelerations = slice(mechanism.nv, 2 * mechanism.nv)
    asked, left = us.copy(), np.zeros((states, dynamics.nu - mechanism.nu))
    for _ in range(_ROUNDS):
        left = (
            forces_of_prescribed(smooth, prescribed, xs, dynamics.rates(xs, asked)[:, accelerations])
            / PRESCRIBED_ARMATURE
        )
        asked[:, mechanism.nu :] = us[:, mechanism.nu :] - left
    ours = dynamics.rates(xs, asked)[:, accelerations]
    theirs = _accelerations(model, mechanism_of_model(model), xs, us)
    speed2 = np.square(xs[:, mechanism.nq : mechanism.nq + mechanism.nv]).max(axis=1)
    scale = np.maximum(_rounded(smooth, prescribed, xs, theirs), speed2)
    error = float((np.abs(theirs - ours) / scale[:, None]).max())
    note = f"with the joints driven, at {states} random states (seed {seed}), relative to what it is made of at each"
    judged = Measurement("driven_acceleration_error", error, "", bound, note)
    note = f"of a prescribed acceleration at these states, rad/s^2 or m/s^2: the force it takes over {PRESCRIBED_ARMATURE:g}"
    return judged, Measurement("left_by_the_motors", float(np.abs(left).max()), "", None, note)


def _rounded(mechanism: Mechanism, prescribed: Collection[str], xs: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(K,) what rounding makes of the driven model's accelerations (K, nv), per unit of rounding."""
    heavy = with_force_inputs(mechanism, prescribed)
    armature = heavy.armature.copy()
    armature[prescribed_dofs(mechanism, prescribed)] = PRESCRIBED_ARMATURE
    heavy = replace(heavy, armature=armature)
    q, qd, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    return rounded(rigid_body.mass_matrix(heavy, q), rigid_body.bias(heavy, q, qd), qdd)


def forces_of_prescribed(
    mechanism: Mechanism, prescribed: Collection[str], xs: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """The forces (K, n) that prescribed joints take, at xs (K, nx) with accelerations qdd (K, nv); without contacts."""
    q, qd, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    return rigid_body.rnea(with_force_inputs(mechanism, prescribed), q, qd, qdd)[
        :, prescribed_dofs(mechanism, prescribed)
    ]


def _accelerations(model: Any, mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """MuJoCo's (K, nv), without contacts and ranges."""
    unlimited(model)
    mujoco, result = load_mujoco(), np.empty((len(xs), model.nv))
    data = mujoco.MjData(model)
    for k, (x, u) in enumerate(zip(xs, us, strict=True)):
        set_state(model, data, x)
        data.ctrl[:] = u
        mujoco.mj_forward(model, data)
        result[k] = constrained_acceleration(model, data, mechanism)
    return result
