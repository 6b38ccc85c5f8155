"""Read fixed tendons from a compiled model."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import disabled
from planner.model.tendons import FixedTendon


def fixed(model: Any, tendon: int) -> bool:
    """Whether a tendon is a sum of joint coordinates."""
    return model.wrap_type[model.tendon_adr[tendon]] == load_mujoco().mjtWrap.mjWRAP_JOINT


def row_of(model: Any, tendon: int) -> np.ndarray:
    """(nv,) the coefficients of a fixed tendon."""
    first, row = model.tendon_adr[tendon], np.zeros(model.nv)
    wraps = slice(first, first + model.tendon_num[tendon])
    np.add.at(row, model.jnt_dofadr[model.wrap_objid[wraps]], model.wrap_prm[wraps])
    return row


def read_tendons(model: Any) -> tuple[FixedTendon, ...]:
    """The fixed tendons that have a force or a range."""
    spring, damper = (not disabled(model, name, "passive") for name in ("spring", "damper"))
    ends, found = not disabled(model, "constraint", "limit"), []
    for i in filter(lambda i: fixed(model, i), range(model.ntendon)):
        row = row_of(model, i)
        dofs = np.flatnonzero(row)
        limited = bool(ends and model.tendon_limited[i])
        low, high = model.tendon_range[i] if limited else (-np.inf, np.inf)
        tendon = FixedTendon(
            model.tendon(i).name, tuple(map(int, dofs)), tuple(map(float, row[dofs])),
            stiffness=float(model.tendon_stiffness[i] * spring),
            rest=(float(model.tendon_lengthspring[i, 0]), float(model.tendon_lengthspring[i, 1])),
            damping=float(model.tendon_damping[i] * damper), range=(float(low), float(high)),
        )  # fmt: skip
        if tendon.acts or limited:
            found.append(tendon)
    return tuple(found)
