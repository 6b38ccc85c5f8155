"""Ranges and shapes that a plan itself goes beyond: no replay of it can agree, whatever the step."""

from __future__ import annotations

from planner.base.gl import load_mujoco
from planner.proof.ranges import ranges_reached
from planner.proof.replaying import Replay, knows_contacts, stopped_dofs


def reached_by_plan(run: Replay) -> tuple[str, ...]:
    """The sentences of a replay's `reached` that the plan's own knots justify too.

    A replay that goes astray may reach anything, and that comes of its going astray.
    """
    if not run.reached:
        return ()
    mujoco, plan = load_mujoco(), run.plan
    model, w = run.compiled.model, run.twin.sim_of(plan.xs)
    ranges = ranges_reached(model, plan.t, w, plan.us, stopped_dofs(plan))
    if plan.problem is None or knows_contacts(plan):
        return ranges
    data = mujoco.MjData(model)
    for t, state in zip(plan.t, w, strict=True):
        data.qpos[:] = state[: model.nq]
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            return (*ranges, f"shapes touch at t = {t:.4g} s.")
    return ranges
