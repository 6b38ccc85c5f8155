"""Add torques of planner.model.exponential_torques to MuJoCo's passive forces, since MJCF has no such element.

MuJoCo asks its one global callback at every stage of its integrators, so a replay has no error of its own from it. The
callback is there only inside `curves_acting`, and acts on the models named there alone: others that run meanwhile are
left as they are. Where the data that the models run in are known too (rollouts), it is compiled: MuJoCo takes the
address of a C function, which threads call at once.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.exponential_torques import LARGEST, ExponentialTorque
from planner.model.twin import Twin
from planner.proof.replays.compiled_curves import compiled_curves

_lock = threading.RLock()  # one owner of the callback at a time


@contextmanager
def curves_acting(
    twin: Twin, *models: Any, factors: np.ndarray | None = None, data: Sequence[Any] = ()
) -> Iterator[None]:
    """MuJoCo with the curves of a twin, if it has any, acting in some models, times factors (models, curves).

    With `data`, all that these models run in, by compiled code.
    """
    if not twin.curves:
        yield
        return
    mujoco = load_mujoco()
    factors = np.ones((len(models), len(twin.curves))) if factors is None else factors
    tables = {
        model._address: _table(model, twin.curves, row) for model, row in zip(models, factors.tolist(), strict=True)
    }
    with _lock:
        before = mujoco.get_mjcb_passive()
        if data and before is None:
            with compiled_curves(tables, data) as function:
                mujoco.set_mjcb_passive(function)
                try:
                    yield
                finally:
                    mujoco.set_mjcb_passive(None)
            return

        def passive(model: Any, data: Any) -> None:
            if before is not None:
                before(model, data)
            table = tables.get(model._address)
            if table is None:
                return
            q, force = data.qpos, data.qfrc_passive
            for dof, amplitude, exponent, slopes in table:
                for address, slope in slopes:
                    exponent += slope * q[address]
                force[dof] += amplitude * math.exp(min(max(exponent, -LARGEST), LARGEST))

        mujoco.set_mjcb_passive(passive)
        try:
            yield
        finally:
            mujoco.set_mjcb_passive(before)


def _table(model: Any, curves: Sequence[ExponentialTorque], factors: Sequence[float]) -> list[Any]:
    """For each curve: its dof, amplitude, constant, and (address in qpos, slope) pairs."""
    kinds = load_mujoco().mjtJoint
    single = np.isin(model.jnt_type, [int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)])
    for curve in curves:
        if not all(dof < model.nv and single[model.dof_jntid[dof]] for dof in curve.dofs):
            raise ModelError(
                f"the model has no hinge or slide at one of dofs {', '.join(map(str, curve.dofs))}, expected the "
                "joints of the plan's exponential torques."
            )
    address = model.jnt_qposadr[model.dof_jntid].tolist()
    return [
        (c.dof, factor * c.amplitude, c.constant, [(address[j], slope) for j, slope in c.slopes])
        for c, factor in zip(curves, factors, strict=True)
    ]
