"""Which pairs of geoms can collide within the ranges of the joints, and which overlap where a motion starts.

Bounding spheres answer the first for all pairs: may_collide. For a pair with one or two joints between its geoms, poses
on a grid over these joints give the least distance: min_distance_over_ranges. Random poses tell whether a robot can
leave what it overlaps: can_separate.

Many models draw a base into the link that turns on it, and MuJoCo presses the two apart, which nobody intends. So the
contact of these pairs makes no force in the user's file: it is watched (contact_edits.watch) and named. A pair with a
gap, and one within a margin, keeps its force. A link that starts more than MAX_EMBEDDED inside an obstacle at rest and
can leave it keeps it too: it is in collision.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.contact_edits import elements_of_geoms
from planner.model.mjcf.contact_mode import falling_trees
from planner.model.mjcf.file_law import watch
from planner.model.mjcf.model_index import ModelIndex, body_chain

GRIDS = {1: 65, 2: 17}  # poses of each joint, by the number of joints between two shapes
TRIED = 20  # poses, to find one in which a pair is apart
MAX_MUJOCO_DISTANCE = 10.0  # m, of which MuJoCo measures less


def may_collide(survey: ModelIndex, pair: tuple[int, int], clearance: float) -> bool:
    """Whether the bounding spheres of two geoms can come as near as the clearance, within the joints' ranges."""
    model, home = survey.model, survey.home
    balls = [_ball(survey, geom, bodies) for geom, bodies in zip(pair, _bodies_between(model, pair), strict=True)]
    planes = [model.geom_type[geom] == int(load_mujoco().mjtGeom.mjGEOM_PLANE) for geom in pair]
    if any(planes):
        flat = planes.index(True)
        normal, (centre, radius) = home.geom_xmat[pair[flat]].reshape(3, 3)[:, 2], balls[1 - flat]
        if balls[flat][1] > 0.0:  # it moves
            return True
        return bool(normal @ (centre - home.geom_xpos[pair[flat]]) - radius <= clearance)
    (first, r), (second, s) = balls
    return bool(np.linalg.norm(first - second) - r - s <= clearance)


def min_distance_over_ranges(survey: ModelIndex, pair: tuple[int, int], poses: Collection[np.ndarray]) -> float:
    """How near two geoms come in any pose of the hinges and slides between them, m: not above it, by all that is known.

    It is the least distance on a grid less half of the greatest change from a pose of the grid to the next. -inf where
    no joint, more than two or others are between the two, or a slide has no range.

    Args:
        survey: Of the file.
        pair: The geoms.
        poses: qpos (nq,); the grid reaches as far as they do, where that is outside of the joints' ranges.
    """
    model, kinds, joints = survey.model, load_mujoco().mjtJoint, _joints_between(survey.model, pair)
    if len(joints) not in GRIDS:
        return -np.inf
    axes = []
    for joint in joints:
        kind, limited = int(model.jnt_type[joint]), bool(model.jnt_limited[joint])
        if kind != int(kinds.mjJNT_HINGE) and not (kind == int(kinds.mjJNT_SLIDE) and limited):
            return -np.inf
        own = model.jnt_range[joint] if limited else (-np.pi, np.pi)
        given = [float(qpos[model.jnt_qposadr[joint]]) for qpos in poses]
        axes.append(np.linspace(min(own[0], *given), max(own[1], *given), GRIDS[len(joints)]))
    data, found = load_mujoco().MjData(model), []
    data.qpos[:] = next(iter(poses))
    for at in itertools.product(*axes):
        data.qpos[model.jnt_qposadr[joints]] = at
        found.append(_distances(model, data, [pair], MAX_MUJOCO_DISTANCE)[pair])
    found = np.array(found).reshape([len(axis) for axis in axes])
    steps = [float(np.abs(np.diff(found, axis=k)).max()) for k in range(found.ndim)]
    return float(found.min()) - 0.5 * sum(steps)


def is_own(model: Any, pair: tuple[int, int]) -> bool:
    """Whether a pair is of one machine, its base included, or of two things that move."""
    bodies = model.geom_bodyid[list(pair)]
    root = model.body_rootid[bodies]
    return bool((root[0] == root[1] and root[0] > 0) or np.all(model.body_weldid[bodies] > 0))


def can_separate(survey: ModelIndex, pair: tuple[int, int], qpos: np.ndarray, apart: float) -> bool:
    """Whether a pair is of a machine and something at rest that its joints can take further apart than that, m.

    What turns on a base that is drawn into the world cannot leave it: the pair is as near in all its poses.
    """
    model, kinds = survey.model, load_mujoco().mjtJoint
    if is_own(model, pair):
        return False
    joints, rng = _joints_between(model, pair), np.random.default_rng(0)
    for _ in range(TRIED):
        pose = np.array(qpos)
        for joint in joints:
            if model.jnt_type[joint] not in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
                return True
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
            pose[model.jnt_qposadr[joint]] = rng.uniform(low, high)
        if distances_in(model, pose, [pair], apart + 1.0)[pair] > apart:
            return True
    return False


def distances_in(
    model: Any, qpos: np.ndarray, pairs: Collection[tuple[int, int]], most: float
) -> dict[tuple[int, int], float]:
    """Distances that MuJoCo measures between geoms in a pose, none of them above `most`; negative for overlaps."""
    data = load_mujoco().MjData(model)
    data.qpos[:] = qpos
    return _distances(model, data, pairs, most)


def _distances(model: Any, data: Any, pairs: Collection[tuple[int, int]], most: float) -> dict[tuple[int, int], float]:
    mujoco = load_mujoco()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return {pair: float(mujoco.mj_geomDistance(model, data, *pair, most, None)) for pair in pairs}


def _bodies_between(model: Any, pair: tuple[int, int]) -> tuple[list[int], list[int]]:
    """The bodies that carry each geom of a pair and not the other, the innermost first."""
    chains = [body_chain(model, int(model.geom_bodyid[geom])) for geom in pair]
    common = set(chains[0]) & set(chains[1])
    return tuple([body for body in chain if body not in common] for chain in chains)  # pyright: ignore


def _joints_between(model: Any, pair: tuple[int, int]) -> list[int]:
    """The joints that move the geoms of a pair against each other."""
    first, count = model.body_jntadr, model.body_jntnum
    bodies = [body for chain in _bodies_between(model, pair) for body in chain]
    return [int(first[body]) + k for body in bodies for k in range(count[body])]


def _ball(survey: ModelIndex, geom: int, bodies: list[int]) -> tuple[np.ndarray, float]:
    """A ball that holds a geom's, wherever the joints of some bodies, the innermost first, put it."""
    model, home, kinds = survey.model, survey.home, load_mujoco().mjtJoint
    centre, radius = np.array(home.geom_xpos[geom]), float(model.geom_rbound[geom])
    for body in bodies:
        first = int(model.body_jntadr[body])
        for joint in reversed(range(first, first + int(model.body_jntnum[body]))):
            kind, q0 = model.jnt_type[joint], float(model.qpos0[model.jnt_qposadr[joint]])
            low, high = model.jnt_range[joint] - q0 if model.jnt_limited[joint] else (-np.inf, np.inf)
            anchor, axis = home.xanchor[joint], home.xaxis[joint]
            if kind == int(kinds.mjJNT_SLIDE) and np.isfinite(low):
                centre, radius = centre + 0.5 * (low + high) * axis, radius + 0.5 * (high - low)
            elif kind == int(kinds.mjJNT_HINGE):
                centre, more = _turned(centre - anchor, axis, low, high)
                centre, radius = anchor + centre, radius + more
            elif kind == int(kinds.mjJNT_BALL):
                centre, radius = np.array(anchor), radius + float(np.linalg.norm(centre - anchor))
            else:
                return centre, float("inf")
    return centre, radius


def _turned(arm: np.ndarray, axis: np.ndarray, low: float, high: float) -> tuple[np.ndarray, float]:
    """The ball around the arc of a point at `arm` from a hinge."""
    along = (arm @ axis) * axis
    across, half, middle = arm - along, 0.5 * (high - low), 0.5 * (low + high)
    size = float(np.linalg.norm(across))
    if not half < 0.5 * np.pi:
        return along, size
    turned = np.cos(middle) * across + np.sin(middle) * np.cross(axis, across)
    return along + np.cos(half) * turned, size * float(np.sin(half))


OVERLAP_TOLERANCE = 1e-4  # of a machine of 1 m or more, m: shapes that are drawn flush touch as soon as anything moves
MAX_EMBEDDED = 1e-3  # of a machine of 1 m or more, m: how deep it may start in what is at rest and could be left
TOUCH_ROUNDING = 1e-6  # of a machine of 1 m or more, m: flush shapes overlap by it
GeomPair = frozenset[int]


def initial_overlaps(model: Any, qpos: np.ndarray) -> dict[GeomPair, float]:
    """The pairs of geoms that penetrate at qpos and their depths, m, but for what falls without the contact.

    Without what starts deeper than MAX_EMBEDDED in something at rest and can leave it: see `starts_inside`.
    """
    mujoco, survey = load_mujoco(), ModelIndex(model)
    falling, scale = falling_trees(survey), min(1.0, float(model.stat.extent))
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    found: dict[GeomPair, float] = {}
    for c in range(data.ncon):
        contact = data.contact[c]
        geoms, depth = [int(geom) for geom in contact.geom], -float(contact.dist)
        if min(geoms) < 0 or depth <= TOUCH_ROUNDING * scale:
            continue
        if starts_inside(survey, (geoms[0], geoms[1]), qpos, depth):
            continue
        roots = set(model.body_rootid[model.geom_bodyid[geoms]].tolist())
        if len(roots) == 1 or falling.keys().isdisjoint(roots):
            found[frozenset(geoms)] = max(depth, found.get(frozenset(geoms), 0.0))
    return found


def starts_inside(survey: ModelIndex, pair: tuple[int, int], qpos: np.ndarray, depth: float) -> bool:
    """Whether a machine starts inside something at rest, deeper than MAX_EMBEDDED, that its joints could leave."""
    scale = min(1.0, float(survey.model.stat.extent))
    return depth > MAX_EMBEDDED * scale and can_separate(survey, pair, qpos, OVERLAP_TOLERANCE * scale)


def watching(text: str, model: Any, pairs: Collection[GeomPair]) -> str:
    """The text with the contact of some pairs of geoms watched, without force; `model` is what it compiles to.

    Raises:
        ModelError: The file has not all geoms of the model (<attach>, <replicate>).
    """
    root = ElementTree.fromstring(text)
    names = [element.attrib["name"] for element in elements_of_geoms(root, model)]
    watched = {frozenset(names[geom] for geom in pair) for pair in pairs}
    for section in root.findall("contact"):
        for element in section.findall("pair"):
            if frozenset((element.get("geom1"), element.get("geom2"))) in watched:
                section.remove(element)
    section = ElementTree.SubElement(root, "contact")
    for pair in pairs:
        watch(section, *(names[geom] for geom in sorted(pair)))
    return ElementTree.tostring(root, encoding="unicode")
