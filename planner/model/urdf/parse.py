"""Parse a URDF text to a robot: its elements, put in order as a tree."""

from __future__ import annotations

import re
from collections import Counter
from xml.etree import ElementTree

from planner.base.arguments import short_repr
from planner.base.errors import ModelError
from planner.model.mjcf.input_limits import parsed
from planner.model.urdf.elements import joint_of, link_of, rgba_of
from planner.model.urdf.robot import SCALAR, Joint, Link, Robot

MAX_PREFIXES = 50
_PREFIX = re.compile(r"<([A-Za-z][\w.-]*):")


def robot_of(text: str, name: str) -> Robot:
    """The robot of a URDF text; a message calls it `name`.

    Raises:
        ModelError: It is no URDF, xacro that was not run yet, or not a tree of links with finite numbers.
    """
    root = parsed(_with_prefixes(text.lstrip()), name, roots=("robot",))
    _refuse_xacro(root, name)
    materials = {m.get("name", ""): rgba_of(m, {}, name) for m in root.iterfind("material")}
    links: dict[str, Link] = {}
    for element in root.iterfind("link"):
        link = link_of(element, materials, name)
        if link.name in links:
            raise ModelError(f"{name} has two links {link.name!r}, expected one of each name.")
        links[link.name] = link
    if not links:
        raise ModelError(f"{name} has no links, expected some.")
    joints = [joint_of(element, name) for element in root.iterfind("joint")]
    _check_references(joints, links, name)
    first, ordered = _in_order(joints, links, name)
    meshdir = next((c.get("meshdir", "") for c in root.iterfind("mujoco/compiler")), "")
    return Robot(first, links, ordered, meshdir, root.get("name", "") or first)


def _with_prefixes(text: str) -> str:
    """The text with all prefixes of elements declared: readers of URDF know no namespaces, so files do not do it."""
    start = text.find("<robot")
    undeclared = [prefix for prefix in dict.fromkeys(_PREFIX.findall(text)) if f"xmlns:{prefix}" not in text]
    if start < 0 or len(undeclared) > MAX_PREFIXES:
        return text
    names = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in undeclared)
    return f"{text[: start + 6]}{names}{text[start + 6 :]}"


def _refuse_xacro(root: ElementTree.Element, name: str) -> None:
    parts = [part for tag in ("link", "joint") for element in root.iterfind(tag) for part in element.iter()]
    unresolved = any("${" in value or "$(" in value for part in parts for value in part.attrib.values())
    if unresolved or any("xacro" in element.tag for element in root.iter()):
        file = name.removeprefix("the model ") if name != "the model" else "arm.urdf.xacro"
        made = file.removesuffix(".xacro").removesuffix(".urdf") + ".urdf"
        raise ModelError(
            f"{name} is xacro, from which URDFs are made, expected a URDF: run `xacro {file} > "
            f"{made if made != file else 'made.urdf'}` first (`pip install xacro`)."
        )


def _check_references(joints: list[Joint], links: dict[str, Link], name: str) -> None:
    repeated = [joint for joint, count in Counter(joint.name for joint in joints).items() if count > 1]
    if repeated:
        raise ModelError(f"{name} has two joints {repeated[0]!r}, expected one of each name.")
    moving = {joint.name: joint for joint in joints if joint.kind in SCALAR}
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise ModelError(
                    f"joint {joint.name!r} of {name} names the link {short_repr(end)}, which it does not have."
                )
        leader, seen = joint, {joint.name}
        while leader.mimic is not None:
            if leader.mimic[0] not in moving:
                raise ModelError(
                    f"joint {leader.name!r} of {name} mimics {short_repr(leader.mimic[0])}, expected the name of a "
                    f"{', '.join(SCALAR[:-1])} or {SCALAR[-1]} joint."
                )
            leader = moving[leader.mimic[0]]
            if leader.name in seen:
                raise ModelError(f"joint {joint.name!r} of {name} mimics itself, expected another joint.")
            seen.add(leader.name)


def _in_order(joints: list[Joint], links: dict[str, Link], name: str) -> tuple[str, tuple[Joint, ...]]:
    """The root link, and the joints with parents first."""
    above: dict[str, Joint] = {}
    below: dict[str, list[Joint]] = {link: [] for link in links}
    for joint in joints:
        if joint.child in above:
            raise ModelError(
                f"link {joint.child!r} of {name} hangs on the joints {above[joint.child].name!r} and {joint.name!r}, "
                "expected a tree: a loop is written in MJCF, as <equality><connect>."
            )
        above[joint.child] = joint
        below[joint.parent].append(joint)
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        raise ModelError(
            f"{name} has {len(roots)} links that hang on no joint ({', '.join(map(repr, roots[:3]))}), expected one, "
            "its root: connect the others by fixed joints or leave them out."
        )
    ordered: list[Joint] = []
    waiting = roots[:]
    while waiting:
        link = waiting.pop()
        ordered.extend(below[link])
        waiting.extend(joint.child for joint in below[link])
    if len(ordered) < len(joints):  # also where there is no root
        lost = next(joint for joint in joints if joint not in ordered)
        raise ModelError(
            f"joint {lost.name!r} of {name} is part of a loop, expected a tree that begins at one root link."
        )
    return roots[0], tuple(ordered)
