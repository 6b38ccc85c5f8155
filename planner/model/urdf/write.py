"""Write a URDF as MJCF: the numbers of its file unchanged, a body for every link, a motor for every actuated joint.

MuJoCo's own reader of URDF drops the root's inertia, has no motors and writes six digits; so the text is made here and
MuJoCo reads MJCF alone. Links that do not move keep no inertia: nothing depends on it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.files import printable, read_text
from planner.model.mjcf.equalities import HARD
from planner.model.mjcf.model_index import LEFT_OUT, VELOCITY_LIMIT
from planner.model.mjcf.text import is_text, written
from planner.model.urdf.masses import WATER, inertials, listed, missing_inertia, with_shape_inertias, without_idle
from planner.model.urdf.parse import SCALAR, Inertial, Joint, Pose, Robot, robot_of
from planner.model.urdf.shapes import GeomWriter, Packages, exclude_overlaps, packages_of, placed

_UNBOUNDED_RANGE = 1e10
"""rad or m, the end of a range that has only the other one."""


def mjcf_of(
    robot: Robot, packages: Packages, name: str, *, base: str | None = None, floor: bool = False, nearest: bool = False,
    density: float | None = None,
) -> tuple[str, dict[str, bytes]]:  # fmt: skip
    """MJCF text and files of a robot; see Mechanism.from_urdf.

    With a density, kg/m^3, links without <inertial> have the inertia of their shapes.

    Raises:
        ModelError: Nothing moves, a joint moves no inertia, or no body has one.
    """
    joints = based(robot, base)
    moving = [joint for joint in joints if joint.kind != "fixed"]
    robot, shaped = (
        with_shape_inertias(robot, _anchored(robot, joints), packages, density, name) if density else (robot, [])
    )
    joints, idle = without_idle(robot, joints)
    if moving and all(joint.kind == "fixed" for joint in joints):
        raise ModelError(missing_inertia(robot, moving[0], 0.0, name))
    if all(joint.kind == "fixed" for joint in joints):
        heavy = any(link.inertial is not None and link.inertial.mass for link in robot.links.values())
        floats = ': base = "free" lets it float' if base is None and heavy else ""
        raise ModelError(f"{name} has no joints that move, expected at least one{floats}.")
    anchored = _anchored(robot, joints)
    bodies_of, replaced = inertials(robot, joints, anchored, name, nearest=nearest)
    root = Element("mujoco", {"model": robot.name})
    SubElement(root, "compiler", {"angle": "radian", "eulerseq": "XYZ", "inertiafromgeom": "false"})
    world, shapes = SubElement(root, "worldbody"), GeomWriter(root, packages)
    if floor:
        attributes = {"name": "floor", "type": "plane", "size": "0 0 0.05", "rgba": "0.8 0.8 0.8 1"}
        SubElement(world, "geom", attributes)
        shapes.names.add("floor")
    raised = SubElement(world, "frame")  # what floats
    for link, body in _bodies(robot, world, raised, joints, anchored).items():
        if link in bodies_of:
            _add_inertial(body, bodies_of[link])
        if link:
            shapes.add(body, robot.links[link])
    if not len(raised):
        world.remove(raised)
    if floor and (lowest := shapes.lowest(_floating(joints))) < 0.0:
        raised.set("pos", written(0.0, 0.0, -lowest))
    _exclude_neighbours(root, joints, anchored, set(shapes.touching))
    _add_motors(root, joints)
    _add_followers(root, joints)
    _add_velocity_limits(root, {joint.name: joint.velocity for joint in joints if joint.kind in SCALAR})
    _add_left_out(root, [*idle, *shaped, *replaced, *shapes.missing_parts(), *_unclear(joints)])
    exclude_overlaps(root, shapes.files, name)
    return ElementTree.tostring(root, encoding="unicode"), shapes.files


def based(robot: Robot, base: str | None) -> tuple[Joint, ...]:
    """The robot's joints with the root link free or fixed, parents first; a free one hangs on a joint from ""."""
    joints = robot.joints
    held = _held(robot, joints)
    floats = [joint for joint in joints if joint.kind == "floating" and joint.parent in held]
    if base == "fixed":
        return tuple(replace(joint, kind="fixed") if joint in floats else joint for joint in joints)
    if base != "free" or floats:
        return joints
    below = [joint for joint in joints if joint.parent == robot.root]
    if robot.links[robot.root].inertial is None and len(below) == 1 and below[0].kind == "fixed":  # "world" or the like
        return tuple(replace(joint, kind="floating") if joint is below[0] else joint for joint in joints)
    name = "floating_base"
    while name in {joint.name for joint in joints}:
        name += "_"
    far = (-math.inf, math.inf)
    free = Joint(name, "floating", "", robot.root, Pose(), (1.0, 0.0, 0.0), far, math.inf, math.inf, 0.0, 0.0, None)
    return (free, *joints)


def _held(robot: Robot, joints: Iterable[Joint]) -> set[str]:
    """Links that the root holds by fixed joints."""
    held = {robot.root}
    for joint in joints:  # parents first
        if joint.kind == "fixed" and joint.parent in held:
            held.add(joint.child)
    return held


def _anchored(robot: Robot, joints: tuple[Joint, ...]) -> set[str]:
    """Links that do not move."""
    return set() if any(joint.child == robot.root for joint in joints) else _held(robot, joints)


def _floating(joints: tuple[Joint, ...]) -> dict[str, np.ndarray]:
    """Poses (4, 4) of the links that float, with all joints at zero."""
    poses, floats = {"": np.eye(4), joints[0].parent: np.eye(4)}, set()
    for joint in joints:  # parents first
        poses[joint.child] = poses[joint.parent] @ joint.pose.T
        if joint.kind == "floating" or joint.parent in floats:
            floats.add(joint.child)
    return {link: pose for link, pose in poses.items() if link in floats}


def _bodies(
    robot: Robot, world: Element, raised: Element, joints: tuple[Joint, ...], anchored: set[str]
) -> dict[str, Element]:
    """The body of every link with its joints, and the world as that of ""; in `raised` what floats."""
    bodies = {"": world}
    if robot.root in anchored:
        bodies[robot.root] = world if robot.root == "world" else SubElement(world, "body", {"name": robot.root})
    above = {joint.child: joint for joint in joints}
    for joint in joints:
        place, top = bodies[joint.parent], joint.parent in anchored or not joint.parent
        if joint.kind == "floating" and top:  # MuJoCo's free joints are of the world's own bodies
            chain, link, place = [], joint.parent, raised
            while link in above:
                chain.append(above[link].pose)
                link = above[link].parent
            for pose in reversed(chain):
                place = SubElement(place, "frame", placed(pose))
        name = joint.child if joint.child != "world" else "world link"  # MuJoCo's own body has that name
        body = bodies[joint.child] = SubElement(place, "body", {"name": name, **placed(joint.pose)})
        if joint.kind == "floating" and top:
            SubElement(body, "freejoint", {"name": joint.name})
        else:
            _add_joint(body, joint)
    return bodies


def _add_joint(body: Element, joint: Joint) -> None:
    axis, parts = np.array(joint.axis), []
    if joint.kind == "floating":
        parts = [(f"{joint.name} {letter}", "slide", row) for letter, row in zip("xyz", np.eye(3), strict=True)]
    elif joint.kind == "planar":
        first = np.eye(3)[int(np.argmin(np.abs(axis)))]
        first = first - (first @ axis) / (axis @ axis) * axis
        parts = [(f"{joint.name} x", "slide", first), (f"{joint.name} y", "slide", np.cross(axis, first))]
    if joint.kind in ("floating", "spherical"):
        parts.append((joint.name, "ball", axis))
    elif joint.kind != "fixed":
        parts.append((joint.name, "slide" if joint.kind == "prismatic" else "hinge", axis))
    for name, kind, direction in parts:
        attributes = {"name": name, "type": kind}
        if kind != "ball":
            attributes["axis"] = written(*direction)
        if np.any(np.isfinite(joint.range)):
            attributes["range"] = written(*np.clip(joint.range, -_UNBOUNDED_RANGE, _UNBOUNDED_RANGE))
        for key, value in (("damping", joint.damping), ("frictionloss", joint.friction)):
            if value:
                attributes[key] = written(value)
        SubElement(body, "joint", attributes)


def _add_inertial(body: Element, own: Inertial) -> None:
    rows = own.inertia
    six = written(rows[0, 0], rows[1, 1], rows[2, 2], rows[0, 1], rows[0, 2], rows[1, 2])
    SubElement(body, "inertial", {"pos": written(*own.centre), "mass": written(own.mass), "fullinertia": six})


def _exclude_neighbours(root: Element, joints: tuple[Joint, ...], anchored: set[str], touching: set[str]) -> None:
    """Take out contacts across the joints of the fixed base: MuJoCo does that for all joints but these."""
    rigid: dict[str, str] = {}  # the first link of those that a link is fixed to
    for joint in joints:
        rigid[joint.child] = rigid.get(joint.parent, joint.parent) if joint.kind == "fixed" else joint.child
    first = {joint.child for joint in joints if joint.parent in anchored and joint.kind not in ("fixed", "floating")}
    pairs = [(a, b) for a in sorted(anchored & touching) for b in rigid if rigid[b] in first and b in touching]
    if pairs:
        contact = SubElement(root, "contact")
        for a, b in pairs:
            SubElement(contact, "exclude", {"body1": a, "body2": b if b != "world" else "world link"})


def _unclear(joints: tuple[Joint, ...]) -> list[str]:
    """Phrases about limits that the file lacks, or that are not taken as it writes them."""
    found: dict[tuple[str, str], list[str]] = {}
    for joint in joints:
        for one in joint.unclear if joint.kind != "fixed" else ():
            found.setdefault(one, []).append(joint.name)
    return [f"the {what} of {listed(names, 'joint')} ({why})" for (what, why), names in found.items()]


def _add_motors(root: Element, joints: tuple[Joint, ...]) -> None:
    """Add a motor for each joint that follows no other."""
    actuated = [joint for joint in joints if joint.kind in SCALAR and joint.mimic is None]
    section = SubElement(root, "actuator") if actuated else root
    for joint in actuated:
        attributes = {"name": joint.name, "joint": joint.name}
        if math.isfinite(joint.effort):
            attributes["ctrlrange"] = written(-joint.effort, joint.effort)
        SubElement(section, "motor", attributes)


def _add_followers(root: Element, joints: tuple[Joint, ...]) -> None:
    following = [joint for joint in joints if joint.mimic is not None]
    section = SubElement(root, "equality") if following else root
    for joint in following:
        assert joint.mimic is not None
        leader, multiplier, offset = joint.mimic
        polynomial = written(offset, multiplier, 0.0, 0.0, 0.0)
        attributes = {"name": joint.name, "joint1": joint.name, "joint2": leader, "polycoef": polynomial}
        SubElement(section, "joint", attributes | HARD)  # a URDF's followers are rigid, MuJoCo's default gives way


BASES = ("fixed", "free")
INERTIAS = ("given", "nearest", "from shapes")


def _add_velocity_limits(root: Element, limits: dict[str, float]) -> None:
    """Add limits by joint, rad/s or m/s; infinite ones are none."""
    finite = {joint: limit for joint, limit in limits.items() if math.isfinite(limit)}
    if finite:
        section = SubElement(SubElement(root, "custom"), "tuple", {"name": VELOCITY_LIMIT})
        for joint, limit in finite.items():
            SubElement(section, "element", {"objtype": "joint", "objname": joint, "prm": written(limit)})


def _add_left_out(root: Element, phrases: list[str]) -> None:
    """Add phrases of what a text lacks of the file that it was made of."""
    if phrases:
        section = SubElement(root, "custom")
        for k, phrase in enumerate(phrases):
            SubElement(section, "text", {"name": f"{LEFT_OUT}{k + 1}", "data": phrase})


def is_urdf(model: object) -> bool:
    """Whether a model is a URDF, or xacro that is to become one: by its file's ending, or its text's root element."""
    if is_text(model):
        return "<robot" in str(model)[:100_000] and "<mujoco" not in str(model).split("<robot")[0]
    return isinstance(model, (str, os.PathLike)) and str(model).lower().endswith((".urdf", ".xacro"))


def _density(inertia: Any) -> float | None:
    """The density, kg/m^3, of the shapes from which inertias are to be taken; None for those of the file."""
    if isinstance(inertia, Mapping):
        for key in inertia:
            choice("a key of inertia", key, ("density",))
        return number("density of inertia", inertia.get("density"), greater_than=0.0)
    return WATER if choice("inertia", inertia, INERTIAS) == "from shapes" else None


def as_mjcf(
    model: str | Path, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
    inertia: Any = "given",
) -> tuple[str, dict[str, bytes], str]:  # fmt: skip
    """The MJCF that is made of a URDF, its files, and its name for messages; see Mechanism.from_urdf."""
    if base is not None:
        choice("base", base, BASES)
    density = _density(inertia)
    if not isinstance(floor, bool):
        raise PlannerError(f"floor is {short_repr(floor)}, expected true or false.")
    paths = (package_path,) if isinstance(package_path, (str, os.PathLike)) else tuple(package_path)
    for path in paths:
        if not isinstance(path, (str, os.PathLike)) or not os.path.isdir(path):
            raise PlannerError(f"package_path is {short_repr(path)}, expected a folder of packages, or a list of some.")
    text, name, path = str(model), "the model", None
    if not is_text(model):
        path, name = Path(model), f"the model {printable(model)}"
        text = read_text(path, "the model", raises=ModelError)
    robot = robot_of(text, name)
    packages = packages_of(path, paths, robot.meshdir)
    return *mjcf_of(robot, packages, name, base=base, floor=floor, nearest=inertia == "nearest", density=density), name
