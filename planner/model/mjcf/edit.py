"""Take elements that are not modelled out of the XML, so that a replay simulates the plan's machine."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.model.mjcf.couplings import equalities_of, read_couplings
from planner.model.mjcf.model_index import field
from planner.model.mjcf.unsupported import UnsupportedElement

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
