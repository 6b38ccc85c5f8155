"""Default start, goal and duration of moderate size for a machine that is known only by its model file."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import numpy as np

from planner.dynamics.algorithms import bias, bias_derivatives, mass_matrix
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.facts import Record, free_bases, overlaps
from planner.model.mjcf.model_index import compile_model
from planner.problem.description import holding, within

_WAY = 0.15  # displacement of a joint, as a share of its range
_WAY_ON_FEET = 0.05  # the same for a machine with a free base, which may tip over
_TURN, _SLIDE = 0.5, 0.15  # displacement of a joint without a range: rad; m as a share of the model's extent
_MAX_DISPLACEMENT_RATIO = 4.0  # upper limit of a joint's displacement over that of one without a range
_INSIDE = 0.05  # margin of a start or goal to the limits, as a share of the range
_TO_THE_MIDDLE = (0.0, 0.25, 0.5, 0.75)  # shares of the line from qpos0 to the middle of the ranges, tried as starts
_SMALLER = (1.0, 0.5, 0.25)  # factors of the displacement, tried until no bodies collide
_ON_THE_WAY = 4  # number of poses after the start, goal included, that are checked for collision
_PEAK_SPEED, _PEAK_FORCE = 15.0 / 8.0, 10.0 / math.sqrt(3.0)  # peaks of the quintic time law: d / T and d / T^2
_SHARE = 0.3  # of the velocity and force limits, used at the peaks of the motion
# Driven joints, from which on those move that carry between these shares of the moving mass, if any do: arms and a
# head, but neither what carries all of the machine, which shakes the rest, nor fingers.
_MANY, _LIGHTEST, _HEAVIEST = 13, 0.01, 0.5
_NEWTON, _FLAT = 20, 1e-9  # Newton iterations to an equilibrium; relative rank tolerance of its linear solves
_NEAR, _ROUND = 1.0, 1e-9  # rad or m, displacement to an equilibrium: upper limit; smaller ones count as none
_SHORTEST, _LONGEST = 1.0, 20.0  # s, lower and upper limit of the duration
# s, of which a joint's way is shortened: at most, and times the degrees of freedom squared. A solve of 400 stages of
# the substeps that a damped arm takes, or of 100 with a hundred degrees of freedom, is a few seconds.
_USUAL, _WITH_MANY = 4.0, 1.2e4
_LEAST_PART = 0.2  # of a joint's way: one that would be shortened to less stays where it is
_ROUNDING = 0.01  # of 0.1 s, not rounded up: ways that were shortened to a duration get goals of four digits
_TIPPING = 2.0  # s, lower limit of the duration with unactuated joints


class ExampleTask(NamedTuple):
    """A default task: start, goal and duration."""

    keyframe: str  # Name of the keyframe at the start; "" if the start is none
    start: np.ndarray  # (nq,)
    displaced: dict[int, float]  # Start positions that differ from qpos0, by joint number; {} with a keyframe
    goal: dict[int, float]  # Goal positions, by number of the joints that move
    duration: float  # s, a multiple of 0.1


def example_task(model: Any, mechanism: Mechanism, joints: list[Record]) -> ExampleTask:
    """A start within all ranges and a goal that moves actuated joints by the same share of their ranges, or less.

    Less where that takes long; and only some of many joints: the task is to be planned and proved in seconds.
    """
    keyframe, start = _start(model, mechanism, joints)
    displaced = {j: float(start[one["position"]]) for j, one in enumerate(joints)
             if one["unit"] and start[one["position"]] != model.qpos0[one["position"]]}  # fmt: skip
    driven = _of_their_own(mechanism, actuated_joints(mechanism))
    standing = bool(free_bases(model))
    if len(driven) >= _MANY and not standing:
        driven = _between_base_and_fingers(mechanism, driven)
    ways = {j: (_WAY_ON_FEET if standing else _WAY) * _room(model, joints[j]) for j in driven}
    ways = _in_time(mechanism, start, _off_tendons(mechanism, start, ways))
    goal = _allowed(model, mechanism, joints, start, ways)
    if not standing:
        goal = _with_balance(mechanism, start, goal)
    return ExampleTask(keyframe, start, {} if keyframe else displaced, goal, _duration(mechanism, start, goal))


def start_of_model(mechanism: Mechanism) -> str | dict[str, float] | None:
    """The start of a problem that names none: a keyframe within all ranges, else {}, as the file draws the machine.

    None where that pose is outside of a range, or moving bodies overlap in it.
    """
    if name := keyframe_within_ranges(mechanism):
        return name
    return None if conflict_as_drawn(mechanism) else {}


def conflict_as_drawn(mechanism: Mechanism) -> str:
    """Why a motion does not start as the file draws the machine: a joint outside of its range, or an overlap; or ""."""
    for i in np.flatnonzero(mechanism.kind == SCREW):
        value, (low, high) = float(mechanism.qpos0[mechanism.q_address[i]]), mechanism.joint_range[i]
        if not within(value, low, high):
            return f"{mechanism.joint_of(int(i))} is at {value:.4g}, outside of its range {low:.4g} to {high:.4g}"
    model = compile_model(mechanism.original or mechanism.mjcf, mechanism.assets)
    pairs = [one for one in overlaps(model, mechanism.qpos0) if "world" not in one.bodies]
    if not pairs:
        return ""
    named = json.dumps([list(one.bodies) for one in pairs if all(one.bodies)], ensure_ascii=False)
    advice = "" if named == "[]" else f", where the real ones do not touch write exclude = {named}"
    return f"{pairs[0].shapes} overlap by {pairs[0].depth:.2g} m{advice}"


def keyframe_within_ranges(mechanism: Mechanism) -> str:
    """The keyframe "home" within all ranges of joints, else the first one that is; "" for none."""
    names = sorted(mechanism.keyframes, key=lambda name: name != "home")  # the others stay in the file's order
    return next((name for name in names if _within_ranges(mechanism, mechanism.keyframes[name])), "")


def _within_ranges(mechanism: Mechanism, x: np.ndarray) -> bool:
    """Whether the hinges and slides of a state (nx,) or positions (nq,) are within their ranges."""
    single = mechanism.kind == SCREW
    q, (low, high) = x[mechanism.q_address[single]], mechanism.joint_range[single].T
    return bool(np.all(within(q, low, high)))


def actuated_joints(mechanism: Mechanism) -> list[int]:
    """Numbers of the hinges and slides with an actuator; of all hinges and slides if there is no actuator."""
    reached = mechanism.directly_actuated | (mechanism.nu == 0)
    return [
        j for j, links in enumerate(mechanism.joint_links)
        if links.stop - links.start == 1 and mechanism.kind[links.start] == SCREW and reached[links.start]
    ]  # fmt: skip


def _of_their_own(mechanism: Mechanism, driven: list[int]) -> list[int]:
    """Numbers of the joints among `driven` that are independent under the couplings."""
    cams = {dof for cam in mechanism.polynomial_couplings for dof in cam.dofs}
    driven = [j for j in driven if mechanism.joint_links[j].start not in cams]
    if mechanism.reduction is None:
        return driven
    dof = {j: mechanism.joint_links[j].start for j in driven}
    rows, kept = np.zeros((0, mechanism.reduction.G.shape[1])), list[int]()
    for j in sorted(driven, key=lambda j: dof[j] not in mechanism.reduction.independent):  # pyright: ignore
        more = np.vstack([rows, mechanism.reduction.G[dof[j]]])
        if np.linalg.matrix_rank(more) > len(rows):
            rows, kept = more, [*kept, j]
    return sorted(kept)


def _between_base_and_fingers(mechanism: Mechanism, driven: list[int]) -> list[int]:
    """Numbers of the joints among `driven` that carry between _LIGHTEST and _HEAVIEST of the mass; all if none does."""
    carried = np.array(mechanism.mass, dtype=float)
    for i in range(len(carried) - 1, -1, -1):  # parents precede children
        if mechanism.parent[i] >= 0:
            carried[mechanism.parent[i]] += carried[i]
    share = carried / (mechanism.mass.sum() or 1.0)
    found = [j for j in driven if _LIGHTEST <= share[mechanism.joint_links[j].start] <= _HEAVIEST]
    return found or driven


def _off_tendons(
    mechanism: Mechanism, start: np.ndarray, ways: dict[int, float]
) -> dict[int, float]:  # fmt: skip
    """Displacements by joint, without the joints of a fixed tendon that could leave its range in either direction."""
    number = {links.start: j for j, links in enumerate(mechanism.joint_links)}
    for tendon in mechanism.tendons:
        c, own = np.array(tendon.coefficients), [number[i] for i in tendon.dofs]
        room = min(float(start[mechanism.q_address[list(tendon.dofs)]] @ c - tendon.range[0]),
                   float(tendon.range[1] - start[mechanism.q_address[list(tendon.dofs)]] @ c))  # fmt: skip
        if sum(abs(k) * ways.get(j, 0.0) for k, j in zip(c, own, strict=True)) > (1.0 - _INSIDE) * room:
            ways = {j: way for j, way in ways.items() if j not in own}
    return ways


def _start(model: Any, mechanism: Mechanism, joints: list[Record]) -> tuple[str, np.ndarray]:
    """Name and positions (nq,) of a keyframe within all ranges; else "" and a pose within them.

    The pose is the first on the line from qpos0 to the middle of the ranges in which no moving bodies overlap; qpos0,
    clipped to the ranges, if there is none or the base is free.
    """
    if name := keyframe_within_ranges(mechanism):
        return name, mechanism.keyframes[name][: mechanism.nq].copy()
    own, middle = np.array(model.qpos0), np.array(model.qpos0)
    for one in joints:
        if one["range"] is not None and one["unit"]:
            (low, high), place = one["range"], one["position"]
            room = _INSIDE * (high - low)
            if not low <= own[place] <= high:
                own[place] = _short(float(np.clip(own[place], low + room, high - room)))
            middle[place] = 0.5 * (low + high)
    if free_bases(model):  # its height above the ground is part of the pose
        return "", own
    for part in _TO_THE_MIDDLE:
        start = own if part == 0.0 else np.array([_short(x) for x in own + part * (middle - own)])
        if all("world" in one.bodies for one in overlaps(model, start)):
            return "", start
    return "", own


def _room(model: Any, joint: Record) -> float:
    usual, ends = _TURN / _WAY if joint["unit"] == "rad" else _SLIDE / _WAY * float(model.stat.extent), joint["range"]
    return usual if ends is None else min(ends[1] - ends[0], _MAX_DISPLACEMENT_RATIO * usual)


def _allowed(
    model: Any, mechanism: Mechanism, joints: list[Record], start: np.ndarray, ways: dict[int, float]
) -> dict[int, float]:
    """Goal positions by joint, towards the larger side of its range, without new overlaps of bodies on the path.

    Displacements are reduced or reversed to avoid overlaps and, with a fixed base, so that actuators can hold the goal.
    """
    loose = bool(free_bases(model))
    before = {frozenset(one.bodies) for one in overlaps(model, start)}
    best: dict[int, float] = {}
    full = {j: _goal(joints[j], start, way) for j, way in ways.items()}
    for part in _SMALLER:
        for turned in (1.0, -1.0):
            goal = {j: _goal(joints[j], start, part * turned * way) for j, way in ways.items()}
            poses = [_between(joints, start, goal, s / _ON_THE_WAY) for s in range(1, _ON_THE_WAY + 1)]
            touches = any({frozenset(one.bodies) for one in overlaps(model, pose)} - before for pose in poses)
            if not touches and (loose or _holds(mechanism, poses[-1])):
                return goal
            if not touches:
                best = best or goal
    return best or full


def _goal(joint: Record, start: np.ndarray, way: float) -> float:
    """Start plus displacement towards the larger side of the range, rad or m; a negative one to the other side."""
    q = float(start[joint["position"]])
    if joint["range"] is None:
        return _short(q + way)
    low, high = joint["range"]
    room = _INSIDE * (high - low)
    side = 1.0 if q <= 0.5 * (low + high) else -1.0
    return _short(float(np.clip(q + side * way, low + room, high - room)))


def _between(joints: list[Record], start: np.ndarray, goal: dict[int, float], s: float) -> np.ndarray:
    pose = start.copy()
    for j, end in goal.items():
        place = joints[j]["position"]
        pose[place] += s * (end - pose[place])
    return pose


def _holds(mechanism: Mechanism, pose: np.ndarray) -> bool:
    """Whether static equilibrium at a pose (nq,) is within the actuators' control and force ranges."""
    actuators = mechanism.actuators
    u, force = holding(mechanism, pose)
    held = within(u, *actuators.control_range.T) & within(force, *actuators.force_range.T)
    return bool(np.all(held))


def _with_balance(mechanism: Mechanism, start: np.ndarray, goal: dict[int, float]) -> dict[int, float]:
    """The goal with unactuated joints at static equilibrium under gravity and springs, by Newton's method.

    Only for hinges and slides without couplings. The goal unchanged if no equilibrium is within _NEAR of the start.
    """
    reached = mechanism.directly_actuated
    loose = np.flatnonzero(~reached)
    if mechanism.nu == 0 or mechanism.couplings or not len(loose) or not np.all(mechanism.kind[loose] == SCREW):
        return goal
    pose, still = start.copy(), np.zeros(mechanism.nv)
    number = {links.start: j for j, links in enumerate(mechanism.joint_links)}
    for j, end in goal.items():
        pose[mechanism.q_address[mechanism.joint_links[j].start]] = end
    places = mechanism.q_address[loose]
    for _ in range(_NEWTON):
        pull = bias(mechanism, pose, still)[loose]
        slope = bias_derivatives(mechanism, pose, still)[0][np.ix_(loose, loose)]
        pose[places] -= np.linalg.lstsq(slope, pull, rcond=_FLAT)[0]
    displacement, balanced = np.abs(pose - start)[places], np.abs(bias(mechanism, pose, still)[loose])
    if not (balanced <= 1e-9 * _scale(mechanism)).all() or displacement.max() > _NEAR:
        return goal
    ends = {number[int(i)]: float(pose[mechanism.q_address[i]]) for i in loose[displacement > _ROUND]}
    return goal | {j: float(f"{end:.9g}") for j, end in ends.items()}  # to 9 digits, enough for an equilibrium


def _scale(mechanism: Mechanism) -> float:
    """Weight of the moving mass, N; also the scale of moments, N m, for lengths of about 1 m."""
    return float(mechanism.mass.sum() * np.linalg.norm(mechanism.gravity)) or 1.0


def _duration(mechanism: Mechanism, start: np.ndarray, goal: dict[int, float]) -> float:
    """Duration of the quintic time law, s: peaks at most _SHARE of velocity and force limits, rounded up to 0.1 s."""
    inertia, peak = np.diagonal(mass_matrix(mechanism, start)), strongest(mechanism)
    duration = _shortest(mechanism)
    for j, end in goal.items():
        i = mechanism.joint_links[j].start
        displacement = abs(end - start[mechanism.q_address[i]])
        duration = max(duration, _PEAK_SPEED * displacement / (_SHARE * mechanism.velocity_limit[i]))
        if peak[i] > 0.0:
            duration = max(duration, math.sqrt(_PEAK_FORCE * displacement * inertia[i] / (_SHARE * peak[i])))
    return math.ceil(10.0 * min(duration, _LONGEST) - _ROUNDING) / 10.0


def _shortest(mechanism: Mechanism) -> float:
    return _SHORTEST if np.all(mechanism.directly_actuated) else _TIPPING


def _in_time(mechanism: Mechanism, start: np.ndarray, ways: dict[int, float]) -> dict[int, float]:
    """Displacements by joint, shortened to what the time law allows in a duration that is soon planned.

    Joints too slow for _LEAST_PART of their way stay, unless all are.
    """
    duration = max(min(_USUAL, _WITH_MANY / mechanism.nv**2), _shortest(mechanism))
    inertia, peak = np.diagonal(mass_matrix(mechanism, start)), strongest(mechanism)
    force = np.where(peak > 0.0, peak, np.inf)
    reached = _SHARE * np.minimum(
        duration * mechanism.velocity_limit / _PEAK_SPEED, duration**2 * force / (_PEAK_FORCE * inertia)
    )
    shorter = {j: min(way, float(reached[mechanism.joint_links[j].start])) for j, way in ways.items()}
    quick = {j: way for j, way in shorter.items() if way >= _LEAST_PART * ways[j]}
    return quick or shorter


def strongest(mechanism: Mechanism) -> np.ndarray:
    """(nv,) max generalized force of the actuators at each degree of freedom; infinite without limits."""
    actuators = mechanism.actuators
    control = np.abs(actuators.control_range).max(axis=1, initial=0.0)
    # the force of one that depends on the state has no bound from its control
    force = np.where(actuators.depends_on_state, np.inf, np.abs(actuators.gain) * control)
    force = np.minimum(force, np.abs(actuators.force_range).max(axis=1, initial=0.0))
    moment = np.abs(actuators.moment)
    each = np.multiply(moment, force[:, None], out=np.zeros_like(moment), where=moment > 0.0)
    return each.sum(axis=0)


def _short(value: float) -> float:
    """A position rounded to 4 digits."""
    return float(f"{value:.4g}")
