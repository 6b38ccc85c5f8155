"""Facts of a compiled MJCF file as plain records, whether a plan can be made with it or not, and what differs in two.

Differences are named by elements and in numbers. Only those that change a motion count: no colours, materials or
groups, and nothing that the compiler derives.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.contact_mode import actuated_dofs, machine_roots
from planner.model.mjcf.equalities import acting, joined, joins
from planner.model.mjcf.joint_forces import actuator_disabled
from planner.model.mjcf.model_index import ModelIndex, compile_model, disabled, kind_word, named, names_of

Record = dict[str, Any]
_UPRIGHT = 0.7  # vertical part of a slide that gravity pulls down


def joint_records(model: Any) -> list[Record]:
    """Name, kind, unit and numbers of every joint, the largest of its axes; None where it has none."""
    limits = not disabled(model, "constraint", "limit")
    records: list[Record] = []
    for j in range(model.njnt):
        dofs = slice(model.jnt_dofadr[j], model.jnt_dofadr[j + 1] if j + 1 < model.njnt else model.nv)
        kind = kind_word(load_mujoco().mjtJoint, model.jnt_type[j])
        stiffness = float(model.jnt_stiffness[j]) * (not disabled(model, "spring", "passive"))
        place = int(model.jnt_qposadr[j])
        records.append({
            "name": model.joint(j).name, "label": named(model, "joint", j), "kind": kind,
            "unit": {"hinge": "rad", "slide": "m"}.get(kind, ""), "position": place,
            "range": [float(x) for x in model.jnt_range[j]] if limits and model.jnt_limited[j] else None,
            "damping": _most(model.dof_damping[dofs]), "armature": _most(model.dof_armature[dofs]),
            "friction_loss": _most(model.dof_frictionloss[dofs]), "stiffness": stiffness or None,
            "spring_rest": float(model.qpos_spring[place]) if stiffness and kind in ("hinge", "slide") else None,
            "inertia": float(np.min(model.dof_M0[dofs])),
        })  # fmt: skip
    return records


def _most(values: np.ndarray) -> float | None:
    largest = float(np.max(np.abs(values), initial=0.0))
    return largest or None


def body_records(model: Any) -> list[Record]:
    """Name, mass in kg and principal inertias in kg m^2 of every body that has mass, and whether it moves."""
    return [
        {
            "name": model.body(b).name, "mass": float(model.body_mass[b]), "moves": bool(model.body_weldid[b]),
            "inertia": [float(x) for x in model.body_inertia[b]],
        }
        for b in range(1, model.nbody) if model.body_mass[b] > 0.0
    ]  # fmt: skip


def actuator_records(model: Any) -> list[Record]:
    """Name, kind, target and ranges of every actuator."""
    clamped = not disabled(model, "clampctrl")
    records: list[Record] = []
    for i in range(len(model.actuator_trntype)):
        force = model.actuator_forcerange[i] if model.actuator_forcelimited[i] else None
        control = model.actuator_ctrlrange[i] if clamped and model.actuator_ctrllimited[i] else None
        records.append({
            "name": model.actuator(i).name, "kind": _kind(model, i), "acts_on": _target(model, i),
            "control_range": None if control is None else [float(x) for x in control],
            "force_range": None if force is None else [float(x) for x in force],
        })  # fmt: skip
    return records


def _kind(model: Any, i: int) -> str:
    mujoco = load_mujoco()
    dynamics = kind_word(mujoco.mjtDyn, model.actuator_dyntype[i])
    gain, bias = (kind_word(kind, value) for kind, value in (
        (mujoco.mjtGain, model.actuator_gaintype[i]), (mujoco.mjtBias, model.actuator_biastype[i])
    ))  # fmt: skip
    kp, kv = (float(x) for x in model.actuator_biasprm[i, 1:3])
    if actuator_disabled(model, i):
        return "switched off"
    if "muscle" in (dynamics, gain, bias):
        return "muscle"
    if bias == "affine" and kp:
        kind = "velocity servo" if dynamics == "integrator" else "position servo"
        return f"{kind}, kp {-kp:g}" + (f", kv {-kv:g}" if kv else "")
    if bias == "affine" and kv:
        return f"velocity servo, kv {-kv:g}"
    if gain == "affine" and np.any(model.actuator_gainprm[i, 1:3]):
        return "damper"
    kind = "motor" if gain in ("fixed", "affine") and bias in ("none", "affine") else f"{gain} gain, {bias} bias"
    return kind if dynamics == "none" else f"{kind} behind a {dynamics}"


def _target(model: Any, i: int) -> str:
    """The joint, tendon, site or body on which an actuator acts."""
    kind = kind_word(load_mujoco().mjtTrn, model.actuator_trntype[i])
    element = {"jointinparent": "joint", "slidercrank": "site"}.get(kind, kind)
    return kind if element == "undefined" else named(model, element, int(model.actuator_trnid[i, 0]))


class Overlap(NamedTuple):
    """Two bodies whose shapes are within each other."""

    shapes: str  # "geom 'foot' and geom 'floor'"
    bodies: tuple[str, str]
    depth: float  # m


def overlaps(model: Any, qpos: np.ndarray) -> list[Overlap]:
    """The deepest overlap of each two bodies whose shapes are within each other at a pose (nq,)."""
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    found: dict[tuple[int, int], Overlap] = {}
    for contact in data.contact[: data.ncon]:
        geoms = [int(g) for g in contact.geom]
        if min(geoms) < 0 or contact.dist >= 0.0:
            continue
        bodies = tuple(int(model.geom_bodyid[g]) for g in geoms)
        one = Overlap(
            " and ".join(named(model, "geom", g) for g in geoms),
            (model.body(bodies[0]).name, model.body(bodies[1]).name), -float(contact.dist),
        )  # fmt: skip
        key = (min(bodies), max(bodies))
        if key not in found or one.depth > found[key].depth:
            found[key] = one
    return sorted(found.values(), key=lambda one: -one.depth)


def has_ground(model: Any) -> bool:
    """Whether a shape of the world may carry what stands on it."""
    still = (model.body_weldid[model.geom_bodyid] == 0) & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    return bool(np.any(still))


def free_bases(model: Any) -> list[str]:
    """Names of machines' bodies that nothing holds up: on a free joint, or an upright slide without spring or actuator.

    Objects beside a machine do not count. Those that a connect or a weld joins to the world, or to
    what is held, are held too.
    """
    survey = ModelIndex(model)
    kinds, found = load_mujoco().mjtJoint, list[int]()
    for j in range(model.njnt):
        body = int(model.jnt_bodyid[j])
        upright = model.jnt_type[j] == kinds.mjJNT_SLIDE and abs(model.jnt_axis[j, 2]) > _UPRIGHT
        held = survey.carried_by_actuators(model.dof_jntid == j) or (upright and model.jnt_stiffness[j] > 0.0)
        loose = upright and model.body_weldid[model.body_parentid[body]] == 0
        if (model.jnt_type[j] == kinds.mjJNT_FREE or loose) and not held and body not in found:
            found.append(body)
    free = {int(model.body_rootid[body]) for body in found} & machine_roots(survey)
    pairs = [{int(model.body_rootid[one]) for one in joined(model, i)[0]} for i in acting(model) if joins(model, i)]
    for _ in pairs:  # along chains of trees
        free -= {root for pair in pairs if pair - free for root in pair}
    return [named(model, "body", body) for body in found if int(model.body_rootid[body]) in free]


def has_moving_base(survey: ModelIndex) -> bool:
    """Whether all that is driven moves in space or in a plane: on a body with a free joint, or slides and turns.

    Where nothing is driven, whether all that moves does. Objects beside a machine do not count.
    """
    model, kinds, driven = survey.model, load_mujoco().mjtJoint, actuated_dofs(survey)
    first = np.arange(model.nbody)  # of each body, the one in the world that moves and carries it
    for body, parent in enumerate(model.body_parentid):
        if model.body_weldid[parent] != 0:
            first[body] = first[parent]
    glides = model.jnt_bodyid[np.isin(model.jnt_type, (kinds.mjJNT_FREE, kinds.mjJNT_SLIDE))]
    moving = (model.body_dofnum >= 3) & np.isin(np.arange(model.nbody), glides)
    return bool(np.all(moving[first[model.dof_bodyid[driven if driven.any() else slice(None)]]]))


def moving_mass(model: Any) -> float:
    """The mass of all bodies that move, kg."""
    return float(np.sum(model.body_mass[model.body_weldid != 0]))


ROUNDING = 1e-12  # relative: the same text compiles to the same numbers but for these

KINDS = {"body": "body", "joint": "jnt", "geom": "geom", "site": "site", "tendon": "tendon", "actuator": "actuator",
         "equality": "eq"}  # fmt: skip
_COUNTS = {"joint": "njnt", "actuator": "nu", "equality": "neq"}
_FIELDS = {
    "body": ("mass", "ipos", "inertia", "iquat", "pos", "quat", "gravcomp", "mocapid"),
    "joint": ("type", "pos", "axis", "range", "limited", "stiffness", "margin", "solref", "solimp", "actfrcrange",
              "actfrclimited", "actgravcomp"),
    "geom": ("type", "size", "pos", "quat", "contype", "conaffinity", "condim", "friction", "margin", "gap", "solref",
             "solimp", "priority", "solmix", "fluid"),
    "site": ("pos", "quat"),
    "tendon": ("range", "limited", "stiffness", "damping", "frictionloss", "armature", "lengthspring", "margin",
               "solref_lim", "solref_fri", "actfrcrange", "actfrclimited"),
    "actuator": ("trntype", "dyntype", "gaintype", "biastype", "gear", "gainprm", "biasprm", "dynprm", "ctrlrange",
                 "ctrllimited", "forcerange", "forcelimited", "actrange", "actlimited", "actearly", "delay"),
    "equality": ("type", "active0", "data", "solref", "solimp"),
}  # fmt: skip
_OF_DOFS = ("damping", "armature", "frictionloss")
_OPTIONS = ("gravity", "timestep", "integrator", "wind", "density", "viscosity", "cone", "impratio", "disableflags",
            "enableflags", "disableactuator")  # fmt: skip
_WORDS = {
    "ipos": "centre of mass", "iquat": "axes of inertia", "pos": "position", "quat": "orientation",
    "frictionloss": "friction loss", "ctrlrange": "control range", "forcerange": "force range", "data": "numbers",
    "active0": "activity", "gainprm": "gain", "biasprm": "bias",
}  # fmt: skip


def model_changes(old: str, new: str, old_files: dict[str, bytes], new_files: dict[str, bytes]) -> tuple[str, ...]:
    """Sentences about all that changed from an old text to a new one: "mass of body 'b1' is 6, was 5 (+20 %)".

    Raises:
        ModelError: MuJoCo refuses one of the two.
    """
    if old == new and old_files == new_files:
        return ()
    first, second = compile_model(old, old_files), compile_model(new, new_files)
    return tuple(_changes(first, second))


def _changes(old: Any, new: Any) -> Iterator[str]:
    for option in _OPTIONS:
        yield from _difference(f"{option} of the model", getattr(old.opt, option), getattr(new.opt, option))
    for kind, prefix in KINDS.items():
        before, now = _by_name(old, kind), _by_name(new, kind)
        yield from (f"{name} is new" for name in now if name not in before)
        yield from (f"{name} is gone" for name in before if name not in now)
        for name in (name for name in before if name in now):
            for field in _FIELDS[kind]:
                one, other = (_value(m, prefix, field, i) for m, i in ((old, before[name]), (new, now[name])))
                yield from _difference(f"{_WORDS.get(field, field)} of {name}", one, other)
            for field in _OF_DOFS if kind == "joint" else ():
                one, other = (
                    getattr(m, f"dof_{field}")[m.dof_jntid == i] for m, i in ((old, before[name]), (new, now[name]))
                )
                yield from _difference(f"{_WORDS.get(field, field)} of {name}", one, other)
    for what, one, other in _structures(old, new):
        yield from _difference(what, one, other)


def _by_name(model: Any, kind: str) -> dict[str, int]:
    """Elements by their names in a sentence; those without one by their place, in their body if they have one."""
    found, bodies = {}, getattr(model, f"{KINDS[kind]}_bodyid", None)
    names = names_of(model, kind, getattr(model, _COUNTS.get(kind, f"n{kind}")))
    for i, name in enumerate(names):
        if name or bodies is None:
            found[named(model, kind, i)] = i
        else:
            place = int(np.count_nonzero(bodies[:i] == bodies[i]))
            found[f"{kind} number {place} of {named(model, 'body', int(bodies[i]))}"] = i
    return found


def _value(model: Any, prefix: str, field: str, index: int) -> np.ndarray:
    values = getattr(model, f"{prefix}_{field}", None)  # releases of MuJoCo have different fields
    return np.zeros(0) if values is None else np.atleast_1d(values[index]).astype(float)


def _structures(old: Any, new: Any) -> Iterator[tuple[str, Any, Any]]:
    """What is no number of one element: what carries or moves what, meshes, explicit and excluded contacts, rest."""
    yield "springs' rest and the initial pose", *((m.qpos_spring, m.qpos0) for m in (old, new))
    yield "what carries what", *((names_of(m, "body", m.nbody), m.body_parentid, m.jnt_bodyid) for m in (old, new))
    yield (
        "what actuators and tendons move",
        *((m.actuator_trnid, m.wrap_type, m.wrap_objid, m.wrap_prm, m.tendon_adr) for m in (old, new)),
    )
    yield "the shape of a mesh", *((m.mesh_vert, m.hfield_data) for m in (old, new))
    yield (
        "explicit or excluded contacts",
        *(
            (m.exclude_signature, m.pair_geom1, m.pair_geom2, m.pair_friction, m.pair_solref, m.pair_margin)
            for m in (old, new)
        ),
    )


def _difference(what: str, old: Any, new: Any) -> Iterator[str]:
    """A sentence about two values that differ, by their numbers where there are as many."""
    if isinstance(old, tuple):
        same = all(np.shape(a) == np.shape(b) and not _far(a, b).any() for a, b in zip(old, new, strict=True))
        if not same:
            yield f"{what} changed"
        return
    one, other = np.atleast_1d(old).astype(float), np.atleast_1d(new).astype(float)
    if one.shape != other.shape:
        yield f"{what} changed"
    elif (far := _far(one, other)).any():
        worst = int(np.argmax(np.where(far, np.abs(other - one), -1.0)))
        a, b = float(one.flat[worst]), float(other.flat[worst])
        which = f"[{worst}]" if one.size > 1 else ""
        share = f" ({100.0 * (b - a) / abs(a):+.3g} %)" if a else ""
        yield f"{what}{which} is {b:.6g}, was {a:.6g}{share}"


def _far(a: Any, b: Any) -> np.ndarray:
    one, other = np.asarray(a), np.asarray(b)
    if one.dtype.kind in "US":
        return one != other
    largest = np.maximum(np.abs(one), np.abs(other))
    return ~((np.abs(one - other) <= ROUNDING * largest) | (np.isnan(one) & np.isnan(other)))
