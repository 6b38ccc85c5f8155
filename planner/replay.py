"""Run a plan in MuJoCo. Nothing here plans: MuJoCo computes every state of a replay from the MJCF text alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planner.plan import Plan
from planner.twin import Twin


@dataclass(frozen=True)
class Replay:
    """What MuJoCo did with a plan's controls, sampled at every simulator step.

    Attributes:
        plan: The plan that was replayed.
        twin: The model it was replayed in.
        feedback: Whether the plan's gains acted.
        integrator: MuJoCo's integrator.
        t: (M+1,) s; M = N * substeps.
        qpos: (M+1, nq).
        qvel: (M+1, nv).
        act: (M+1, na).
        ctrl: (M, nu) what was applied.
        xs: (M+1, nx) the simulated state in the plan's coordinates.
        plan_xs: (M+1, nx) the plan at the same instants (between knots: its integrator over a part of the stage).
        contact_force: (M+1,) sum of the normal contact forces.
        contact_point: (M+1, 3) where it acts; NaN without contact.
        substeps: Simulator steps per stage of the plan.
        warnings: What MuJoCo complained of, one sentence each.
    """

    plan: Plan
    twin: Twin
    feedback: bool
    integrator: str
    t: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    xs: np.ndarray
    plan_xs: np.ndarray
    contact_force: np.ndarray
    contact_point: np.ndarray
    substeps: int
    warnings: tuple[str, ...] = ()
