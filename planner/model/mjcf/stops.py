"""Read the joint stops that a plan has forces of: those in which MuJoCo computes a law of model.contact.laws.

A joint whose numbers are those of `contacts.stop_attributes` has a plain spring and damper at the ends of its range,
smoothed by the file's <numeric name="stop_ramp">. A joint that nothing drives leans on its stop: no control keeps it
off. It has the force that MuJoCo computes from the file's numbers, a law with a lead, with model.mjcf.file_law's
formulas and A = dof_invweight0. All other ranges are bounds of a plan.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.laws import Law, Stop
from planner.model.mjcf.contact_edits import joints_of
from planner.model.mjcf.contacts import STOP_RAMP, direct_reason, smoothing_of
from planner.model.mjcf.file_law import FILE_SMOOTHING, has_square_rise, impedance_of, rates
from planner.model.mjcf.model_index import disabled
from planner.model.mjcf.text import written


def read_stops(model: Any, undriven: Collection[int]) -> tuple[Stop, ...]:
    """The ends of ranges that press in the plan; `undriven`: the degrees of freedom that nothing drives."""
    if disabled(model, "constraint", "limit"):
        return ()
    joints, found = load_mujoco().mjtJoint, []
    for j in map(int, np.flatnonzero(model.jnt_limited)):
        if model.jnt_type[j] not in (int(joints.mjJNT_HINGE), int(joints.mjJNT_SLIDE)):
            continue
        dof, law = int(model.jnt_dofadr[j]), None
        if model.jnt_margin[j] == 0.0 and not direct_reason(model.jnt_solref[j], model.jnt_solimp[j]):
            law = _plain_law(model, j)
        elif dof in undriven:
            law = _lead_law(model, j)
        if law is not None:
            found += [Stop(dof, float(end), side, law) for end, side in zip(model.jnt_range[j], (-1, 1), strict=True)]
    return tuple(found)


def keep_time_constants(root: ElementTree.Element, model: Any, stops: Collection[Stop]) -> None:
    """Write the time constants of stops with a lead that MuJoCo raises to two of the file's steps.

    A replay has other steps, and would raise them to others. `model` is compiled from the text.
    """
    shortest = 0.0 if disabled(model, "refsafe") else 2.0 * float(model.opt.timestep)
    joints = {int(model.dof_jntid[stop.dof]) for stop in stops if stop.law.lead > 0.0}
    raised = [j for j in sorted(joints) if 0.0 < model.jnt_solref[j, 0] < shortest]
    elements = joints_of(root, model) if raised else []
    for j in raised:
        elements[j].set("solreflimit", written(shortest, float(model.jnt_solref[j, 1])))


def _plain_law(model: Any, joint: int) -> Law:
    weight = float(model.dof_invweight0[model.jnt_dofadr[joint]]) * (1.0 - model.jnt_solimp[joint, 0])
    K, B = -model.jnt_solref[joint] / weight
    return Law(K, B, *smoothing_of(model, STOP_RAMP)[:2])


def _lead_law(model: Any, joint: int) -> Law | None:
    """MuJoCo's law of a joint's range; None where it is not of this form."""
    solimp, A = model.jnt_solimp[joint], float(model.dof_invweight0[model.jnt_dofadr[joint]])
    k, b = rates(model, model.jnt_solref[joint], solimp)
    if not (k > 0.0 and b > 0.0 and A > 0.0 and has_square_rise(solimp)):
        return None
    rise = impedance_of(solimp)
    d = rise[1]
    per = d / (A * (1.0 - d))
    ramp, force_ramp, _ = FILE_SMOOTHING
    margin = float(model.jnt_margin[joint])
    return Law(per * k * d, per * b, ramp, force_ramp, lead=1.0 / b, impedance=rise, margin=margin)
