"""CompiledTwin: a twin and the MuJoCo model of its text, which is compiled once for all steps of a proof.

Steps, integrators and flags are options of the compiled model, so each use sets them on a copy of its own.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import Any

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.survey import compile_model
from planner.model.twin import Twin


class CompiledTwin:
    """A twin whose text is compiled when its model is first asked for, and never again."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin  # the text and the maps between its state and the plan's

    @cached_property
    def model(self) -> Any:
        """MuJoCo's model, not to be changed; every user changes a copy()."""
        model = compile_model(self.twin.mjcf, self.twin.assets)
        kinds = load_mujoco().mjtDyn  # the same equation, which MuJoCo's RK4 integrates wrongly when asked for exactly
        model.actuator_dyntype[model.actuator_dyntype == int(kinds.mjDYN_FILTEREXACT)] = int(kinds.mjDYN_FILTER)
        return model

    def check(self, nu: int) -> None:
        """Raise ModelError unless the model has the states that the twin maps, and nu controls."""
        model, nw = self.model, self.twin.to_x.shape[1]
        have = (model.nq + model.nv + model.na, model.nu)
        if have != (nw, nu):
            raise ModelError(
                f"the model has nq + nv + na = {have[0]} states and {have[1]} controls, expected {nw} and {nu}: "
                "it is not the machine that the plan was made for."
            )

    def copy(self) -> Any:
        """A model of the caller's own, to be changed."""
        return copy.copy(self.model)

    def stepping(self, timestep: float, integrator: str = "RK4") -> Any:
        """A copy that takes steps of `timestep` s with MuJoCo's "RK4" or "EULER", and goes on when it runs away."""
        mujoco, model = load_mujoco(), self.copy()
        model.opt.timestep = timestep
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # else what runs away would begin anew
        return model
