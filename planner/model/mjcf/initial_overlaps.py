"""Shapes that overlap where a motion starts: found, and taken out of a text pair by pair.

Models of others draw a base into the link that turns on it, and MuJoCo presses the two apart. Nobody means that, so
these pairs are left out of the user's file and named; each shape goes on to touch all others, with the law that it had.
A link that starts inside of a thing at rest which it can leave is in collision: that is no way of drawing.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.contact_edits import elements_of_geoms
from planner.model.mjcf.contact_mode import falling_trees
from planner.model.mjcf.model_index import ModelIndex
from planner.model.mjcf.reachable_collisions import can_separate
from planner.model.mjcf.text import written

OVERLAP_TOLERANCE = 1e-4  # of a machine of 1 m or more, m: shapes that are drawn flush touch as soon as anything moves
GeomPair = frozenset[int]


def initial_overlaps(model: Any, qpos: np.ndarray) -> list[GeomPair]:
    """The pairs of geoms that overlap or lie flush at qpos, but for what falls without the contact, or can leave it."""
    mujoco, survey = load_mujoco(), ModelIndex(model)
    falling, flush = falling_trees(survey), OVERLAP_TOLERANCE * min(1.0, float(model.stat.extent))
    model = copy.copy(model)
    model.geom_margin += flush
    model.pair_margin += flush
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    found: dict[GeomPair, None] = {}
    for c in range(data.ncon):
        contact = data.contact[c]
        geoms = [int(geom) for geom in contact.geom]
        if min(geoms) < 0 or contact.includemargin < contact.dist:
            continue
        if contact.dist < -flush and can_separate(survey, (geoms[0], geoms[1]), qpos, flush):
            continue
        roots = set(model.body_rootid[model.geom_bodyid[geoms]].tolist())
        if len(roots) == 1 or falling.keys().isdisjoint(roots):
            found[frozenset(geoms)] = None
    return list(found)


def without_pairs(text: str, model: Any, pairs: Collection[GeomPair]) -> str:
    """The text without the contact of some pairs of geoms; `model` is what it compiles to.

    One shape of each pair touches nothing by its masks any more, and gets a <pair> with all others that it touched.

    Raises:
        ModelError: The file has not all geoms of the model (<attach>, <replicate>).
    """
    root, survey = ElementTree.fromstring(text), ModelIndex(model)
    elements = elements_of_geoms(root, model)
    silent, left = set(), set(pairs)
    while left:
        often = Counter(geom for pair in left for geom in pair)
        silent.add(max(often, key=lambda geom: (often[geom], int(model.body_weldid[model.geom_bodyid[geom]]))))
        left = {pair for pair in left if not pair & silent}
    explicit = {frozenset(both) for both in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    for geom in silent:
        elements[geom].attrib.update(contype="0", conaffinity="0")
    gone = [{elements[geom].attrib["name"] for geom in pair} for pair in pairs if pair in explicit]
    for section in root.findall("contact"):
        for element in section.findall("pair"):
            if {element.get("geom1"), element.get("geom2")} in gone:
                section.remove(element)
    section = ElementTree.SubElement(root, "contact")
    for pair in survey.pairs:
        both = frozenset(pair.geoms)
        if both in pairs or both in explicit or not both & silent:
            continue
        ends = list(pair.geoms)
        ElementTree.SubElement(section, "pair", {
            "geom1": elements[ends[0]].attrib["name"], "geom2": elements[ends[1]].attrib["name"],
            "condim": str(pair.condim), "friction": written(*pair.friction), "solref": written(*pair.solref),
            "solimp": written(*pair.solimp), "margin": written(float(model.geom_margin[ends].max())),
            "gap": written(float(model.geom_gap[ends].max())),
        })  # fmt: skip
    return ElementTree.tostring(root, encoding="unicode")
