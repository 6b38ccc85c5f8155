"""Name the elements of a compiled model that change its motion and are not modelled, and take elements out of the XML.

Elements that are taken out of the plan's text are not simulated in its replay either.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.equalities import (
    acting,
    closes,
    equalities_of,
    fixed,
    held_tendons,
    is_linear,
    kind_of,
    read_couplings,
)
from planner.model.mjcf.joint_forces import (
    actuator_disabled,
    adheres_to_nothing,
    affine_force,
    has_wrenches,
    law_of,
    unknown_force,
)
from planner.model.mjcf.model_index import disabled, field, flag_bit, kind_word, named

# Kinds that `ignore` may name.
KINDS = (
    "frictionloss", "equality", "tendon", "fluid", "gravcomp", "actuator", "actearly", "polynomial", "plasticity",
    "mocap", "sleep",
)  # fmt: skip

MODELLED = ("stiffness", "damping", "limit")  # of fixed tendons


@dataclass(frozen=True)
class UnsupportedElement:
    """One thing that is not modelled."""

    kind: str  # "contacts", one of KINDS, or another kind that nothing takes out
    phrase: str  # Its name for a sentence
    index: int = -1  # Of an actuator or equality; -1 for other things
    feature: str = ""  # What of an element it is, such as "plastic spring"; "" for the element itself
    noun: str = ""  # Kind of that element, such as "joint"


def passive_off(model: Any) -> bool:
    """Whether passive forces of all kinds are disabled: since MuJoCo 3.4 by two flags, before by one."""
    return disabled(model, "passive") or (disabled(model, "spring") and disabled(model, "damper"))


def no_compensation(model: Any) -> bool:
    """Whether a flag keeps gravity compensation from acting, or there is no gravity."""
    return passive_off(model) or disabled(model, "gravity") or not np.any(model.opt.gravity)


def _fluids(model: Any) -> list[str]:
    """The properties that a fluid around the bodies has, if it acts."""
    return [] if passive_off(model) else [name for name in ("density", "viscosity") if getattr(model.opt, name) > 0.0]


def _compensated(model: Any) -> np.ndarray:
    """(nbody,) whether a share of the weight of a body is carried, and that matters."""
    return (model.body_gravcomp != 0.0) & (model.body_weldid != 0) & (model.body_mass > 0.0)


def _nonzero(model: Any, name: str, count: int) -> np.ndarray:
    """(count,) whether an element has any number other than 0 in a field, which may have several for each."""
    values = field(model, name, count)
    return np.any(values != 0.0, axis=tuple(range(1, values.ndim)))


def unsupported_elements(model: Any) -> Iterator[UnsupportedElement]:
    """Everything in a compiled model but its contacts that acts and is not modelled, in a fixed order."""
    yield from _joints(model)
    yield from _bodies(model)
    yield from _of_tendons(model, modelled=False)
    for i in acting(model):
        if not (is_linear(model, i) or closes(model, i)):
            yield UnsupportedElement("equality", f"{named(model, 'equality', i)} ({kind_of(model, i)})", i)
    for i in range(len(model.actuator_trntype)):
        yield from _actuators(model, i)
    if model.opt.enableflags & flag_bit("Enable", "ENBL", "sleep"):
        yield UnsupportedElement("sleep", "the sleep of what rests")
    for i in range(model.nflex):
        yield UnsupportedElement("flex", named(model, "flex", i))


def modelled(model: Any) -> Iterator[UnsupportedElement]:
    """What is modelled and that `ignore` takes out all the same: friction, gravcomp, fluids, fixed tendons, loops."""
    if not disabled(model, "constraint", "frictionloss"):
        for i in _joints_of(model, model.dof_frictionloss):
            yield _feature(model, "frictionloss", "frictionloss", "joint", i)
    for i in () if no_compensation(model) else np.flatnonzero(_compensated(model)):
        yield _feature(model, "gravcomp", "gravcomp", "body", int(i))
    yield from (UnsupportedElement("fluid", f"fluid {name}") for name in _fluids(model))
    yield from _of_tendons(model, modelled=True)
    for i in acting(model):
        if closes(model, i):
            yield UnsupportedElement("equality", f"{named(model, 'equality', i)} ({kind_of(model, i)})", i)


def _feature(model: Any, kind: str, feature: str, noun: str, index: int) -> UnsupportedElement:
    return UnsupportedElement(kind, f"{feature} of {named(model, noun, index)}", feature=feature, noun=noun)


def _joints(model: Any) -> Iterator[UnsupportedElement]:
    if not disabled(model, "spring", "passive"):
        for i in np.flatnonzero(_nonzero(model, "jnt_stiffnesspoly", model.njnt)):
            yield _feature(model, "polynomial", "polynomial stiffness", "joint", int(i))
        for i in np.flatnonzero(field(model, "jnt_springyield", model.njnt)):
            yield _feature(model, "plasticity", "plastic spring", "joint", int(i))
    if not disabled(model, "damper", "passive"):
        for i in _joints_of(model, _nonzero(model, "dof_dampingpoly", model.nv)):
            yield _feature(model, "polynomial", "polynomial damping", "joint", i)


def _joints_of(model: Any, dofs: np.ndarray) -> list[int]:
    return sorted({int(j) for j in model.dof_jntid[np.flatnonzero(dofs)]})


def _bodies(model: Any) -> Iterator[UnsupportedElement]:
    if not no_compensation(model):
        clamped = np.zeros(model.njnt, dtype=bool)
        if np.any(_compensated(model)):  # then the force is an actuator's, which a clamp or a flag can take away
            clamped = np.asarray(field(model, "jnt_actgravcomp", model.njnt), dtype=bool)
            clamped &= np.asarray(model.jnt_actfrclimited, dtype=bool) | disabled(model, "actuation")
        for i in np.flatnonzero(clamped):
            yield _feature(model, "gravcomp", "clamped actuatorgravcomp", "joint", int(i))
    if not passive_off(model):
        ellipsoids = np.flatnonzero(model.geom_fluid[:, 0] > 0.0) if _fluids(model) else ()
        for i in ellipsoids:
            yield _feature(model, "fluid", "ellipsoid fluid forces", "geom", int(i))
        if _fluids(model) and np.any(model.opt.wind):
            yield UnsupportedElement("fluid", "fluid wind")
    carries = set(model.body_weldid[model.dof_bodyid]) | set(model.body_rootid[model.dof_bodyid])
    for i in np.flatnonzero(model.body_mocapid >= 0):
        if int(i) in carries:
            yield UnsupportedElement("mocap", f"mocap {named(model, 'body', int(i))}")
    for i in np.flatnonzero(model.body_plugin >= 0):
        yield _feature(model, "plugin", "plugin", "body", int(i))


def _effects(model: Any) -> dict[str, np.ndarray]:
    """(ntendon,) bool by name: what acts along tendons."""
    n = model.ntendon

    def acts(name: str, *flags: str) -> np.ndarray:
        return np.zeros(n, dtype=bool) if flags and disabled(model, *flags) else _nonzero(model, f"tendon_{name}", n)

    return {
        "stiffness": acts("stiffness", "spring", "passive"), "damping": acts("damping", "damper", "passive"),
        "polynomial stiffness": acts("stiffnesspoly", "spring", "passive"),
        "polynomial damping": acts("dampingpoly", "damper", "passive"), "armature": acts("armature"),
        "frictionloss": acts("frictionloss", "constraint", "frictionloss"),
        "limit": acts("limited", "constraint", "limit"),
    }  # fmt: skip


def _of_tendons(model: Any, modelled: bool) -> Iterator[UnsupportedElement]:
    """What acts along tendons and is modelled, or is not: of fixed tendons, only what is named here."""
    effects = _effects(model)
    held = held_tendons(model)
    for i in range(model.ntendon):
        known = MODELLED if fixed(model, i) else ()
        effects["frictionloss"][i] &= i not in held  # what never slides does not rub
        has = [name for name, acts in effects.items() if acts[i] and (name in known) == modelled]
        if has == ["frictionloss"]:
            yield _feature(model, "frictionloss", "frictionloss", "tendon", i)
        elif has:
            yield _feature(model, "tendon", ", ".join(has), "tendon", i)


def _actuators(model: Any, i: int) -> Iterator[UnsupportedElement]:
    """An actuator's refusals. One that is disabled keeps its control, if it has one control and one state at most."""
    mujoco = load_mujoco()
    n = len(model.actuator_trntype)
    name = named(model, "actuator", i)
    several = (
        field(model, "actuator_ctrlnum", 0).size and model.actuator_ctrlnum[i] != 1,
        field(model, "actuator_outnum", 0).size and model.actuator_outnum[i] != 1,
        model.actuator_actadr[i] >= 0 and model.actuator_actnum[i] != 1,
        model.actuator_plugin[i] >= 0,
    )
    reasons: list[str] = []
    if any(several) or not actuator_disabled(model, i):
        reasons = [*_dynamics(model, i), *unknown_force(model, i), *_transmission(model, i)]
    if any(several) and not reasons:
        reasons = ["several controls, forces or activations"]
    if field(model, "actuator_delay", n)[i] > 0.0:
        reasons.append("delay")
    at_joint = _is(model.actuator_trntype[i], mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for own in ("damping", "armature"):
        if field(model, f"actuator_{own}", n)[i] != 0.0 and not at_joint:
            reasons.append(f"{own} of its own")
    if _nonzero(model, "actuator_dampingpoly", n)[i]:
        yield _feature(model, "polynomial", "polynomial damping", "actuator", i)
    if reasons:
        yield UnsupportedElement("actuator", f"{name} ({', '.join(reasons)})", i)
    elif model.actuator_actearly[i] and not actuator_disabled(model, i):
        yield _feature(model, "actearly", "actearly", "actuator", i)


def _is(value: int, *kinds: Any) -> bool:
    return any(value == kind for kind in kinds)  # MuJoCo's enumerations do not equal NumPy's integers from the left


def _dynamics(model: Any, i: int) -> Iterator[str]:
    kinds = load_mujoco().mjtDyn
    # filterexact is the same differential equation as filter, solved better by MuJoCo's Euler steps
    modelled = (kinds.mjDYN_NONE, kinds.mjDYN_INTEGRATOR, kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT)
    if not _is(model.actuator_dyntype[i], *modelled):
        yield f"{kind_word(kinds, model.actuator_dyntype[i])} dynamics"


def _transmission(model: Any, i: int) -> Iterator[str]:
    """Reasons why an actuator's moment is neither a constant row nor that of wrenches, or its length not supported."""
    mujoco = load_mujoco()
    kinds, joints = mujoco.mjtTrn, mujoco.mjtJoint
    kind, target = model.actuator_trntype[i], model.actuator_trnid[i, 0]
    (_, bias), law = affine_force(model, i), law_of(model, i)
    if has_wrenches(model, i):
        if law or np.any(bias[1:]):
            what = "a site" if kind == kinds.mjTRN_SITE else "a jointinparent"
            yield f"force by the position or velocity of {what}"
    elif _is(kind, kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
        joint = model.jnt_type[target]
        if joint == joints.mjJNT_BALL and (law or bias[1] != 0.0):
            yield "force by the angle of a ball joint"
        elif joint == joints.mjJNT_FREE and law:
            yield "force by the velocity of a free joint"
    elif kind == kinds.mjTRN_TENDON:
        first = model.wrap_type[model.tendon_adr[target]]
        if first != mujoco.mjtWrap.mjWRAP_JOINT:
            yield "spatial tendon"
    elif not adheres_to_nothing(model, i):
        yield f"{kind_word(kinds, kind)} transmission"


# Options and flags that switch a kind off.
_OPTIONS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "contacts": ({}, {"contact": "disable"}),
    "frictionloss": ({}, {"frictionloss": "disable"}),
    "sleep": ({}, {"sleep": "disable"}),
    "fluid": ({"density": "0", "viscosity": "0"}, {}),
}
# Attributes that are deleted to switch a kind off.
_ATTRIBUTES = {
    "gravcomp": ("gravcomp",), "actearly": ("actearly",), "plasticity": ("springyield",),
    "mocap": ("mocap", "mpos", "mquat"),
}  # fmt: skip
_NO_TENDON = {"stiffness": "0", "damping": "0", "frictionloss": "0", "limited": "false"}


def take_out(root: ElementTree.Element, refusals: Collection[UnsupportedElement], model: Any) -> None:
    """Edit the XML so that nothing of these refusals' kinds acts any more; `model` is compiled from it."""
    # Settings that come later replace earlier ones, whatever sections the file has.
    kinds = {one.kind for one in refusals}
    acting = [both for kind, both in _OPTIONS.items() if kind in kinds]  # in one order, for the same text every time
    options, flags = ({name: value for both in acting for name, value in both[i].items()} for i in (0, 1))
    if acting:
        ElementTree.SubElement(ElementTree.SubElement(root, "option", options), "flag", flags)
    gone = {name for kind in kinds for name in _ATTRIBUTES.get(kind, ())}
    for element in root.iter():
        for name in gone & set(element.attrib):
            del element.attrib[name]
        if "polynomial" in kinds:
            for name in {"stiffness", "damping"} & set(element.attrib):
                element.set(name, element.attrib[name].split()[0])
    if "tendon" in kinds:
        for tendon in root.iterfind("tendon/*"):
            tendon.attrib.pop("springyield", None)
            tendon.attrib.update(_NO_TENDON)
            if np.any(field(model, "tendon_armature", 0)):  # older releases do not know the attribute
                tendon.set("armature", "0")
    if "equality" in kinds:
        _switch_off(root, model, [one.index for one in refusals if one.kind == "equality"])
    if "actuator" in kinds:
        _take_actuators_out(root, model, [one.index for one in refusals if one.kind == "actuator"])


def _switch_off(root: ElementTree.Element, model: Any, out: list[int]) -> None:
    """Switch equalities off; others stay, if the text has them all."""
    elements = equalities_of(root, model)
    for i in out if elements else ():
        elements[i].set("active", "false")
    if not elements:
        if read_couplings(model):
            raise ModelError(
                "the model's equalities are not all its own (<attach>, <replicate>), so none is taken out while others "
                'stay, expected active="false" in the file.'
            )
        flags = {"equality": "disable"}
        ElementTree.SubElement(ElementTree.SubElement(root, "option"), "flag", flags)


def actuators_of(root: ElementTree.Element, model: Any, so: str) -> list[ElementTree.Element]:
    """The elements of all actuators in MuJoCo's order; a ModelError that ends with `so` where the file has not all."""
    elements = [element for section in root.findall("actuator") for element in section]
    names = [model.actuator(i).name for i in range(len(model.actuator_trntype))]
    if [element.get("name", "") for element in elements] != names:
        raise ModelError(f"the model's actuators are not all its own (<attach>, <replicate>), so {so}.")
    return elements


def _take_actuators_out(root: ElementTree.Element, model: Any, out: list[int]) -> None:
    """Remove actuators, their numbers in keyframes and what refers to them."""
    n, elements = len(model.actuator_trntype), actuators_of(root, model, "none is taken out")
    for section in root.findall("actuator"):
        for element in {*section} & {elements[i] for i in out}:
            section.remove(element)
    first = model.actuator_ctrladr if hasattr(model, "actuator_ctrladr") else np.arange(n)
    count = model.actuator_ctrlnum if hasattr(model, "actuator_ctrlnum") else np.ones(n, dtype=int)
    removed = {
        "ctrl": {int(first[i]) + k for i in out for k in range(int(count[i]))},
        "act": {int(model.actuator_actadr[i]) + k for i in out for k in range(int(model.actuator_actnum[i]))},
    }
    for key in root.iterfind("keyframe/key"):
        for attribute, places in removed.items():
            if attribute in key.attrib:
                numbers = key.attrib.pop(attribute).split()
                kept = [number for k, number in enumerate(numbers) if k not in places]
                if kept:
                    key.set(attribute, " ".join(kept))
    lost = {model.actuator(i).name for i in out} - {""}
    for parent in list(root.iter()):
        for child in list(parent):
            refers = child.get("objname") if child.get("objtype") == "actuator" else child.get("actuator")
            if refers in lost:
                parent.remove(child)
