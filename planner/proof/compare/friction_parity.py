"""Parity of friction loss: the plan's friction and MuJoCo's, of joints and fixed tendons, at random states.

MuJoCo's friction loss is a constraint that knows the acceleration, the plan's is a function of the velocity alone
(planner.model.joint_rows). Where both are cut off they are the loss, which is judged to rounding. Below the cut-off the
laws differ, and by how much is shown: MuJoCo's lets a joint that is pushed creep less, and where a joint decelerates by
more than friction would by itself, it pushes the joint on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measured
from planner.model.joint_rows import acting_rows, row_force, without_springs
from planner.model.mechanism import Mechanism
from planner.proof.compare.rigid_parity import random_states
from planner.proof.replays.simulation import set_state

_CUT_OFF = 1e-9  # of the loss: what misses it by less is cut off
_SPEEDS = np.geomspace(0.03, 10.0, 8)  # of random velocities, so that some are beyond the cut-off and some within


def friction_parity(mechanism: Mechanism, model: Any, states: int, bound: float, seed: int) -> Iterator[Measured]:
    """Compare friction forces at random states, with `bound` relative to the loss; nothing where nothing rubs.

    The model's contacts, ranges and equalities are switched off.
    """
    rows = [without_springs(row) for row in acting_rows(mechanism) if row.friction_loss > 0.0]
    if not rows:
        return
    xs = random_states(mechanism, np.random.default_rng(seed), states)
    qd = xs[:, mechanism.nq : mechanism.nq + mechanism.nv]
    qd *= np.resize(_SPEEDS, states)[:, None]
    loss = np.array([row.friction_loss for row in rows])
    ours = np.array([row_force(row, 0.0, qd[:, list(row.dofs)] @ row.coefficients) for row in rows]).T
    theirs, real, along = _theirs(model, xs, len(rows))
    difference = np.nan_to_num(np.abs(ours - theirs) / loss, nan=np.inf)
    cut = along & (np.abs(ours) >= (1.0 - _CUT_OFF) * loss) & ~(np.abs(theirs) < (1.0 - _CUT_OFF) * real)
    of = f"of {len(rows)} joints and tendons at {states} random states (seed {seed}), relative to the loss"
    note = f"where both are cut off at the loss, {cut.sum()} of {cut.size} times, {of}"
    yield Measured("friction_loss_error", float(difference[cut].max(initial=0.0)), "", bound, note)
    note = f"elsewhere, where MuJoCo's friction knows the acceleration and the plan's does not, {of}"
    yield Measured("friction_loss_difference", float(difference[~cut].max(initial=0.0)), "", None, note)


def _theirs(model: Any, xs: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """MuJoCo's friction forces (K, count), losses, and whether the velocity decides their sign.

    Of joints first, then of tendons; NaN where MuJoCo has another count of them.
    """
    mujoco = load_mujoco()
    bits, kinds = mujoco.mjtDisableBit, mujoco.mjtConstraint
    model.opt.disableflags |= bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_EQUALITY
    data, found = mujoco.MjData(model), np.full((2, len(xs), count), np.nan)
    along = np.ones((len(xs), count), dtype=bool)
    for k, x in enumerate(xs):
        set_state(model, data, x)
        mujoco.mj_forward(model, data)
        which = np.isin(data.efc_type, [int(kinds.mjCNSTR_FRICTION_DOF), int(kinds.mjCNSTR_FRICTION_TENDON)])
        if which.sum() == count:
            found[:, k] = data.efc_force[which], data.efc_frictionloss[which]
            acceleration = np.empty(data.nefc)
            mujoco.mj_mulJacVec(model, data, acceleration, data.qacc)
            along[k] = (np.abs(data.efc_aref) > np.abs(acceleration))[
                which
            ]  # of which the force is -D (acceleration - aref)
    return found[0], found[1], along
