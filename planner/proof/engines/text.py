"""The text of a model for the parser of another engine: a file on disk, and a name for every joint and body.

Names map the joints of two engines. No dynamics are changed; all changes of the text are reported.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from planner.base.errors import ModelError
from planner.model.mjcf.contact_edits import joints_of
from planner.model.mjcf.text import parsed
from planner.model.twin import Twin

_POSE = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")


class Prepared(NamedTuple):
    """A model's text, prepared for another parser."""

    path: Path
    joints: tuple[str, ...]  # Names, in MuJoCo's order
    bodies: tuple[str, ...]  # The body of each joint
    changes: tuple[str, ...]  # Changes of the text, a phrase each


def prepared(twin: Twin, model: Any, folder: Path) -> Prepared:
    """Write a twin's text, which compiles to `model`, and its files into a folder.

    A body with several joints becomes a chain of bodies with one joint each: Drake places the first of them at the
    parent, and Pinocchio ignores their `ref`. Several worldbodies are merged, since Pinocchio reads only the first.

    Raises:
        ModelError: The text lacks joints of the model, or names files that the twin lacks.
    """
    root = parsed(twin.mjcf, "the model")
    root.attrib.setdefault("model", "model")  # Drake requires a name
    worlds, changes = root.findall("worldbody"), []
    for other in worlds[1:]:  # Pinocchio would read all of them once per section
        worlds[0].extend(other)
        root.remove(other)
    if worlds[1:]:
        changes.append(f"its {len(worlds)} worldbody sections are one")
    for keyframes in root.findall("keyframe"):
        root.remove(keyframes)
        changes.append("its keyframes are left out")
    if root.find("worldbody//frame") is not None:
        raise ModelError("the file has a <frame>, which this parser does not read")
    joints = joints_of(root, model)
    parents = {child: parent for parent in root.iter() for child in parent}
    named = _name(joints, "joint") + _name(list(root.iterfind("worldbody//body")), "body")
    if named:
        changes.append(f"{named} joints and bodies without a name have one")
    bodies = tuple(parents[joint].attrib["name"] for joint in joints)
    several = [body for body in parents if body.tag == "body" and len(_joints(body)) > 1]
    for body in several:
        _split(body, parents[body], root)
    if several:
        changes.append(f"{len(several)} bodies with several joints are chains of bodies with one joint")
    tops = worlds[0].findall("body")
    if len(tops) > 1:
        changes.append(f"its {len(tops)} bodies in the world hang on one body without mass, fixed to the world")
        base = ElementTree.SubElement(worlds[0], "body", name=_unused("base", root))
        for body in tops:
            worlds[0].remove(body)
            base.append(body)
    _write(root, twin.assets, folder)
    return Prepared(
        folder / "model.xml", tuple(joint.attrib["name"] for joint in joints), bodies, tuple(changes)
    )  # fmt: skip


def _joints(body: ElementTree.Element) -> list[ElementTree.Element]:
    return [child for child in body if child.tag in ("joint", "freejoint")]


def _split(body: ElementTree.Element, parent: ElementTree.Element, root: ElementTree.Element) -> None:
    """Make a chain of a body with several joints; all links share its frame, only the last has its mass."""
    place = list(parent).index(body)
    parent.remove(body)
    for joint in _joints(body)[:-1]:
        link = ElementTree.Element("body", name=_unused(f"{body.get('name')}_{joint.get('name')}", root))
        link.attrib.update({key: body.attrib.pop(key) for key in _POSE if key in body.attrib})
        if "childclass" in body.attrib:
            link.set("childclass", body.attrib["childclass"])
        body.remove(joint)
        link.append(joint)
        parent.insert(place, link)
        parent, place = link, len(link)
    parent.append(body)


def _name(elements: list[ElementTree.Element], kind: str) -> int:
    """Name the unnamed elements; returns how many."""
    taken, named = {element.get("name") for element in elements}, 0
    for i, element in enumerate(elements):
        if not element.get("name"):
            name = f"{kind}_{i}"
            while name in taken:
                name += "_"
            element.set("name", name)
            taken.add(name)
            named += 1
    return named


def _unused(name: str, root: ElementTree.Element) -> str:
    taken = {element.get("name") for element in root.iter()}
    while name in taken:
        name += "_"
    return name


def _write(root: ElementTree.Element, assets: dict[str, bytes], folder: Path) -> None:
    """Write the text as model.xml, and the files that it references in the same folder."""
    for element in root.iterfind("asset/*"):
        file = element.get("file")
        if file is not None and element.tag != "texture":
            if file not in assets or Path(file).name != file:  # no access outside of the folder
                raise ModelError(f"the text names the file {file!r}, which the plan does not hold")
            (folder / file).write_bytes(assets[file])
    ElementTree.ElementTree(root).write(folder / "model.xml", encoding="utf-8")
