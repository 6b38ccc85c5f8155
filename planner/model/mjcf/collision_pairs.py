"""Select the pairs of geoms between which a motion from a given pose can keep a clearance.

Candidates are the pairs that MuJoCo would test for contact (contype, conaffinity, parents, excluded bodies), if their
bounding spheres can meet within the ranges of the joints. Pairs that overlap where the motion starts have no clearance:
within a robot, its base included, the file draws them so, and they are left out and named; against an obstacle at rest
the start is refused. Where only bounding shapes overlap, the pair is left out if no pose brings the geoms nearer.

Spheres, capsules, boxes and planes are collision shapes themselves; other geoms get a bounding shape.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.contact.bounding_fit import fit_bounding_shape, rim_points, round_points
from planner.model.contact.signed_distance import MEASURES, CollisionShape, in_order, kind_of, placed
from planner.model.mjcf.initial_overlaps import (
    OVERLAP_TOLERANCE,
    can_separate,
    distances_in,
    is_own,
    may_collide,
    min_distance_over_ranges,
)
from planner.model.mjcf.model_index import ModelIndex, contact_pairs, mesh_vertices

NO_SOLID = ("hfield", "sdf")


def shape_name(model: Any, geom: int) -> str:
    """A geom for a sentence, by its own name or its body's: "geom 'tip'" or "link 'forearm'"."""
    if name := model.geom(geom).name:
        return f"geom {name!r}"
    body = model.body(int(model.geom_bodyid[geom])).name
    return f"body {body!r}" if body else f"geom number {geom}"


def pair_name(model: Any, pair: tuple[int, int]) -> str:
    """Two geoms for a sentence."""
    return " and ".join(shape_name(model, geom) for geom in pair)


def has_solid(model: Any, geom: int) -> bool:
    """Whether a geom is of a kind that solids stand for."""
    kinds = load_mujoco().mjtGeom
    return model.geom_type[geom] not in [int(getattr(kinds, f"mjGEOM_{kind.upper()}")) for kind in NO_SOLID]


def solids_of(survey: ModelIndex, geoms: list[int]) -> dict[int, CollisionShape]:
    """The solids of geoms, by their numbers; each mesh is fitted once."""
    model, kinds = survey.model, load_mujoco().mjtGeom
    links, fits, found = survey.carriers[0], {}, {}
    for geom in geoms:
        kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom])
        given = shape_name(model, geom), geom, int(links[model.geom_bodyid[geom]])
        T, none = survey.geoms[geom], np.zeros(3)
        if kind == int(kinds.mjGEOM_PLANE):
            found[geom] = CollisionShape(*given, T, none, 0.0, plane=True)
        elif kind == int(kinds.mjGEOM_SPHERE):
            found[geom] = CollisionShape(*given, T, none, float(size[0]))
        elif kind == int(kinds.mjGEOM_CAPSULE):
            found[geom] = CollisionShape(*given, T, np.array([0.0, 0.0, size[1]]), float(size[0]))
        elif kind == int(kinds.mjGEOM_BOX):
            found[geom] = CollisionShape(*given, T, size, 0.0)
        else:
            key = (kind, int(model.geom_dataid[geom]), size.tobytes() if kind != int(kinds.mjGEOM_MESH) else b"")
            if key not in fits:
                fits[key] = fit_bounding_shape(_points(model, geom))
            fit = fits[key]
            found[geom] = CollisionShape(*given, T @ fit.T, fit.half, fit.radius, overestimate=fit.overestimate)
    return found


def _points(model: Any, geom: int) -> np.ndarray:
    """Points (n, 3) in a geom's frame whose hull holds it."""
    kinds, size = load_mujoco().mjtGeom, model.geom_size[geom]
    if model.geom_type[geom] == int(kinds.mjGEOM_CYLINDER):
        return rim_points(float(size[0]), float(size[1]))
    if model.geom_type[geom] == int(kinds.mjGEOM_ELLIPSOID):
        return round_points(size)
    return mesh_vertices(model, int(model.geom_dataid[geom]))


MAX_NAMED = 3
SLIGHT = 0.02  # of the clearance, by which a distance that no joint changes may change by rounding
SLACK = 1e-6  # m by which a pair that starts nearer than the clearance may come nearer still: rounding


class CollisionPair(NamedTuple):
    """Two solids to keep apart, in the order of their distance.

    Attributes:
        a: The first.
        b: The second; a plane or box is never before a line.
        required_clearance: m: the clearance, or the smaller distance at the start or the goal.
        distance_offset: m, added to the shapes' distance, where bounding shapes are nearer at the start than the geoms.
        spare_clearance: m, by which start and goal exceed `required_clearance`.
    """

    a: CollisionShape
    b: CollisionShape
    required_clearance: float
    distance_offset: float
    spare_clearance: float

    @property
    def names(self) -> str:
        """Both, for a sentence."""
        return f"{self.a.name} and {self.b.name}"


class CollisionPairs(NamedTuple):
    """The pairs to keep apart, and sentences about those that are not, or not so far."""

    pairs: tuple[CollisionPair, ...]
    notes: tuple[str, ...]


def select_collision_pairs(
    survey: ModelIndex, poses: dict[str, np.ndarray], clearance: float, *, own: bool = True, world: bool = True,
    known: Collection[frozenset[int]] = (),
) -> CollisionPairs:  # fmt: skip
    """The pairs of a file that a motion is to keep apart.

    Args:
        survey: Of the file as the user gave it.
        poses: qpos (nq,) by name: first that of the start, where the pairs are judged, then goals that must be free.
        clearance: m.
        own: Whether pairs of one machine, its base included, or of two that move are wanted.
        world: Whether pairs of which one is at rest are wanted.
        known: Pairs of geoms that are not wanted, since the plan knows their contact.

    Raises:
        PlannerError: A pose is in collision with the world, or nearer to it than the clearance.
    """
    model = survey.model
    asked = [pair for pair in contact_pairs(model) if frozenset(pair) not in known]
    asked = [pair for pair in asked if (own if is_own(model, pair) else world)]
    unknown = [pair for pair in asked if not all(has_solid(model, geom) for geom in pair)]
    found = [pair for pair in asked if pair not in unknown and may_collide(survey, pair, clearance)]
    at = {name: distances_in(model, qpos, found, 2.0 * clearance) for name, qpos in poses.items()}
    start = next(iter(poses))
    flush = OVERLAP_TOLERANCE * min(1.0, float(model.stat.extent))
    drawn = [pair for pair in found if at[start][pair] <= flush and not can_separate(survey, pair, poses[start], flush)]
    found = [pair for pair in found if pair not in drawn]
    for name, distances in at.items():
        _check(survey, name, poses[name], {pair: distances[pair] for pair in found}, clearance)
    solids = solids_of(survey, sorted({geom for pair in found for geom in pair}))
    pairs, close, lifted, anyway = [], [], [], []
    for pair in found:
        required = min(clearance, *(distances[pair] - SLACK for distances in at.values()))
        a, b = in_order(solids[pair[0]], solids[pair[1]])
        distance = min(_between(survey, qpos, a, b) for qpos in poses.values())
        offset = max(0.0, required - distance)
        if offset > SLACK and min_distance_over_ranges(survey, pair, poses.values()) > required - SLIGHT * clearance:
            anyway.append((a, b))
            continue
        pairs.append(CollisionPair(a, b, required, offset, max(0.0, distance + offset - required - SLACK)))
        close += [pairs[-1]] if required < clearance else []
        lifted += [pairs[-1]] if offset > SLACK else []
    notes = _notes(survey, pairs, drawn, unknown, close, lifted, clearance)
    if anyway:
        names = _some([f"{a.name} and {b.name}" for a, b in anyway])
        notes += (f"Left out, since no pose brings the shapes nearer, though their fits overlap: {names}.",)
    return CollisionPairs(tuple(pairs), notes)


def _between(survey: ModelIndex, qpos: np.ndarray, a: CollisionShape, b: CollisionShape) -> float:
    """The distance of two solids in a pose of the file, m."""
    model = survey.model
    data = load_mujoco().MjData(model)
    data.qpos[:] = qpos
    load_mujoco().mj_kinematics(model, data)
    poses = []
    for solid in (a, b):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = data.geom_xmat[solid.geom].reshape(3, 3), data.geom_xpos[solid.geom]
        poses.append((T @ np.linalg.inv(survey.geoms[solid.geom]))[None])
    one, other = (placed([solid], T) for solid, T in zip((a, b), poses, strict=True))
    return float(MEASURES[kind_of(a, b)](one, other).distance[0])


def _check(
    survey: ModelIndex, name: str, qpos: np.ndarray, distances: dict[tuple[int, int], float], clearance: float
) -> None:
    """Refuse a pose in collision with the world or too near to it."""
    model = survey.model
    if not distances:
        return
    pair = min(distances, key=lambda pair: distances[pair])
    names = pair_name(model, pair)
    if distances[pair] <= 0.0:
        raise PlannerError(
            f"{name} is in collision: {names} overlap by {-distances[pair]:.3g} m, expected a pose where nothing "
            "touches; move one of the two, or exclude the pair: `exclude` beside obstacles, <contact><exclude> in a "
            "model."
        )
    met = {pair: distance for pair, distance in distances.items()
           if distance < clearance and can_separate(survey, pair, qpos, clearance)}  # fmt: skip
    if met:
        pair = min(met, key=lambda pair: met[pair])
        names = pair_name(model, pair)
        raise PlannerError(
            f"{name} has {names} {met[pair]:.3g} m apart, expected at least the clearance {clearance:g} m: write "
            f"clearance = {_shorter(met[pair])} in [avoid], or move one of the two."
        )


def _shorter(distance: float) -> str:
    """A round number below a distance."""
    digit = 10.0 ** np.floor(np.log10(max(distance, 1e-9)))
    return f"{np.floor(0.9 * distance / digit * 10.0) * digit / 10.0:.2g}"


def _notes(
    survey: ModelIndex, pairs: list[CollisionPair], drawn: list[tuple[int, int]], unknown: list[tuple[int, int]],
    close: list[CollisionPair], lifted: list[CollisionPair], clearance: float,
) -> tuple[str, ...]:  # fmt: skip
    """One sentence about what is kept apart, in numbers, then the names of what is not, or not so far."""
    model = survey.model
    fits = {solid.geom: solid for pair in pairs for solid in pair[:2] if solid.overestimate > 0.0}
    left = len(drawn) + len(model.exclude_signature) + len(unknown)
    counted = {"nearer at the start or goal": len(close), "fits that overlap there": len(lifted), "left out": left}
    few = "; ".join(f"{words}: {number}" for words, number in counted.items() if number)
    more = f" ({few})" if few else ""
    notes = [f"{len(pairs)} pair{'s' * (len(pairs) != 1)} of shapes are kept {clearance:g} m apart{more}."]
    if fits:
        most = max(fits.values(), key=lambda solid: solid.overestimate)
        shapes = "1 shape is" if len(fits) == 1 else f"{len(fits)} shapes are"
        notes.append(
            f"{shapes} fitted by capsules or round boxes, which reach up to {most.overestimate:.2g} m beyond them "
            f"({most.name})."
        )
    bodies = [
        f"{model.body(int(s) >> 16).name} and {model.body(int(s) & 0xFFFF).name}" for s in model.exclude_signature
    ]
    for words, names in (
        ("Not kept apart, since they overlap at the start", [pair_name(model, pair) for pair in drawn]),
        ("Not kept apart, since the model excludes them", bodies),
        ("Not kept apart, since one is a height field or an SDF", [pair_name(model, pair) for pair in unknown]),
        ("Nearer than the clearance at the start or goal, and to come no nearer", [pair.names for pair in close]),
    ):
        notes += [f"{words}: {_some(names)}."] if names else []
    if lifted:
        offset = max(pair.distance_offset for pair in lifted)
        notes.append(
            f"Fits overlap at the start or goal where shapes do not, which is let pass, by up to {offset:.2g} m: "
            f"{_some([pair.names for pair in lifted])}."
        )
    return tuple(notes)


def _some(names: list[str]) -> str:
    names = list(dict.fromkeys(names))
    more = f", and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return "; ".join(names[:MAX_NAMED]) + more
