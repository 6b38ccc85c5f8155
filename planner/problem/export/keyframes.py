"""A plan as keyframes of MuJoCo: a small MJCF that a model includes, <include file="plan.keys.xml"/>.

A keyframe has the time, qpos, qvel, act and ctrl of the model that the plan is replayed in. In MuJoCo's viewer they are
a list to click through; in a program `mujoco.mj_resetDataKeyframe(model, data, k)` sets one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import PlannerError
from planner.base.files import PathLike, write_atomically
from planner.model.mjcf.model_index import compile_model
from planner.problem.export.sampled import ExportedMotion, sampled

MAX_KEYFRAMES = 10_000  # MuJoCo lists them all


def write_keyframes(plan: ExportedMotion, path: PathLike, rate: float | None = None) -> Path:
    """Write a plan as an MJCF with one keyframe an instant, named plan_0, plan_1 and so on.

    Args:
        plan: The plan.
        path: The file.
        rate: Keyframes a second; None for the plan's knots.

    Raises:
        PlannerError: The plan has no MuJoCo model, the rate is wrong, or the plan is not finite.
        FileError: The file cannot be written.
    """
    if plan.twin is None:
        raise PlannerError("keyframes need the states of a MuJoCo model, but the plan has none; write a CSV.")
    samples = sampled(plan, rate)
    if len(samples.t) > MAX_KEYFRAMES:
        raise PlannerError(
            f"the plan makes {len(samples.t)} keyframes, expected at most {MAX_KEYFRAMES}: lower the rate."
        )
    model: Any = compile_model(plan.twin.mjcf, plan.twin.assets)
    qpos, qvel, act = np.split(plan.twin.sim_of(samples.xs), [model.nq, model.nq + model.nv], axis=1)
    rows = {"qpos": qpos, "qvel": qvel, "act": act}
    if model.nu == samples.us.shape[1]:
        rows["ctrl"] = samples.us
    root = ElementTree.Element("mujoco")
    keyframe = ElementTree.SubElement(root, "keyframe")
    for k, t in enumerate(samples.t):
        values = {name: " ".join(map(repr, row[k].tolist())) for name, row in rows.items() if row.shape[1]}
        ElementTree.SubElement(keyframe, "key", {"name": f"plan_{k}", "time": repr(float(t)), **values})
    ElementTree.indent(root)
    with write_atomically(path) as unfinished:
        unfinished.write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return Path(path)
