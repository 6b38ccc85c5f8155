"""What differs between two models as MuJoCo compiles them, by the names of their elements and in numbers.

Only numbers that change a motion count: no colours, materials or groups, and nothing that the compiler derives.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.model.mjcf.model_index import compile_model, named, names_of

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
                one, other = (_of_dofs(m, field, i) for m, i in ((old, before[name]), (new, now[name])))
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


def _of_dofs(model: Any, field: str, joint: int) -> np.ndarray:
    return np.asarray(getattr(model, f"dof_{field}"))[model.dof_jntid == joint]


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
