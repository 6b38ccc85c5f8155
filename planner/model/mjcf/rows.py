"""Read friction loss of joints, and fixed tendons, from a compiled model.

MuJoCo's friction loss is a constraint without a position: with d the impedance of `solimpfriction` at 0, beta the damping
of `solreffriction` (2 / (dmax timeconst), or -damping / dmax in the direct format) and w the inverse inertia at qpos0
that MuJoCo keeps, what slides alone decays at d beta per s. So the slope of friction is d beta / w.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.joint_rows import FixedTendon
from planner.model.mjcf.survey import disabled

LEAST_IMPEDANCE, MOST_IMPEDANCE = 1e-4, 0.9999  # MuJoCo's mjMINIMP, mjMAXIMP
_LEAST_WIDTH = 1e-15  # MuJoCo's mjMINVAL


def decays(solref: np.ndarray, solimp: np.ndarray) -> np.ndarray:
    """d beta (n,), 1/s, of n frictions with solref (n, 2) and solimp (n, 5)."""
    ends = np.clip(solimp[:, :2], LEAST_IMPEDANCE, MOST_IMPEDANCE)
    least, most = ends.T
    flat = (least == most) | (solimp[:, 2] <= _LEAST_WIDTH)
    d = np.where(flat, 0.5 * (least + most), least)
    direct = solref[:, 0] <= 0.0
    mixed = (solref[:, 0] > 0.0) != (solref[:, 1] > 0.0)  # MuJoCo takes its default then
    constant = np.where(mixed, 0.02, np.where(direct, 1.0, solref[:, 0]))
    return d * np.where(direct & ~mixed, -solref[:, 1], 2.0 / constant) / most


def joint_friction(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Loss (nv,), N m or N, and slope (nv,), N m s/rad or N s/m, of the friction of every degree of freedom."""
    off = disabled(model, "constraint", "frictionloss")
    slope = decays(model.dof_solref, model.dof_solimp) / model.dof_invweight0
    loss = np.where(off, 0.0, model.dof_frictionloss)
    return loss, np.where(loss > 0.0, slope, 0.0)


def fixed(model: Any, tendon: int) -> bool:
    """Whether a tendon is a sum of joint coordinates."""
    return model.wrap_type[model.tendon_adr[tendon]] == load_mujoco().mjtWrap.mjWRAP_JOINT


def row_of(model: Any, tendon: int) -> np.ndarray:
    """(nv,) the coefficients of a fixed tendon."""
    row, wraps = (
        np.zeros(model.nv),
        slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon]),
    )
    np.add.at(row, model.jnt_dofadr[model.wrap_objid[wraps]], model.wrap_prm[wraps])
    return row


def read_tendons(model: Any) -> tuple[FixedTendon, ...]:
    """The fixed tendons that have a force or a range."""
    spring, damper = (not disabled(model, name, "passive") for name in ("spring", "damper"))
    rubs, ends = (not disabled(model, "constraint", name) for name in ("frictionloss", "limit"))
    found = []
    for i in filter(lambda i: fixed(model, i), range(model.ntendon)):
        row = row_of(model, i)
        dofs = np.flatnonzero(row)
        loss = float(model.tendon_frictionloss[i] * rubs)
        decay = decays(model.tendon_solref_fri[i : i + 1], model.tendon_solimp_fri[i : i + 1])[0]
        low, high = model.tendon_range[i] if ends and model.tendon_limited[i] else (-np.inf, np.inf)
        tendon = FixedTendon(
            model.tendon(i).name, tuple(map(int, dofs)), tuple(map(float, row[dofs])),
            stiffness=float(np.ravel(model.tendon_stiffness[i])[0] * spring),
            rest=(float(model.tendon_lengthspring[i, 0]), float(model.tendon_lengthspring[i, 1])),
            damping=float(np.ravel(model.tendon_damping[i])[0] * damper), friction_loss=loss,
            friction_slope=float(decay / model.tendon_invweight0[i]) if loss > 0.0 else 0.0,
            range=(float(low), float(high)),
        )  # fmt: skip
        if tendon.acts or ends and model.tendon_limited[i]:
            found.append(tendon)
    return tuple(found)
