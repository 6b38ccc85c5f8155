"""A robot as a URDF has it, parsed from its text: every number checked, in order as a tree. Pure XML, without MuJoCo.

What the format leaves open is read as others do: a range of no width is none, and an effort or a velocity of 0 is no
limit. A range whose ends are swapped is taken between them. Joint.unclear says so.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import ModelError
from planner.model.mjcf.text import parsed

Numbers = tuple[float, ...]

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
SCALAR = ("revolute", "continuous", "prismatic")
"""Joints with one coordinate, which get a motor."""


@dataclass(frozen=True)
class Pose:
    """Position, m, and angles about fixed axes, rad."""

    xyz: Numbers = (0.0, 0.0, 0.0)
    rpy: Numbers = (0.0, 0.0, 0.0)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) Rz Ry Rx."""
        (a, b, c), (A, B, C) = np.cos(self.rpy), np.sin(self.rpy)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, a, -A], [0.0, A, a]])
        about_y = np.array([[b, 0.0, B], [0.0, 1.0, 0.0], [-B, 0.0, b]])
        about_z = np.array([[c, -C, 0.0], [C, c, 0.0], [0.0, 0.0, 1.0]])
        return about_z @ about_y @ about_x

    @property
    def T(self) -> np.ndarray:
        """(4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation, self.xyz
        return T


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass, kg, centre (3,), m, and inertia (3, 3), kg m^2, about the centre, all in the link's axes."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Shape:
    """A visual or collision element: `size` of a primitive as MJCF has it, `file` and `scale` of a mesh."""

    kind: str
    pose: Pose
    size: Numbers = ()
    file: str = ""
    scale: Numbers = (1.0, 1.0, 1.0)
    rgba: Numbers = ()


@dataclass(frozen=True)
class Link:
    """A link, with an inertial where the file gives one."""

    name: str
    inertial: Inertial | None
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]


@dataclass(frozen=True)
class Joint:
    """A joint; limits are infinite where the file gives none."""

    name: str
    kind: str
    parent: str
    child: str
    pose: Pose
    axis: Numbers
    range: tuple[float, float]
    effort: float
    velocity: float
    damping: float
    friction: float
    mimic: tuple[str, float, float] | None  # the joint that it follows, multiplier and offset
    unclear: tuple[tuple[str, str], ...] = ()  # a limit that is not there, or not as written, and why: for a phrase


@dataclass(frozen=True)
class Robot:
    """A tree of links: joints in an order in which parents come first."""

    root: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    meshdir: str  # of the <mujoco> extension
    name: str  # its own, or that of its root


_SIZES = {"box": "size", "sphere": "radius", "cylinder": "radius length", "capsule": "radius length"}


def link_of(element: ElementTree.Element, materials: dict[str, Numbers], name: str) -> Link:
    """The link of an element; `materials` are the robot's colours by name."""
    link = _named(element, "link", name)
    where = f"link {link!r} of {name}"
    visuals = (_shape(visual, materials, where) for visual in element.iterfind("visual"))
    collisions = (_shape(collision, materials, where) for collision in element.iterfind("collision"))
    inertial = element.find("inertial")
    return Link(
        link, None if inertial is None else _inertial(inertial, where),
        tuple(filter(None, visuals)), tuple(filter(None, collisions)),
    )  # fmt: skip


def _inertial(element: ElementTree.Element, where: str) -> Inertial:
    mass = _number(element.find("mass"), "value", 0.0, f"the mass of {where}")
    if mass < 0.0:
        raise ModelError(f"the mass of {where} is {mass:g} kg, expected at least 0.")
    six = {
        key: _number(element.find("inertia"), key, 0.0, f"{key} of {where}")
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    }
    xx, yy, zz, xy, xz, yz = six.values()
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    pose = _pose(element, where)
    if any(pose.rpy):  # else the numbers stay as they are written
        inertia = pose.rotation @ inertia @ pose.rotation.T
    return Inertial(mass, np.array(pose.xyz), inertia)


def _shape(element: ElementTree.Element, materials: dict[str, Numbers], where: str) -> Shape | None:
    """None where there is no geometry that this knows: readers of URDF pass over others."""
    geometry = element.find("geometry")
    form = next((child for child in geometry if child.tag in (*_SIZES, "mesh")), None) if geometry is not None else None
    if form is None:
        return None
    pose, material = _pose(element, where), element.find("material")
    rgba = () if material is None else rgba_of(material, materials, where)
    if form.tag == "mesh":
        scale = _several(form, "scale", (1.0, 1.0, 1.0), f"the scale of a mesh of {where}")
        return Shape("mesh", pose, file=form.get("filename", ""), scale=scale, rgba=rgba)
    keys = _SIZES[form.tag]
    size: Numbers = ()
    none = (0.0, 0.0, 0.0) if form.tag == "box" else (0.0,)
    for key in keys.split():
        size += _several(form, key, none, f"the {key} of a {form.tag} of {where}")
    if min(size) < 0.0:
        raise ModelError(f"the {keys} of a {form.tag} of {where} is {min(size):g}, expected at least 0.")
    whole = () if form.tag == "box" else size[:1]  # MJCF has radii and half lengths
    return Shape(form.tag, pose, (*whole, *(s / 2 for s in size[len(whole) :])), rgba=rgba)


def joint_of(element: ElementTree.Element, name: str) -> Joint:
    """The joint of an element."""
    joint = _named(element, "joint", name)
    where = f"joint {joint!r} of {name}"
    kind = element.get("type", "")
    if kind not in KINDS:
        raise ModelError(f"{where} has the type {short_repr(kind)}, expected one of: {', '.join(KINDS)}.")
    ends = []
    for end in ("parent", "child"):
        found = element.find(end)
        if found is None or not found.get("link"):
            raise ModelError(f'{where} has no {end}, expected <{end} link="..."/>.')
        ends.append(found.get("link", ""))
    axis = _several(element.find("axis"), "xyz", (1.0, 0.0, 0.0), f"the axis of {where}")
    if kind in (*SCALAR, "planar") and not any(axis):
        raise ModelError(f'the axis of {where} is 0 0 0, expected a direction, e.g. xyz="0 0 1".')
    limit, dynamics, mimic = element.find("limit"), element.find("dynamics"), element.find("mimic")
    range, unclear = _range(limit, where) if kind in ("revolute", "prismatic") else ((-math.inf, math.inf), [])
    values = {}
    for part, keys in ((limit, ("effort", "velocity")), (dynamics, ("damping", "friction"))):
        for key in keys:
            values[key] = _number(part, key, 0.0, f"the {key} of {where}", infinite=part is limit)
            if values[key] < 0.0:
                raise ModelError(f"the {key} of {where} is {values[key]:g}, expected at least 0.")
    has = {} if limit is None else limit.attrib
    for key in ("effort", "velocity") if kind in SCALAR else ():
        if values[key] == 0.0 and (key in has if key == "velocity" else mimic is None):  # motors alone have an effort
            unclear.append((f"{key} limit", "the file has 0" if key in has else _NONE))
    follows = None
    if mimic is not None and kind in SCALAR:
        multiplier = _number(mimic, "multiplier", 1.0, f"the multiplier of {where}")
        follows = (mimic.get("joint", ""), multiplier, _number(mimic, "offset", 0.0, f"the offset of {where}"))
    return Joint(
        joint, kind, ends[0], ends[1], _pose(element, where), axis, range, values["effort"] or math.inf,
        values["velocity"] or math.inf, values["damping"], values["friction"], follows, tuple(unclear),
    )  # fmt: skip


_NONE = "the file has none"


def _range(limit: ElementTree.Element | None, where: str) -> tuple[tuple[float, float], list[tuple[str, str]]]:
    """The range of a joint that has one, and why it is not as written."""
    low, high = (_number(limit, end, 0.0, f"the {end} limit of {where}", infinite=True) for end in ("lower", "upper"))
    if low < high:
        return (low, high), []
    if low > high:
        return (high, low), [("range", f"written as {low:g} to {high:g}, taken as {high:g} to {low:g}")]
    written = limit is not None and ("lower" in limit.attrib or "upper" in limit.attrib)
    return (-math.inf, math.inf), [("range", f"both of its ends are {low:g}" if written else _NONE)]


def _named(element: ElementTree.Element, kind: str, name: str) -> str:
    found = element.get("name", "")
    if not found.isprintable() or not found:
        raise ModelError(f"{name} has a {kind} with the name {short_repr(found)}, expected printable characters.")
    return found


def _pose(element: ElementTree.Element, where: str) -> Pose:
    origin = element.find("origin")
    zeros = (0.0, 0.0, 0.0)
    return Pose(
        _several(origin, "xyz", zeros, f"an origin's xyz of {where}"),
        _several(origin, "rpy", zeros, f"an origin's rpy of {where}"),
    )


def rgba_of(material: ElementTree.Element, known: dict[str, Numbers], where: str) -> Numbers:
    """The colour of a material, or of the robot's material of that name; () for none."""
    color = material.find("color")
    if color is None:
        return known.get(material.get("name", ""), ())
    return _several(color, "rgba", (), f"a color of {where}", count=4)


def _number(
    element: ElementTree.Element | None, key: str, default: float, what: str, *, infinite: bool = False
) -> float:
    return _several(element, key, (default,), what, infinite=infinite)[0]


def _several(
    element: ElementTree.Element | None, key: str, default: Numbers, what: str, *, count: int = 0,
    infinite: bool = False,
) -> Numbers:  # fmt: skip
    """The numbers of an attribute, as many as its default has (or `count`)."""
    text = None if element is None else element.get(key)
    if text is None:
        return default
    count = count or len(default)
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        values = ()
    if len(values) != count or any(math.isnan(v) or (math.isinf(v) and not infinite) for v in values):
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise ModelError(f"{what} is {short_repr(text)}, expected {wanted}.")
    return values


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
    if "world" not in links and any(joint.parent == "world" for joint in joints):  # as Drake's files leave it out
        links = {"world": Link("world", None, (), ()), **links}
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
                    f"joint {joint.name!r} of {name} names the link {short_repr(end)}, which it does not have: write "
                    f"<link name={end!r}/>, or the name of one that it has."
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
