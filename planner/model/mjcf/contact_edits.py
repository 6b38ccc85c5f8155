"""Give a law of planner.model.contact.laws to the contacts of an MJCF, so that MuJoCo replays with the plan's law.

Every pair of shapes that is modelled gets a <pair> of its own, whose numbers are those of contact_attributes; pairs
that are not modelled (meshes, boxes of two bodies that both move) are excluded and said to be.

Those numbers are relative to MuJoCo's body_invweight0, so a model whose inertias are changed needs others for the same
law: `keep_law` writes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.model.contact.laws import ContactLaw
from planner.model.mjcf.contacts import CONTACT_RAMP, contact_attributes, phrase_of, shapes_fit
from planner.model.mjcf.survey import Survey
from planner.model.mjcf.text import written

IMPRATIO = 1000.0  # at which MuJoCo's friction is the law's to a thousandth; beyond, its own inertia shows


def give_law(root: ElementTree.Element, survey: Survey, law: ContactLaw) -> list[str]:
    """Edit the XML so that its contacts have a law; returns the contacts that are left out, in one phrase or none.

    The survey is of what the root compiles to. Of an infinite impratio becomes IMPRATIO.
    """
    if not survey.pairs:
        return []
    model = survey.model
    impratio = law.impratio if np.isfinite(law.impratio) else IMPRATIO
    body_names, geom_names = _names(root, model)
    section, left_out = _in_place_of_pairs(root), []
    for pair in survey.pairs:
        bodies = [int(model.geom_bodyid[geom]) for geom in pair.geoms]
        if not shapes_fit(survey, pair):
            left_out.append(pair)
            _exclude(root, section, *(body_names[body] for body in bodies))
            continue
        weight = float(np.sum(model.body_invweight0[bodies, 0]))
        attributes = contact_attributes(law.stiffness, law.damping, law.slip_damping, law.friction, weight, impratio)
        geoms = {f"geom{i + 1}": geom_names[geom] for i, geom in enumerate(pair.geoms)}
        ElementTree.SubElement(section, "pair", {**geoms, **attributes, "margin": "0", "gap": "0"})
    option = ElementTree.SubElement(root, "option", {"cone": "elliptic", "impratio": repr(impratio)})
    ElementTree.SubElement(option, "flag", {"refsafe": "disable"})
    for custom in root.findall("custom"):
        for element in custom.findall(f"numeric[@name='{CONTACT_RAMP}']"):
            custom.remove(element)
    data = f"{law.ramp!r} {law.force_ramp!r} {law.bend!r}"
    ElementTree.SubElement(ElementTree.SubElement(root, "custom"), "numeric", {"name": CONTACT_RAMP, "data": data})
    return [phrase_of(model, left_out)] if left_out else []


def keep_law(root: ElementTree.Element, survey: Survey, weights: np.ndarray, still: np.ndarray) -> None:
    """Edit the XML so that its contacts keep their force when its bodies have other inertias, or their time constant.

    `weights` (nbody,) are body_invweight0[:, 0] of the model with the other inertias, 1/kg. What touches between two
    bodies that no force moves, `still` (nbody,), is excluded.
    """
    model = survey.model
    body_names, geom_names = _names(root, model)
    section = _in_place_of_pairs(root)
    for pair in survey.pairs:
        bodies = [int(model.geom_bodyid[geom]) for geom in pair.geoms]
        if np.all(still[bodies]):
            _exclude(root, section, *(body_names[body] for body in bodies))
            continue
        ratio = float(np.sum(weights[bodies]) / np.sum(model.body_invweight0[bodies, 0]))
        numbers = {
            "friction": pair.friction, "solref": _scaled(ratio, pair.solref),
            "solreffriction": _scaled(ratio, pair.solreffriction), "solimp": pair.solimp,
        }  # fmt: skip
        law = {name: written(*values) for name, values in numbers.items()}
        geoms = {f"geom{i + 1}": geom_names[geom] for i, geom in enumerate(pair.geoms)}
        extent = {"condim": str(pair.condim), "margin": written(pair.margin), "gap": "0"}
        ElementTree.SubElement(section, "pair", {**geoms, **law, **extent})


def _scaled(ratio: float, solref: np.ndarray) -> np.ndarray:
    """The numbers for other inertias; a time constant and a damping ratio are the same for all."""
    return solref if solref[0] > 0.0 else ratio * solref


def _in_place_of_pairs(root: ElementTree.Element) -> ElementTree.Element:
    """A new section for contacts, when all <pair>s are taken out of the old ones."""
    for section in root.findall("contact"):
        for element in section.findall("pair"):
            section.remove(element)
    return ElementTree.SubElement(root, "contact")


def _exclude(root: ElementTree.Element, section: ElementTree.Element, first: str, second: str) -> None:
    """Exclude contacts of two bodies, once; <pair>s stay."""
    known = {frozenset((e.get("body1"), e.get("body2"))) for s in root.findall("contact") for e in s.iter("exclude")}
    if frozenset((first, second)) not in known:
        ElementTree.SubElement(section, "exclude", {"body1": first, "body2": second})


def _names(root: ElementTree.Element, model: Any) -> tuple[list[str], list[str]]:
    """Names of all bodies and geoms, given to those that have none."""
    worlds = root.findall("worldbody")
    bodies = [body for world in worlds for body in _bodies(world)]
    geoms = [geom for parent in (*worlds, *bodies) for geom in _own(parent, "geom")]
    return (
        ["world", *_named("body", bodies, [model.body(i).name for i in range(1, model.nbody)])],
        _named("geom", geoms, [model.geom(i).name for i in range(model.ngeom)]),
    )


def joints_of(root: ElementTree.Element, model: Any) -> list[ElementTree.Element]:
    """The elements of all joints, in MuJoCo's order."""
    bodies = [body for world in root.findall("worldbody") for body in _bodies(world)]
    joints = [joint for body in bodies for joint in _own(body, "joint", "freejoint")]
    if [joint.get("name", "") for joint in joints] != [model.joint(j).name for j in range(model.njnt)]:
        raise ModelError("the file has not all joints of the model (<attach>, <replicate>), so none is driven.")
    return joints


def _named(kind: str, elements: list[ElementTree.Element], known: list[str]) -> list[str]:
    if [element.get("name", "") for element in elements] != known:
        missing = f"the file has not all {kind}s of the model (<attach>, <replicate>)"
        raise ModelError(f"{missing}, so no law is given to it.")
    for i, element in enumerate(elements):
        if not element.get("name"):
            element.set("name", f"{kind} number {i}")
    return [element.attrib["name"] for element in elements]


def _bodies(parent: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Bodies in MuJoCo's order: a body, then all that hang on it."""
    for child in parent:
        if child.tag == "body":
            yield child
        if child.tag in ("body", "frame"):
            yield from _bodies(child)


def _own(body: ElementTree.Element, *tags: str) -> Iterator[ElementTree.Element]:
    """A body's own elements of some kinds, without those of the bodies that hang on it."""
    for child in body:
        if child.tag in tags:
            yield child
        elif child.tag == "frame":
            yield from _own(child, *tags)
