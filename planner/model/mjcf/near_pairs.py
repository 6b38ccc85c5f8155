"""Which geoms of a file can come near each other, and which of them a motion from a given pose can keep apart.

What MuJoCo would test for contact is surveyed (contype, conaffinity, parents, excluded bodies); of that, pairs whose
bounding spheres can meet wherever their joints go within their ranges. What overlaps where the motion starts cannot be
kept apart: within a machine, its base included, that is how its file draws it, and it is left out and named; against
something at rest the start is refused.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.contact.solids import MEASURES, Solid, in_order, kind_of, placed
from planner.model.mjcf.overlaps import FLUSH
from planner.model.mjcf.solids import has_solid, shape_name, solids_of
from planner.model.mjcf.survey import Survey, contact_pairs

MOST_NAMED = 3
TRIED = 20  # poses of what turns on a base
SLACK = 1e-6  # m by which a pair that starts nearer than the clearance may come nearer still: rounding


class NearPair(NamedTuple):
    """Two solids to keep apart, in the order of their distance.

    Attributes:
        a: The first.
        b: The second; a plane or box is never before a line.
        least: m, that they are kept apart: the clearance, or what the start leaves of it.
        lift: m that is added to the solids' distance, where fits are nearer at the start than what they stand for.
        room: m, by which they can be kept further apart than `least`: what the start and the goal leave.
    """

    a: Solid
    b: Solid
    least: float
    lift: float
    room: float

    @property
    def names(self) -> str:
        """Both, for a sentence."""
        return f"{self.a.name} and {self.b.name}"


class Near(NamedTuple):
    """The pairs to keep apart, and sentences about those that are not, or not so far."""

    pairs: tuple[NearPair, ...]
    notes: tuple[str, ...]


def near_pairs(
    survey: Survey, poses: dict[str, np.ndarray], clearance: float, *, own: bool = True, world: bool = True,
    known: Collection[frozenset[int]] = (),
) -> Near:  # fmt: skip
    """The pairs of a file that a motion is to keep apart.

    Args:
        survey: Of the file as the user gave it.
        poses: qpos (nq,) by name: "start", where the pairs are judged, and others ("goal") that must be free.
        clearance: m.
        own: Whether pairs of one machine, its base included, or of two that move are wanted.
        world: Whether pairs of which one is at rest are wanted.
        known: Pairs of geoms that are not wanted, since the plan knows their contact.

    Raises:
        PlannerError: A pose is in collision with the world, or nearer to it than the clearance.
    """
    model = survey.model
    asked = [pair for pair in contact_pairs(model) if frozenset(pair) not in known]
    asked = [pair for pair in asked if (own if _is_own(model, pair) else world)]
    unknown = [pair for pair in asked if not all(has_solid(model, geom) for geom in pair)]
    found = [pair for pair in asked if pair not in unknown and can_meet(survey, pair, clearance)]
    at = {name: distances_in(model, qpos, found, 2.0 * clearance) for name, qpos in poses.items()}
    flush = FLUSH * min(1.0, float(model.stat.extent))
    drawn = [pair for pair in found if at["start"][pair] <= flush and not _is_met(survey, pair, poses["start"], flush)]
    found = [pair for pair in found if pair not in drawn]
    for name, distances in at.items():
        _check(survey, name, poses[name], {pair: distances[pair] for pair in found}, clearance)
    solids = solids_of(survey, sorted({geom for pair in found for geom in pair}))
    pairs, close, lifted = [], [], []
    for pair in found:
        least = min(clearance, *(distances[pair] - SLACK for distances in at.values()))
        a, b = in_order(solids[pair[0]], solids[pair[1]])
        apart = min(_between(survey, qpos, a, b) for qpos in poses.values())
        lift = max(0.0, least - apart)
        pairs.append(NearPair(a, b, least, lift, max(0.0, apart + lift - least - SLACK)))
        close += [pairs[-1]] if least < clearance else []
        lifted += [pairs[-1]] if lift > SLACK else []
    return Near(tuple(pairs), _notes(survey, pairs, drawn, unknown, close, lifted, clearance))


def can_meet(survey: Survey, pair: tuple[int, int], clearance: float) -> bool:
    """Whether the bounding spheres of two geoms can come as near as the clearance, within the joints' ranges."""
    model, home = survey.model, survey.home
    chains = [_chain(model, int(model.geom_bodyid[geom])) for geom in pair]
    common = set(chains[0]) & set(chains[1])
    balls = [_ball(survey, geom, [body for body in chain if body not in common])
             for geom, chain in zip(pair, chains, strict=True)]  # fmt: skip
    planes = [model.geom_type[geom] == int(load_mujoco().mjtGeom.mjGEOM_PLANE) for geom in pair]
    if any(planes):
        flat = planes.index(True)
        normal, (centre, radius) = home.geom_xmat[pair[flat]].reshape(3, 3)[:, 2], balls[1 - flat]
        if balls[flat][1] > 0.0:  # it moves
            return True
        return bool(normal @ (centre - home.geom_xpos[pair[flat]]) - radius <= clearance)
    (first, r), (second, s) = balls
    return bool(np.linalg.norm(first - second) - r - s <= clearance)


def _chain(model: Any, body: int) -> list[int]:
    chain = [body]
    while chain[-1] > 0:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def _ball(survey: Survey, geom: int, bodies: list[int]) -> tuple[np.ndarray, float]:
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


def distances_in(
    model: Any, qpos: np.ndarray, pairs: Collection[tuple[int, int]], most: float
) -> dict[tuple[int, int], float]:
    """Distances that MuJoCo measures between geoms in a pose, none of them above `most`; negative for overlaps."""
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return {pair: float(mujoco.mj_geomDistance(model, data, *pair, most, None)) for pair in pairs}


def _between(survey: Survey, qpos: np.ndarray, a: Solid, b: Solid) -> float:
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


def _is_own(model: Any, pair: tuple[int, int]) -> bool:
    """Whether a pair is of one machine, its base included, or of two things that move."""
    bodies = model.geom_bodyid[list(pair)]
    root = model.body_rootid[bodies]
    return bool((root[0] == root[1] and root[0] > 0) or np.all(model.body_weldid[bodies] > 0))


def _is_met(survey: Survey, pair: tuple[int, int], qpos: np.ndarray, apart: float) -> bool:
    """Whether a pair is of a machine and something at rest that its joints can take further apart.

    What turns on a base that is drawn into the world cannot leave it: the pair is as near in all its poses.
    """
    model, kinds = survey.model, load_mujoco().mjtJoint
    if _is_own(model, pair):
        return False
    body = int(model.body_weldid[model.geom_bodyid[list(pair)]].max())
    if int(model.body_weldid[model.body_parentid[body]]) != 0:
        return True
    first, rng = int(model.body_jntadr[body]), np.random.default_rng(0)
    for _ in range(TRIED):
        pose = np.array(qpos)
        for joint in range(first, first + int(model.body_jntnum[body])):
            if model.jnt_type[joint] not in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
                return True
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
            pose[model.jnt_qposadr[joint]] = rng.uniform(low, high)
        if distances_in(model, pose, [pair], apart + 1.0)[pair] > apart:
            return True
    return False


def _check(
    survey: Survey, name: str, qpos: np.ndarray, distances: dict[tuple[int, int], float], clearance: float
) -> None:
    """Refuse a pose in collision with the world or too near to it."""
    model = survey.model
    if not distances:
        return
    pair = min(distances, key=lambda pair: distances[pair])
    names = " and ".join(shape_name(model, geom) for geom in pair)
    if distances[pair] <= 0.0:
        raise PlannerError(
            f"the {name} is in collision: {names} overlap by {-distances[pair]:.3g} m, expected a {name} where nothing "
            "touches; move one of the two, or exclude the pair in the model (<contact><exclude>)."
        )
    met = {pair: distance for pair, distance in distances.items()
           if distance < clearance and _is_met(survey, pair, qpos, clearance)}  # fmt: skip
    if met:
        pair = min(met, key=lambda pair: met[pair])
        names = " and ".join(shape_name(model, geom) for geom in pair)
        raise PlannerError(
            f"the {name} has {names} {met[pair]:.3g} m apart, expected at least the clearance {clearance:g} m: write "
            f"clearance = {_shorter(met[pair])} in [avoid], or another {name}."
        )


def _shorter(distance: float) -> str:
    """A round number below a distance."""
    digit = 10.0 ** np.floor(np.log10(max(distance, 1e-9)))
    return f"{np.floor(0.9 * distance / digit * 10.0) * digit / 10.0:.2g}"


def _notes(
    survey: Survey, pairs: list[NearPair], drawn: list[tuple[int, int]], unknown: list[tuple[int, int]],
    close: list[NearPair], lifted: list[NearPair], clearance: float,
) -> tuple[str, ...]:  # fmt: skip
    """What is kept apart and what is not, each named once."""
    model = survey.model
    names = [" and ".join(shape_name(model, geom) for geom in pair) for pair in drawn]
    fits = {solid.geom: solid for pair in pairs for solid in pair[:2] if solid.excess > 0.0}
    notes = [f"{len(pairs)} pair{'s' * (len(pairs) != 1)} of shapes are kept {clearance:g} m apart."]
    if fits:
        most = max(fits.values(), key=lambda solid: solid.excess)
        notes.append(
            f"{len(fits)} shapes are fitted by capsules or round boxes, which reach up to {most.excess:.2g} m beyond "
            f"them ({most.name})."
        )
    if drawn:
        notes.append(f"Not kept apart, since they overlap at the start: {_some(names)}.")
    if len(model.exclude_signature):
        bodies = [f"{model.body(int(s) >> 16).name} and {model.body(int(s) & 0xFFFF).name}"
                  for s in model.exclude_signature]  # fmt: skip
        notes.append(f"Not kept apart, since the model excludes them: {_some(bodies)}.")
    if unknown:
        kinds = [" and ".join(shape_name(model, geom) for geom in pair) for pair in unknown]
        notes.append(f"Not kept apart, since one is a height field or an SDF: {_some(kinds)}.")
    if close:
        notes.append(
            f"Nearer than the clearance at the start or goal, and to come no nearer: {_some([p.names for p in close])}."
        )
    if lifted:
        most = max(lifted, key=lambda pair: pair.lift)
        notes.append(
            f"Fits overlap at the start or goal where shapes do not, which is let pass, by up to {most.lift:.2g} m: "
            f"{_some([p.names for p in lifted])}."
        )
    return tuple(notes)


def _some(names: list[str]) -> str:
    names = list(dict.fromkeys(names))
    more = f", and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return "; ".join(names[:MOST_NAMED]) + more
