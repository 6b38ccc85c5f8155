"""Take what is not modelled out of the XML, so that a replay simulates the machine that was planned with."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.model.mjcf.refuse import Refusal
from planner.model.mjcf.survey import field

# What the flags and options take out.
_OPTIONS: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "contacts": ({}, {"contact": "disable"}),
    "frictionloss": ({}, {"frictionloss": "disable"}),
    "equality": ({}, {"equality": "disable"}),
    "sleep": ({}, {"sleep": "disable"}),
    "fluid": ({"density": "0", "viscosity": "0"}, {}),
}
# Attributes without which an element does not do it.
_ATTRIBUTES = {
    "gravcomp": ("gravcomp",),
    "actearly": ("actearly",),
    "plasticity": ("springyield",),
    "mocap": ("mocap", "mpos", "mquat"),
}
_NO_TENDON = {"stiffness": "0", "damping": "0", "frictionloss": "0", "limited": "false"}


def take_out(root: ElementTree.Element, refusals: Collection[Refusal], model: Any) -> None:
    """Edit the XML so that nothing of these refusals' kinds acts any more; `model` is compiled from it."""
    # Settings that come later replace earlier ones, whatever sections the file has.
    kinds = {one.kind for one in refusals}
    options, flags = {}, {}
    for kind in kinds:
        option, flag = _OPTIONS.get(kind, ({}, {}))
        options.update(option)
        flags.update(flag)
    if options or flags:
        element = ElementTree.SubElement(root, "option", options)
        ElementTree.SubElement(element, "flag", flags)
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
    if "actuator" in kinds:
        _take_actuators_out(root, model, [one.index for one in refusals if one.kind == "actuator"])


def _take_actuators_out(root: ElementTree.Element, model: Any, out: list[int]) -> None:
    """Remove actuators, their numbers in keyframes and what refers to them."""
    n = len(model.actuator_trntype)
    elements = [(section, child) for section in root.findall("actuator") for child in section]
    names = [model.actuator(i).name for i in range(n)]
    if [child.get("name", "") for _, child in elements] != names:
        raise ModelError("the model's actuators are not all its own (<attach>, <replicate>), so none is taken out.")
    for i in out:
        elements[i][0].remove(elements[i][1])
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
    lost = {names[i] for i in out} - {""}
    for parent in list(root.iter()):
        for child in list(parent):
            refers = child.get("objname") if child.get("objtype") == "actuator" else child.get("actuator")
            if refers in lost:
                parent.remove(child)
