"""Choose how a plan treats the contacts of a file: with their own law, with a law of the ground, or avoided.

    "model"   every pair of shapes has a law that the plan computes (see model.mjcf.contacts)
    "ground"  something falls unless the ground carries it: its contacts with planes get a law for its mass
              (ground_law), all others are avoided
    "file"    contacts with planes are planned with the law that MuJoCo computes from the file's numbers (file_law), all
              others are avoided; "auto" takes it before "ground" where it can, but for wheels: light ones hop on it
    "avoid"   planned without contacts; a proof fails where shapes touch in the user's file

A tree of bodies can fall if it begins with a free joint, or with slides of which one is not level, and neither an
actuator nor a spring nor gravity compensation holds them. It is a machine if actuators drive some of its joints, else
an object. The mode follows from the machines: objects beside an arm or a hand that cannot fall do not make it stand. An
object that lies on something of which the plan knows no contact is kept where it starts (`stationary_roots`).

What flies is planned without contacts. A problem file whose goal is on the ground takes "file" (`stands_at`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from planner.base.arguments import first_of
from planner.base.gl import load_mujoco
from planner.model.mjcf.contact_shapes import meets_plane, plane_of
from planner.model.mjcf.contacts import is_modelled
from planner.model.mjcf.file_law import file_law_reason
from planner.model.mjcf.ground_law import mass_of
from planner.model.mjcf.joint_forces import has_wrenches, wrenches_of
from planner.model.mjcf.model_index import ModelIndex, Pair, gravity_of, named
from planner.model.mjcf.unsupported import no_compensation

MODES = ("auto", "avoid", "file", "ground", "model", "off")
STANDING = ("file", "ground")  # modes of machines that stand on planes
LEVEL = 0.8  # of gravity, across a plane that carries
MAX_NAMED = 3  # objects in a sentence
_STEEP = 1e-6  # of gravity, along a slide that is not level


class ContactMode(NamedTuple):
    """A mode, and the sentence that says why."""

    mode: str  # "model", "ground", "file" or "avoid"; "" where no shapes can touch
    phrase: str = ""


def select_contact_mode(survey: ModelIndex, asked: str = "auto") -> ContactMode:
    """The mode of contacts "auto", or of the mode that was asked for, with its sentence."""
    if not survey.pairs:
        return ContactMode("")
    falling = falling_trees(survey)
    standing = ground_pairs(survey)
    if asked == "auto":
        stands = standing and falling.keys() & machine_roots(survey)
        is_law = all(is_modelled(survey, pair) for pair in survey.pairs)
        asked = "model" if is_law else ("file" if _has_file_law(survey, standing) else "ground") if stands else "avoid"
    if asked == "model":
        return ContactMode(asked, f"contacts of {_pairs(len(survey.pairs))} are planned with the file's own law")
    kept = stationary_roots(survey, asked)
    if asked == "file" and (pairs := file_pairs(survey)):
        phrase = f"contacts of {_pairs(len(pairs))} with planes are planned with the file's own law"
        return ContactMode(asked, phrase + _of_others(survey, pairs) + _of_lying(survey, kept))
    if asked == "ground" and standing:
        return ContactMode(asked, _of_ground(survey, standing) + _of_lying(survey, kept))
    phrase = "planned without contacts: shapes that touch in your file fail the proof" + _of_lying(survey, kept)
    unheld = [named(survey.model, "body", int(body)) for body in falling if body not in kept]
    if unheld:
        phrase += f"; {unheld[0]} falls in the plan: draw a plane or a box under it, or take its free joint out"
    return ContactMode("avoid", phrase)


def ground_pairs(survey: ModelIndex) -> list[Pair]:
    """The pairs of what can fall and a plane of the world, or the top of a box at rest that it lies above."""
    falling = falling_trees(survey)
    planes, boxes = [], []
    for pair in survey.pairs:
        match = meets_plane(survey, pair.geoms)
        if match is None:
            continue
        flat, other = match
        root = int(survey.model.body_rootid[survey.model.geom_bodyid[other]])
        if root not in falling:
            continue
        if survey.model.geom_type[flat] == int(load_mujoco().mjtGeom.mjGEOM_PLANE):
            if _is_ground(survey, flat):
                planes.append(pair)
        elif _lies_above(survey, flat, other):
            boxes.append((root, pair))
    on_planes = {int(survey.model.body_rootid[survey.model.geom_bodyid[list(pair.geoms)].max()]) for pair in planes}
    return planes + [pair for root, pair in boxes if root not in on_planes or not falling[root]]


def _has_file_law(survey: ModelIndex, standing: Sequence[Pair]) -> bool:
    """Whether the plan computes MuJoCo's law of all pairs with planes at rest, and what stands stands on these."""
    pairs = file_pairs(survey)
    reasons = any(file_law_reason(survey.model, pair) for pair in pairs)
    return not reasons and {pair.geoms for pair in standing} <= {pair.geoms for pair in pairs}


def file_pairs(survey: ModelIndex) -> list[Pair]:
    """The pairs of a shape and a plane at rest, or the top of a box at rest that it lies above."""
    found = []
    for pair in survey.pairs:
        flat, other = meets_plane(survey, pair.geoms) or (-1, -1)
        plane = plane_of(survey, flat) if flat >= 0 else None
        if plane is None or plane.slide >= 0:
            continue
        is_plane = survey.model.geom_type[flat] == int(load_mujoco().mjtGeom.mjGEOM_PLANE)
        found += [pair] if is_plane or _lies_above(survey, flat, other) else []
    return found


def stands_at(survey: ModelIndex, q: np.ndarray, within: float) -> bool:
    """Whether a machine is nearer than `within` m to ground of which "file" knows the law, at positions q (nq,)."""
    mujoco, model = load_mujoco(), survey.model
    pairs, data, machines = file_pairs(survey), mujoco.MjData(model), list(machine_roots(survey))
    if any(file_law_reason(model, pair) for pair in pairs):
        return False
    roots = model.body_rootid[model.geom_bodyid]
    pairs = [pair for pair in pairs if np.isin(roots[list(pair.geoms)], machines).any()]
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return any(mujoco.mj_geomDistance(model, data, *pair.geoms, 2.0 * within, None) < within for pair in pairs)


def machine_roots(survey: ModelIndex) -> set[int]:
    """The root bodies of trees in which an actuator drives anything; of all trees that move where none does."""
    model, actuated = survey.model, actuated_dofs(survey)
    return set(map(int, model.body_rootid[model.dof_bodyid[actuated if actuated.any() else slice(None)]]))


def stationary_roots(survey: ModelIndex, mode: str) -> list[int]:
    """The root bodies of objects that the plan keeps where they start, of a mode "avoid", "ground" or "file".

    Nothing drives them, they begin with a free joint, and they lie on something at rest that gets no law.
    """
    pairs_of = {"ground": ground_pairs, "file": file_pairs}
    model, standing = survey.model, pairs_of[mode](survey) if mode in pairs_of else []
    carried = {int(model.body_rootid[model.geom_bodyid[geom]]) for pair in standing for geom in pair.geoms}
    rests = model.body_weldid[model.geom_bodyid] == 0
    may_lie = {
        int(model.body_rootid[model.geom_bodyid[list(pair.geoms)].max()])
        for pair in survey.pairs if rests[list(pair.geoms)].any()
    }  # fmt: skip
    free = model.jnt_type[model.body_jntadr] == int(load_mujoco().mjtJoint.mjJNT_FREE)
    objects = [body for body, actuated in falling_trees(survey).items() if not actuated and free[body]]
    return [body for body in objects if body in may_lie - carried]


def _of_lying(survey: ModelIndex, kept: Sequence[int]) -> str:
    names = [named(survey.model, "body", body) for body in kept]
    if not names:
        return ""
    stays = "stays" if len(names) == 1 else "stay"
    words = f"{first_of(names, MAX_NAMED)} {stays} at the start, since nothing drives it and what it lies on"
    return f"; {words} has no law in the plan"


def _of_ground(survey: ModelIndex, standing: Sequence[Pair]) -> str:
    masses = sorted({round(mass_of(survey, pair), 3) for pair in standing}, reverse=True)
    law = " and ".join(f"{mass:g} kg" for mass in masses[:3]) + (" and more" if len(masses) > 3 else "")
    phrase = f"contacts of {_pairs(len(standing))} with the ground are planned with a law for {law}"
    return phrase + _of_others(survey, standing)


def _of_others(survey: ModelIndex, modelled: Sequence[Pair]) -> str:
    others = len(survey.pairs) - len(modelled)
    return f"; {others} other pair{'s' * (others != 1)} must not touch" if others else ""


def _pairs(number: int) -> str:
    return f"{number} pair{'s' * (number != 1)}"


def falling_trees(survey: ModelIndex) -> dict[int, bool]:
    """The root bodies of trees that can fall, and whether an actuator drives anything in them."""
    model, home, joints = survey.model, survey.home, load_mujoco().mjtJoint
    gravity = gravity_of(model)
    if not np.any(gravity):
        return {}
    actuated = actuated_dofs(survey)
    held = actuated_dofs(survey, at_sites=False) | (model.jnt_stiffness[model.dof_jntid] > 0.0)
    found = {}
    for root in np.unique(model.body_rootid[model.dof_bodyid]):
        body = int(root)
        falls, tree = False, model.body_rootid == body
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            dof = int(model.jnt_dofadr[joint])
            if model.jnt_type[joint] == int(joints.mjJNT_FREE):
                falls = not (held[dof : dof + 6].any() or survey.carried_by_actuators(np.arange(dof, dof + 6)))
            elif model.jnt_type[joint] == int(joints.mjJNT_SLIDE):
                slope = abs(float(home.xaxis[joint] @ gravity))
                steep = bool(slope > _STEEP * np.linalg.norm(gravity))
                falls |= steep and not (held[dof] or survey.carried_by_actuators(np.array([dof])))
        weighs = 1.0 if no_compensation(model) else 1.0 - model.body_gravcomp[tree]  # what floats does not fall
        if falls and np.sum(model.body_mass[tree] * weighs) > _STEEP * model.body_mass[tree].sum():
            found[body] = bool(actuated[model.body_rootid[model.dof_bodyid] == root].any())
    return found


def actuated_dofs(survey: ModelIndex, at_sites: bool = True) -> np.ndarray:
    """(nv,) whether an actuator acts at a degree of freedom, directly, by a fixed tendon or at a site."""
    model = survey.model
    kinds, actuated = load_mujoco().mjtTrn, np.zeros(model.nv, dtype=bool)
    for i in range(len(model.actuator_trntype)):
        target = int(model.actuator_trnid[i, 0])
        if has_wrenches(model, i):
            for one in wrenches_of(survey, i) if at_sites else ():
                actuated[one.dofs] = True
        elif model.actuator_trntype[i] in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            actuated[model.dof_jntid == target] = True
        elif model.actuator_trntype[i] == int(kinds.mjTRN_TENDON):
            wraps = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            joints = model.wrap_type[wraps] == int(load_mujoco().mjtWrap.mjWRAP_JOINT)
            actuated[np.isin(model.dof_jntid, model.wrap_objid[wraps][joints])] = True
    return actuated


def _is_ground(survey: ModelIndex, flat: int) -> bool:
    """Whether a plane is level enough to stand on; others are walls."""
    plane, gravity = plane_of(survey, flat), np.array(survey.model.opt.gravity)
    return plane is not None and bool(-plane.normal @ gravity > LEVEL * np.linalg.norm(gravity))


def _lies_above(survey: ModelIndex, flat: int, other: int) -> bool:
    """Whether a geom is above the top of a box where the file puts it: beside a box its plane is no ground."""
    model, home, plane = survey.model, survey.home, plane_of(survey, flat)
    if plane is None:
        return False
    away = home.geom_xpos[other] - home.geom_xpos[flat]
    inside = np.abs(home.geom_xmat[flat].reshape(3, 3).T @ away) <= model.geom_size[flat]
    along = np.abs(home.geom_xmat[flat].reshape(3, 3).T @ plane.normal) < 0.5
    return bool(np.all(inside[along]) and home.geom_xpos[other] @ plane.normal > plane.offset)
