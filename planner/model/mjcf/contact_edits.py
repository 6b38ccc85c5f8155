"""Give a law of planner.model.contact.laws to the contacts of an MJCF, so that MuJoCo replays with it; read stops.

Every pair of shapes that is modelled gets a <pair> of its own, whose numbers are those of contact_attributes; pairs
that are not modelled (meshes, boxes of two bodies that both move) are excluded and said to be.

Those numbers are relative to MuJoCo's body_invweight0, so a model whose inertias are changed needs others for the same
law: `keep_law` writes them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.contact.laws import ContactLaw, Law, Stop
from planner.model.mjcf.contact_shapes import add_points, meets_plane
from planner.model.mjcf.contacts import (
    CONTACT_LAW,
    OF_FILE,
    STOP_RAMP,
    direct_reason,
    law_attributes,
    shapes_fit,
    smoothing_of,
)
from planner.model.mjcf.file_law import (
    FILE_SMOOTHING,
    as_read,
    force_begins,
    has_square_rise,
    impedance_of,
    rates,
    turns_edges,
    watch,
)
from planner.model.mjcf.model_index import ModelIndex, Pair, disabled
from planner.model.mjcf.text import written

IMPRATIO = 1000.0  # at which MuJoCo's friction is the law's to a thousandth; beyond, its own inertia shows


def give_law(
    root: ElementTree.Element, survey: ModelIndex, law_of: Callable[[Pair], ContactLaw | None],
    numbers: Mapping[str, str], recesses: Mapping[tuple[int, int], float] | None = None, own: bool = False,
) -> list[Pair]:  # fmt: skip
    """Edit the XML so that its contacts have the laws of `law_of`; returns the contacts that are left out.

    The survey is of what the root compiles to. Pairs without a law, and of shapes that are not modelled, are excluded.
    Of an infinite impratio becomes IMPRATIO; all laws have the same one, and the same `numbers` by their names
    (CONTACT_RAMP, CONTACT_UNCERTAINTY).
    With `recesses` of pairs by their geoms, m, shapes with a margin get points that are larger by it, since there the
    file's own force begins, and smaller by the recess. With `own` contacts keep the file's own numbers, of which the
    laws are.
    """
    if not survey.pairs:
        return []
    model = survey.model
    body_names, geoms = _names(root, model)
    section, unmatched, points = _in_place_of_pairs(root), [], {}
    impratio, cone, leads = IMPRATIO, "elliptic", False
    for pair in survey.pairs:
        bodies = [int(model.geom_bodyid[geom]) for geom in pair.geoms]
        law, names = law_of(pair), [[geoms[geom].attrib["name"]] for geom in pair.geoms]
        margin = 0.0 if recesses is None or law is None else max(force_begins(model, pair), 0.0) - recesses[pair.geoms]
        fits = margin == 0.0 and shapes_fit(survey, pair) and not (own and turns_edges(survey, pair))
        match = None if law is None or fits else meets_plane(survey, pair.geoms)
        if law is None or not (fits or match):
            unmatched.append(pair)
            _exclude(root, section, *(body_names[body] for body in bodies))
            continue
        if match is not None:  # its points meet the plane in place of the shape
            flat, other = match
            if (other, margin) not in points:
                body = _body_of(root, geoms[other])
                points[other, margin] = add_points(geoms[other], body, model, other, margin, len(points))
            names = [[geoms[flat].attrib["name"]], points[other, margin]]
            _exclude(root, section, *(body_names[body] for body in bodies))
        impratio, leads = law.impratio if np.isfinite(law.impratio) else IMPRATIO, law.lead > 0.0
        cone = law.cone if leads else "elliptic"
        weight = float(np.sum(model.body_invweight0[bodies, 0]))
        attributes = _attributes(as_read(model, pair)) if own else law_attributes(law, weight, impratio)
        extent = {"margin": written(law.margin), "gap": "0"}
        for one, other in itertools.product(*names):
            both = {"geom1": one, "geom2": other}
            ElementTree.SubElement(section, "pair", {**both, **attributes, **extent})
    option = ElementTree.SubElement(root, "option", {} if own else {"cone": cone, "impratio": repr(impratio)})
    ElementTree.SubElement(option, "flag", {"refsafe": "disable"})  # for steps of any length
    for custom in root.findall("custom"):
        for element in [one for one in custom if one.get("name") in {*numbers, CONTACT_LAW}]:
            custom.remove(element)
    custom = ElementTree.SubElement(root, "custom")
    if leads:
        ElementTree.SubElement(custom, "text", {"name": CONTACT_LAW, "data": OF_FILE})
    for name, data in numbers.items():
        ElementTree.SubElement(custom, "numeric", {"name": name, "data": data})
    return unmatched


def _body_of(root: ElementTree.Element, element: ElementTree.Element) -> ElementTree.Element:
    """The body that an element is part of, if within frames."""
    while element.tag not in ("body", "worldbody"):
        element = next(parent for parent in root.iter() if any(child is element for child in parent))
    return element


def let_float(root: ElementTree.Element, model: Any, trees: Collection[int]) -> None:
    """Edit the XML so that gravity compensation carries trees of bodies, which are given by their roots."""
    bodies = [body for world in root.findall("worldbody") for body in _bodies(world)]
    if [body.get("name", "") for body in bodies] != [model.body(i).name for i in range(1, model.nbody)]:
        raise ModelError(
            "the file has not all bodies of the model (<attach>, <replicate>), so no object is held still."
        )
    for i, body in enumerate(bodies, 1):
        if int(model.body_rootid[i]) in trees:
            body.set("gravcomp", "1")


def keep_law(root: ElementTree.Element, survey: ModelIndex, weights: np.ndarray, still: np.ndarray) -> None:
    """Edit the XML so that its contacts keep their force when its bodies have other inertias, or their time constant.

    `weights` (nbody,) are body_invweight0[:, 0] of the model with the other inertias, 1/kg. What touches between two
    bodies that no force moves, `still` (nbody,), is watched.
    """
    model = survey.model
    geom_names = [element.attrib["name"] for element in elements_of_geoms(root, model)]
    section = _in_place_of_pairs(root)
    for pair in survey.pairs:
        bodies = [int(model.geom_bodyid[geom]) for geom in pair.geoms]
        if np.all(still[bodies]):
            watch(section, *(geom_names[geom] for geom in pair.geoms))
            continue
        ratio = float(np.sum(weights[bodies]) / np.sum(model.body_invweight0[bodies, 0]))
        geoms = {f"geom{i + 1}": geom_names[geom] for i, geom in enumerate(pair.geoms)}
        extent = {"margin": written(force_begins(model, pair)), "gap": "0"}
        ElementTree.SubElement(section, "pair", {**geoms, **_attributes(pair, ratio), **extent})


def _attributes(pair: Pair, ratio: float = 1.0) -> dict[str, str]:
    """The attributes of a <pair> with a pair's own numbers, where the invweight0 is larger by a ratio."""
    numbers = {
        "friction": pair.friction, "solref": _scaled(ratio, pair.solref),
        "solreffriction": _scaled(ratio, pair.solreffriction), "solimp": pair.solimp,
    }  # fmt: skip
    return {"condim": str(pair.condim), **{name: written(*values) for name, values in numbers.items()}}


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


def _names(root: ElementTree.Element, model: Any) -> tuple[list[str], list[ElementTree.Element]]:
    """Names of all bodies and the elements of all geoms, with names given to those that have none."""
    worlds = root.findall("worldbody")
    bodies = [body for world in worlds for body in _bodies(world)]
    geoms = [geom for parent in (*worlds, *bodies) for geom in _own(parent, "geom")]
    _named("body", bodies, [model.body(i).name for i in range(1, model.nbody)], 1)
    _named("geom", geoms, [model.geom(i).name for i in range(model.ngeom)], 0)
    return ["world", *(body.attrib["name"] for body in bodies)], geoms


def elements_of_geoms(root: ElementTree.Element, model: Any) -> list[ElementTree.Element]:
    """The elements of all geoms in MuJoCo's order, with names given to those that have none."""
    return _names(root, model)[1]


def joints_of(root: ElementTree.Element, model: Any) -> list[ElementTree.Element]:
    """The elements of all joints, in MuJoCo's order."""
    bodies = [body for world in root.findall("worldbody") for body in _bodies(world)]
    joints = [joint for body in bodies for joint in _own(body, "joint", "freejoint")]
    if [joint.get("name", "") for joint in joints] != [model.joint(j).name for j in range(model.njnt)]:
        raise ModelError("the file has not all joints of the model (<attach>, <replicate>), so none is driven.")
    return joints


def _named(kind: str, elements: list[ElementTree.Element], known: list[str], first: int) -> None:
    """Name the elements that have no name by MuJoCo's number of them."""
    if [element.get("name", "") for element in elements] != known:
        missing = f"the file has not all {kind}s of the model (<attach>, <replicate>)"
        raise ModelError(f"{missing}, so no law is given to it.")
    for i, element in enumerate(elements, first):
        if not element.get("name"):
            element.set("name", f"{kind} number {i}")


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


def read_stops(model: Any, undriven: Collection[int]) -> tuple[Stop, ...]:
    """The ends of ranges that press in the plan; `undriven`: the degrees of freedom that nothing drives.

    A joint whose numbers are those of `contacts.stop_attributes` has a plain spring and damper at the ends of its
    range, smoothed by the file's <numeric name="stop_ramp">. A joint that nothing drives leans on its stop: no control
    keeps it off. It has the force that MuJoCo computes from the file's numbers, a law with a lead, with
    model.mjcf.file_law's formulas and A = dof_invweight0. All other ranges are bounds of a plan.
    """
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
