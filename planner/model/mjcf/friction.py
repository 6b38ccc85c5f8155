"""Read friction loss of joints from a compiled model: the numbers of planner.dynamics.friction.

MuJoCo's constraint has the regularization R = (1 - d) w / d, with d the impedance of `solimpfriction` at 0 and w the
inverse inertia of the joint at qpos0, and the damping beta of `solreffriction`: 2 / (dmax timeconst), or
-damping / dmax in the direct format. So D = 1 / R, and what slides alone decays at d beta per s, 95 by default.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.model.mjcf.model_index import disabled

MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # MuJoCo's mjMINIMP, mjMAXIMP
_MUJOCO_MIN_VALUE = 1e-15  # MuJoCo's mjMINVAL
_DEFAULT = 0.02  # s, MuJoCo's time constant where solref has numbers of both formats


def joint_friction(model: Any) -> dict[str, Any]:
    """Loss (nv,), N m or N, inertia (nv,), kg m^2 or kg, and rate (nv,), 1/s, of friction; zeros for none."""
    ends = np.clip(model.dof_solimp[:, :2], MIN_IMPEDANCE, MAX_IMPEDANCE)
    flat = (ends[:, 0] == ends[:, 1]) | (model.dof_solimp[:, 2] <= _MUJOCO_MIN_VALUE)
    d = np.where(flat, ends.mean(axis=1), ends[:, 0])
    positive = model.dof_solref > 0.0
    direct = ~positive.any(axis=1)
    constant = np.where(positive.all(axis=1), model.dof_solref[:, 0], _DEFAULT)
    rate = np.where(direct, -model.dof_solref[:, 1], 2.0 / constant) / ends[:, 1]
    loss = model.dof_frictionloss * (not disabled(model, "constraint", "frictionloss"))
    inertia = d / np.maximum((1.0 - d) * model.dof_invweight0, _MUJOCO_MIN_VALUE)
    return {
        "friction_loss": np.array(loss, dtype=float), "friction_inertia": np.where(loss > 0.0, inertia, 0.0),
        "friction_rate": np.where(loss > 0.0, rate, 0.0),
    }  # fmt: skip
