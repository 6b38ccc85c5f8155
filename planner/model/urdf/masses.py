"""The inertials of a robot's moving bodies, as MuJoCo takes them, and what to write where a machine cannot have them.

MuJoCo refuses a moving body without mass or inertia. A link may have none where others that it carries have some:
then it gets LEAST of both, far below the rounding of what it carries. MuJoCo also refuses a tensor that no body has. On
a link that is fixed to others, it is added to theirs: only the sum moves. Else it is replaced by the nearest that a
body can have where that is SLIGHT, what exports and rounding leave, or on request; it is refused where it is not.

On request links without <inertial> get one from their shapes and a density. MuJoCo's compiler integrates it: of the
collision shapes, of a link without any of the visual ones, and of a mesh the convex hull.
"""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from planner.base.arguments import first_of
from planner.base.errors import ModelError
from planner.model.mjcf.model_index import compile_model, pose
from planner.model.mjcf.text import written
from planner.model.urdf.parse import SCALAR, Inertial, Joint, Robot
from planner.model.urdf.shapes import GeomWriter, Packages

MIN_MASS = 1e-14
"""kg and kg m^2; MuJoCo refuses less than 1e-15."""
_NOTHING = 1e-11  # kg or kg m^2 that a joint moves: what it moves is lost in rounding
WATER = 1000.0  # kg/m^3, for a suggestion, and of inertia = "from shapes"
_ROUNDING = 1e-9  # of a tensor whose principal moments fulfil the triangle inequality as an equation
SLIGHT = 0.02  # of a tensor, in the Frobenius norm
_NAMED = 3  # links in a sentence


def inertials(
    robot: Robot, joints: tuple[Joint, ...], anchored: set[str], name: str, *, nearest: bool
) -> tuple[dict[str, Inertial], list[str]]:
    """The inertial of every link that moves and has one, and phrases about those that are replaced.

    Raises:
        ModelError: A tensor that no body nearly has, unless `nearest`, or a joint that moves no inertia.
    """
    _check_moved(robot, joints, name)
    poses, groups = {link: np.eye(4) for link in robot.links}, {}
    first: dict[str, str] = {}
    for joint in joints:  # parents first
        rigid = joint.kind == "fixed" and joint.parent
        first[joint.child] = first.get(joint.parent, joint.parent) if rigid else joint.child
        if rigid:
            poses[joint.child] = poses[joint.parent] @ joint.pose.T
        if joint.child not in anchored:
            groups.setdefault(first[joint.child], []).append(joint.child)
    found: dict[str, Inertial] = {}
    wrong: list[str] = []
    for head, links in groups.items():
        own = {link: body for link in links if (body := robot.links[link].inertial) is not None and _weighs(body)}
        bad = [link for link, body in own.items() if not _possible(body)]
        if bad and len(own) > 1:
            total = _sum([(body, poses[link]) for link, body in own.items()])
            if _possible(total):
                own, bad = {head: total}, []
        wrong += bad
        nothing = Inertial(0.0, np.zeros(3), np.zeros((3, 3)))
        found |= {link: _accepted(body) for link, body in ({head: nothing} | own).items()}
    if not wrong:
        return found, []
    changes = {link: _change(body) for link in wrong if (body := robot.links[link].inertial) is not None}
    change = max(changes.values())
    if change > SLIGHT and not nearest:
        raise ModelError(_refusal(robot, [link for link in wrong if changes[link] > SLIGHT], name))
    return found, [f"the inertia of {listed(wrong)} (no body has it; by {100 * change:.2g} % another is the nearest)"]


def without_idle(robot: Robot, joints: tuple[Joint, ...]) -> tuple[tuple[Joint, ...], list[str]]:
    """The joints with those fixed that move no mass, which nothing else feels, and phrases about them."""
    heavy: set[str] = set()
    for joint in reversed(joints):
        body = robot.links[joint.child].inertial
        if joint.child in heavy or (body is not None and _weighs(body)):
            heavy |= {joint.child, joint.parent}
    idle = [joint for joint in joints if joint.kind != "fixed" and joint.child not in heavy]
    if not idle:
        return joints, []
    names = {joint.name for joint in idle}
    needed = [joint.mimic[0] for joint in joints if joint.mimic is not None and joint.name not in names]
    fixed = names - set(needed)  # a joint that others follow is refused where it moves nothing
    more = '; inertia = "from shapes" gives it one' if any(_has_shapes(robot, joint) for joint in idle) else ""
    phrase = f"the motion of {listed([joint.name for joint in idle], 'joint')} (no mass hangs on what it moves{more})"
    kept = tuple(replace(j, kind="fixed", mimic=None) if j.name in fixed else j for j in joints)
    return kept, [phrase] if fixed else []


def _weighs(body: Inertial) -> bool:
    return bool(body.mass or np.any(body.inertia))


def _sum(bodies: list[tuple[Inertial, np.ndarray]]) -> Inertial:
    """Several bodies as one, each with the pose of its link in the common frame."""
    mass = sum(body.mass for body, _ in bodies)
    centres = [T[:3, :3] @ body.centre + T[:3, 3] for body, T in bodies]
    moments = [body.mass * c for (body, _), c in zip(bodies, centres, strict=True)]
    centre = np.sum(moments, axis=0) / mass if mass else np.zeros(3)
    inertia = np.zeros((3, 3))
    for (body, T), c in zip(bodies, centres, strict=True):
        d = c - centre
        inertia += T[:3, :3] @ body.inertia @ T[:3, :3].T + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Inertial(mass, centre, inertia)


def _nearest(tensor: np.ndarray) -> np.ndarray:
    """The nearest tensor that a body can have: positive moments, none larger than the sum of the others."""
    values, axes = np.linalg.eigh(tensor)
    a, b, c = np.maximum(values, 0.0)
    share = max(0.0, c - a - b) / 3.0
    return axes @ np.diag([a + share, b + share, c - share]) @ axes.T


def _change(body: Inertial) -> float:
    """How far the nearest tensor is, as a share."""
    return float(np.linalg.norm(_nearest(body.inertia) - body.inertia) / np.linalg.norm(body.inertia))


def _possible(body: Inertial) -> bool:
    size = np.linalg.norm(body.inertia)
    return bool(size == 0.0 or _change(body) * size <= max(_ROUNDING * size, MIN_MASS))


def _accepted(body: Inertial) -> Inertial:
    """The body as MuJoCo takes it: unchanged, but for rounding, LEAST, and a tensor that no body has."""
    values = np.linalg.eigvalsh(body.inertia)
    if values[0] >= MIN_MASS and values[2] <= values[0] + values[1] and body.mass >= MIN_MASS:
        return body
    inertia = _nearest(body.inertia)
    inertia = inertia + (MIN_MASS + 4.0 * np.finfo(float).eps * np.linalg.norm(inertia)) * np.eye(3)
    return replace(body, mass=max(body.mass, MIN_MASS), inertia=inertia)


def listed(links: list[str], kind: str = "link") -> str:
    """Names for a sentence, the first of many: "links 'a', 'b'"."""
    return f"{kind}{'s' * (len(links) > 1)} {first_of(list(map(repr, links)), _NAMED)}"


def _refusal(robot: Robot, links: list[str], name: str) -> str:
    body = robot.links[links[0]].inertial
    assert body is not None
    values, tensor = np.linalg.eigvalsh(body.inertia), _nearest(body.inertia)
    return (
        f"no body has the inertia of {listed(links)} of {name}, e.g. {links[0]!r} the principal moments "
        f"{' '.join(f'{v:.4g}' for v in values)} kg m^2, where none may be negative or exceed the sum of the others: "
        f'correct the file (the nearest is {_written(tensor)}) or write inertia = "nearest" to plan with the nearest.'
    )


def _written(tensor: np.ndarray) -> str:
    keys = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    size = np.max(np.abs(tensor))
    tensor = tensor + 1e-6 * size * np.eye(3)  # so that seven digits fulfil the inequality
    entries = {key: tensor[at] if abs(tensor[at]) > 1e-9 * size else 0.0 for key, at in keys.items()}
    return "<inertia " + " ".join(f'{key}="{value:.7g}"' for key, value in entries.items()) + "/>"


def _check_moved(robot: Robot, joints: tuple[Joint, ...], name: str) -> None:
    """Raise ModelError for a joint that moves no mass, or turns no inertia, with all that hangs on it."""
    poses = {robot.root: np.eye(4), "": np.eye(4)}  # "" is the world
    for joint in joints:
        poses[joint.child] = poses[joint.parent] @ joint.pose.T
    mass, moment, inertia = {}, {}, {}  # of each link and what hangs on it, about the origin of the root
    for link, T in poses.items():
        given = robot.links[link].inertial if link else None
        body = given or Inertial(0.0, np.zeros(3), np.zeros((3, 3)))
        R, c = T[:3, :3], T[:3, :3] @ body.centre + T[:3, 3]
        mass[link], moment[link] = body.mass, body.mass * c
        inertia[link] = R @ body.inertia @ R.T + body.mass * (c @ c * np.eye(3) - np.outer(c, c))
    for joint in reversed(joints):
        child, parent = joint.child, joint.parent
        moves = mass[child]
        if joint.kind in (*SCALAR, "planar") and joint.kind != "prismatic":
            p = poses[child][:3, 3]
            a = poses[child][:3, :3] @ (np.array(joint.axis) / np.linalg.norm(joint.axis))
            about = mass[child] * (p @ p * np.eye(3) - np.outer(p, p)) - 2.0 * (p @ moment[child]) * np.eye(3)
            about += np.outer(p, moment[child]) + np.outer(moment[child], p)
            moves = a @ (inertia[child] + about) @ a
        if joint.kind != "fixed" and moves < _NOTHING:
            raise ModelError(missing_inertia(robot, joint, mass[child], name))
        mass[parent], moment[parent] = mass[parent] + mass[child], moment[parent] + moment[child]
        inertia[parent] = inertia[parent] + inertia[child]


def _has_shapes(robot: Robot, joint: Joint) -> bool:
    link = robot.links[joint.child]
    return bool(link.inertial is None and (link.collisions or link.visuals))


def missing_inertia(robot: Robot, joint: Joint, mass: float, name: str) -> str:
    """A sentence about a joint that moves `mass` kg and no inertia, and what to write."""
    where = f"joint {joint.name!r} of {name} moves link {joint.child!r}"
    own = robot.links[joint.child].inertial
    if mass < _NOTHING:
        return (
            f"{where}, which has no mass and carries none: write its <inertial> with a mass and an inertia, "
            + ('or inertia = "from shapes" in the problem file, ' if _has_shapes(robot, joint) else "")
            + 'or make the joint type="fixed".'
        )
    ball = 0.4 * mass * (3.0 * mass / (4.0 * np.pi * WATER)) ** (2.0 / 3.0)
    weighs = f"its {own.mass:g} kg" if own is not None and own.mass > 0.0 else f"the {mass:g} kg that it carries"
    return (
        f"{where}, which has no inertia about the joint's axis: write its <inertia>; {weighs} as a ball of water would "
        f'have ixx="{ball:.3g}" iyy="{ball:.3g}" izz="{ball:.3g}".'
    )


def with_shape_inertias(
    robot: Robot, anchored: set[str], packages: Packages, density: float, name: str
) -> tuple[Robot, list[str]]:  # fmt: skip
    """The robot with an inertial for each link that moves and has none but has shapes, and a phrase about them."""
    root, links = Element("mujoco"), dict(robot.links)
    SubElement(root, "compiler", {"angle": "radian", "eulerseq": "XYZ", "inertiafromgeom": "true"})
    SubElement(SubElement(root, "default"), "geom", {"density": written(density)})
    world, shapes = SubElement(root, "worldbody"), GeomWriter(root, packages)
    for link in (one for one in links.values() if one.inertial is None and one.name not in anchored):
        visuals = () if link.collisions else link.visuals
        shapes.add(SubElement(world, "body", {"name": link.name}), replace(link, visuals=visuals))
    for mesh in root.iter("mesh"):
        mesh.set("inertia", "convex")
    model, given = compile_model(root, shapes.files, name), list[str]()
    for i in np.flatnonzero(model.body_mass):
        link, R = model.body(i).name, pose(np.zeros(3), model.body_iquat[i])[:3, :3]
        own = Inertial(float(model.body_mass[i]), model.body_ipos[i].copy(), R @ np.diag(model.body_inertia[i]) @ R.T)
        links[link] = replace(links[link], inertial=own)
        given.append(link)
    phrase = f"the inertia of {listed(given)} (the file has none: that of the shapes at {density:g} kg/m^3)"
    return replace(robot, links=links), [phrase] if given else []
