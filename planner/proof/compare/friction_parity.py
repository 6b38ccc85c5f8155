"""Parity of friction loss: the plan's friction of joints and MuJoCo's, at random states with random forces.

Both are the same function of the velocity and the acceleration (planner.dynamics.friction), but that the plan's bends
where MuJoCo's is cut off at once. So at MuJoCo's acceleration they are the same, to rounding, in all joints that are
held or slide well enough; in the bend the difference is shown.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement
from planner.dynamics.friction import BEND, friction_forces
from planner.model.mechanism import Mechanism
from planner.model.mjcf.read import mechanism_of_model
from planner.proof.compare.differences import differences
from planner.proof.compare.rigid_parity import random_states
from planner.proof.replays.simulation import set_state

_SPEEDS = np.geomspace(1e-4, 1.0, 8)  # of random velocities and accelerations, so that some joints are held, some slide


def friction_parity(mechanism: Mechanism, model: Any, states: int, bound: float, seed: int) -> Iterator[Measurement]:
    """Compare friction at random states, with `bound` relative to the loss; nothing where nothing rubs in either.

    The model's contacts, ranges and equalities are left aside.
    """
    read = mechanism_of_model(model)
    losses = np.maximum(mechanism.friction_loss, read.friction_loss)
    rubs = np.flatnonzero(losses)
    if not len(rubs):
        return
    mujoco, rng, model = load_mujoco(), np.random.default_rng(seed), copy.copy(model)
    bits = mujoco.mjtDisableBit
    model.opt.disableflags |= bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_EQUALITY
    xs, data = random_states(mechanism, rng, states), mujoco.MjData(model)
    qd, qdd = xs[:, mechanism.nq : mechanism.nq + mechanism.nv], rng.normal(size=(states, mechanism.nv))
    for part in (qd, qdd):
        part *= np.resize(_SPEEDS, states)[:, None]
    theirs = np.zeros((states, mechanism.nv))
    for forces, x, a in zip(theirs, xs, qdd, strict=True):
        set_state(model, data, x)
        data.qacc[:] = a
        mujoco.mj_inverse(model, data)
        which = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        forces[data.efc_id[which]] = data.efc_force[which]
    loss = losses[rubs]
    x = mechanism.friction_inertia[rubs] * (qdd + mechanism.friction_rate * qd)[:, rubs] / loss
    off, bent = np.abs(friction_forces(mechanism, qd, qdd)[0] - theirs), np.abs(np.abs(x) - 1.0) < BEND
    beside, difference = np.delete(off, rubs, axis=1).max(initial=0.0), off[:, rubs] / loss
    of = f"of {len(rubs)} degrees of freedom at {states} random states (seed {seed}), relative to the loss"
    held, slides = (np.abs(x) < 1.0) & ~bent, (np.abs(x) > 1.0) & ~bent
    note = f"held {held.sum()} times and sliding {slides.sum()} times, {of}"
    error = float(max(difference[~bent].max(initial=0.0), beside))
    if not error <= bound and (named := differences(mechanism, read)):
        note = f"{named}, {note}"
    yield Measurement("friction_loss_error", error, "", bound, note)
    note = f"between, where MuJoCo's is cut off and the plan's bends, {of}"
    yield Measurement("friction_loss_bend", float(difference[bent].max(initial=0.0)), "", None, note)
