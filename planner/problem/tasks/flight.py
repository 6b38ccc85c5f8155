"""Flight: goals in the air, and flights of a gait, that no legs push a machine to; jumps as references.

Goals in flight are refused where gravity does not allow their time, or the legs' work their height. A machine that
stands at the start, is to be a height c above all that its legs reach from the ground at t, and on the ground again at
T, flies within 0 ... T; so whatever its legs can do

    c <= g t (T - t) / 2,

which a parabola from 0 to T has at t. It leaves the ground at v = c / s + g s / 2 or faster, s the shorter of t and
sqrt(2 c / g), the time to its apex. From the last moment of rest on the actuators do at most the work of their largest
forces over the whole ranges of their joints, and that is at least m v^2 / 2. Springs may have stored more:
machines with some are not judged by work. Both are bounds: what is not refused may still be impossible. What the
actuators' forces lift at rest is no bound: a leg that is nearly straight carries any load, so that one that is planted
ahead turns speed along the ground into height.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contacts import contact_forces
from planner.dynamics.inverse_kinematics import Target, inverse_kinematics
from planner.dynamics.kinematics import center_of_mass, frame_pose, jacobian
from planner.dynamics.statics import STRIDE, clearance
from planner.model.capabilities import stands_on_ground, thrusters, unreached_dofs
from planner.model.mechanism import Frame, Mechanism
from planner.problem.example_task import strongest
from planner.problem.initial_guess import minimum_jerk
from planner.problem.tasks.legs import (
    REACHED,
    STILL,
    Foot,
    bent,
    height_of,
    legs_of,
    points_of_feet,
    shifted,
    standing_feet,
)
from planner.problem.tasks.poses import Poses, stage_targets
from planner.problem.tasks.timed_task import Task

DEPTHS = (2.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)  # of c: for accelerations of 2, 4 and 8 g
LONGEST_PUSH = 0.6  # of the time on the ground before a take-off, the rest of it for the way down
HALVINGS = 6  # of the interval in which legs begin to reach the ground: to 2 % of it
MATCHES = 5  # times that the centre of mass is put on its way and legs bent: each moves the other


def flights_of(stands: np.ndarray) -> list[tuple[int, int]]:
    """The last knot before and the first one after each flight that begins and ends on the ground; stands (N+1, K)."""
    up = np.flatnonzero(np.diff(np.concatenate([[0], (~stands.any(axis=1)).astype(int), [0]])))
    return [(int(a) - 1, int(b)) for a, b in up.reshape(-1, 2) if a > 0 and b < len(stands)]


def jumping(
    mechanism: Mechanism, q: np.ndarray, feet: list[Foot], places: np.ndarray, flights: list[tuple[int, int]],
    ranges: np.ndarray, dt: float, lifted: bool = False,
) -> np.ndarray | None:  # fmt: skip
    """Configurations (N+1, nq) of a motion with flights; None where it is lower than their parabolas, or legs lack.

    A machine crouches, pushes itself off the ground, flies and is caught. Where no foot stands for T seconds the centre
    of mass is on a parabola, c = g T^2 / 8 high, which it enters and leaves at v = g T / 2. Before, it goes down to a
    depth d below the height of the take-off and is pushed up as

        z = d s^3,    s = 0 ... 1 in 3 d / v seconds,

    which ends at v and accelerates by at most 2/3 v^2 / d, 2 g where legs bend so far: they carry three times the
    weight; else 4 or 8 g. A landing is the same backwards. Feet stay where they stand, and legs go from their pose at
    the take-off to that at the landing. A motion with one flight, and no foot that steps beside it, goes its way along
    the ground, and turns, in the same time: as s^3 while it is pushed, so that the force has one direction, and at one
    speed while it rises and while it falls. With the crouch by default 3/4 of the way are in the air. At the apex it is
    where the motion has it.

    Args:
        mechanism: The machine.
        q: (N+1, nq), where the motion has it, at the middle of each flight at the apex.
        feet: Its feet.
        places: (N+1, K, 3) m, of the feet's points.
        flights: See flights_of().
        ranges: (nv, 2) rad or m, of hinges and slides.
        dt: s.
        lifted: Whether a motion that is lower than a parabola is raised to one that begins where the machine stands.
    """
    if mechanism.reduction is not None or mechanism.has_closed_chains:
        return None
    n = feet[0].normal
    heights, g = center_of_mass(mechanism, q) @ n, abs(float(mechanism.gravity @ n))
    at, on_ground = mechanism.q_address[legs_of(mechanism, feet)], np.ones(len(q), dtype=bool)
    for a, b in flights:
        on_ground[a + 1 : b] = False
    stays = all(np.ptp(part, axis=0).max() <= STILL for a, b in flights for part in (places[: a + 1], places[b:]))
    for depth in DEPTHS:
        found = _heights(heights, flights, g, dt, depth, lifted)
        if found is None:
            return None
        wanted, pushes = found
        placed, errors = _at_speed(mechanism, q, flights[0], pushes) if stays and len(flights) == 1 else q, np.zeros(1)
        for _ in range(MATCHES):
            placed = shifted(mechanism, placed, np.outer(wanted - center_of_mass(mechanism, placed) @ n, n))
            placed[on_ground], errors = bent(mechanism, placed[on_ground], feet, places[on_ground], ranges)
            for a, b in flights:
                share = minimum_jerk(np.linspace(0.0, 1.0, b - a + 1))[0][:, None]
                placed[a : b + 1, at] = placed[a, at] + share * (placed[b, at] - placed[a, at])
        if errors.max() <= REACHED:
            return placed
    return None


def height_above_legs(
    mechanism: Mechanism, q: np.ndarray, start: np.ndarray, feet: list[Foot], ranges: np.ndarray, highest: float
) -> float:  # fmt: skip
    """By how much a pose q (nq,) is higher than where its legs reach the ground, m, at most `highest`; 0 where they do.

    The feet are beneath it as at the start (nq,).
    """
    n, places = feet[0].normal, points_of_feet(mechanism, start[None], feet)[0]
    ahead = center_of_mass(mechanism, start[None]) - center_of_mass(mechanism, q[None])
    beneath = shifted(mechanism, q[None], ahead - np.outer(ahead @ n, n))

    def stands(drop: float) -> bool:
        lower = shifted(mechanism, beneath, -drop * n[None])
        return bool(bent(mechanism, lower, feet, places, ranges)[1].max() <= REACHED)

    low, high = 0.0, highest
    if stands(low):
        return 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if stands(middle) else (middle, high)
    return high


def _at_speed(mechanism: Mechanism, q: np.ndarray, flight: tuple[int, int], pushes: list[int]) -> np.ndarray:
    """A motion (N+1, nq) at other times: pushed and caught in so many knots each, and at the apex when it was."""
    (a, b), (push, catch) = flight, pushes
    apex = (a + b) // 2
    falls = _paced(mechanism, q[apex:][::-1], catch, b - apex)[::-1]
    return np.concatenate([_paced(mechanism, q[: apex + 1], push, apex - a), falls[1:]])


def _paced(mechanism: Mechanism, q: np.ndarray, push: int, rise: int) -> np.ndarray:
    """A motion (n+1, nq) at other times: pushed for so many knots, and at one speed for so many to its end."""
    space, x = mechanism.space, np.zeros((len(q), mechanism.space.nx))
    x[:, : mechanism.nq] = q
    steps = space.difference(x[1:], x[:-1])[:, : mechanism.nv]
    path = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
    pushed = push / 3.0 * np.linspace(0.0, 1.0, push + 1)[:-1] ** 3
    share = np.concatenate([np.zeros(len(steps) - push - rise), pushed, push / 3.0 + np.arange(rise + 1)])
    at = np.interp(share / share[-1] * path[-1], path, np.arange(len(q)))
    k = np.minimum(at.astype(int), len(q) - 2)
    displacement = np.zeros((len(q), space.ndx))
    displacement[:, : mechanism.nv] = (at - k)[:, None] * steps[k]
    return space.integrate(x[k], displacement)[:, : mechanism.nq]


def _heights(
    z: np.ndarray, flights: list[tuple[int, int]], g: float, dt: float, depth: float, lifted: bool
) -> tuple[np.ndarray, list[int]] | None:  # fmt: skip
    """(N+1,) m, of the centre of mass with flights, from those of the motion z (N+1,), and knots of each push.

    It crouches `depth` of the height of a flight below its take-off. See jumping() for `lifted` and None.
    """
    found, stood, times = z.copy(), 0, list[int]()
    for k, (a, b) in enumerate(flights):
        T = (b - a) * dt
        c, v, t = g * T**2 / 8.0, g * T / 2.0, dt * np.arange(b - a + 1)
        end = (b + flights[k + 1][0]) // 2 if k + 1 < len(flights) else len(z) - 1
        low, stands = z[(a + b) // 2] - c, min(z[stood], z[end])
        if low < stands and not lifted:
            return None
        low = max(low, stands)
        found[a : b + 1] = low + v * t - 0.5 * g * t**2
        found[stood : a + 1], push = _push(z[stood], low, (depth * c, v), a - stood, dt)
        backwards, catch = _push(z[end], low, (depth * c, v), end - b, dt)
        found[b : end + 1] = backwards[::-1]
        stood, times = end, [*times, push, catch]
    return found, times


def _push(z: float, low: float, of: tuple[float, float], knots: int, dt: float) -> tuple[np.ndarray, int]:
    """(knots + 1,) m, heights from z at rest to `low`, from a depth `of` c, m, to a speed v, m/s; knots of the push."""
    most, v = of
    depth = max(min(most, LONGEST_PUSH * knots * dt * v / 3.0), low - z)
    pushes = min(max(round(3.0 * depth / v / dt), 1), knots)
    down = minimum_jerk(np.linspace(0.0, 1.0, knots - pushes + 1))[0] if knots > pushes else np.ones(1)
    rise = low - depth + depth * np.linspace(0.0, 1.0, pushes + 1) ** 3
    return np.concatenate([z + down * (rise[0] - z), rise[1:]]), pushes


# Of the height of the centre of mass, by which legs are shorter than at their longest at a take-off: more where they
# are not beneath the machine then.
BENT = (0.05, 0.1, 0.2)
GOAL_SCALE, FOOT_SCALE = 0.1, 1e-3  # m of residuals of 1: what the legs lack is left to the goal


def check_flight(task: Task, poses: Poses, dynamics: RigidBodyDynamics, ranges: np.ndarray) -> None:
    """Refuse goals in flight that no motion of a standing machine meets.

    Args:
        task: Goals.
        poses: Its poses, the start first.
        dynamics: The machine.
        ranges: (nv, 2) rad or m, of hinges and slides.

    Raises:
        PlannerError: A goal is higher than gravity lets the machine be at its time, or than its legs push it.
    """
    for one in _in_flight(task, poses, dynamics):
        # lowered by its clearance the pose stands: the legs lack less
        if _refusal(dynamics.mechanism, one.clearance, one.time, one.landing, ranges):
            c = min(one.clearance, missing_height(dynamics.mechanism, one.targets, poses.q[0], ranges))
            if refusal := _refusal(dynamics.mechanism, c, one.time, one.landing, ranges):
                raise PlannerError(f"{one.label} {refusal}")


def phases_of_jumps(
    task: Task, poses: Poses, dynamics: RigidBodyDynamics, ranges: np.ndarray, bent: float = BENT[0]
) -> list[dict[str, Any]]:  # fmt: skip
    """Tables [[phase]] of a machine that is to jump to goals in flight, each at the apex of a parabola; [] for none.

    It stands before and after. From the height c above what its legs reach it falls for sqrt(2 c / g), from `bent` of
    its own height more, since they are not quite straight then. Other arguments as in check_flight().
    """
    mechanism, found, end = dynamics.mechanism, list[dict[str, Any]](), 0.0
    goals = list(_in_flight(task, poses, dynamics))
    if not goals or mechanism.reduction is not None:
        return []
    standing = standing_feet(mechanism, poses.q[0])
    feet, bend = [foot.name for foot in standing], bent * height_of(mechanism, poses.q[0], standing)
    for one in goals:
        c = height_above_legs(mechanism, one.q, poses.q[0], standing, ranges, one.clearance)
        if c <= 0.0:
            continue
        half = math.sqrt(2.0 * (c + bend) / float(np.linalg.norm(mechanism.gravity)))
        if one.time - half <= end or one.time + half >= min(one.landing, task.duration):
            return []
        end = one.time + half
        found += [{"until": one.time - half, "stand": feet}, {"until": end, "stand": []}]
    return [*found, {"stand": feet}] if found else []


class _InFlight(NamedTuple):
    """A goal in the air of a machine that stands at the start."""

    label: str
    targets: Sequence[Target]
    q: np.ndarray  # (nq,) its pose
    clearance: float  # m, between the ground and the pose of the goal
    time: float  # s
    landing: float  # s, of the next pose that stands; infinite without one


def _in_flight(task: Task, poses: Poses, dynamics: RigidBodyDynamics) -> Iterator[_InFlight]:
    """The goals of places in the air, none of machines that thrusters push."""
    mechanism = dynamics.mechanism
    if not np.any(mechanism.gravity) or not stands_on_ground(mechanism) or mechanism.has_closed_chains:
        return
    if np.any(thrusters(mechanism)) or not contact_forces(mechanism, poses.q[0], np.zeros(mechanism.nv)).forces.any():
        return
    gaps = [clearance(mechanism, q) for q in poses.q]  # it reads the positions alone
    for k in np.flatnonzero(np.array(gaps) > STRIDE):
        stage = int(poses.stages[k])
        here = [one for one in task.goals if one.stage == stage]
        targets = stage_targets(task, stage, here).targets
        if any(target.position is not None for target in targets):
            lands = (int(s) for s, gap in zip(poses.stages[k:], gaps[k:], strict=True) if gap <= STRIDE)
            times = stage * dynamics.dt, next(lands, math.inf) * dynamics.dt
            yield _InFlight(here[0].label, targets, poses.q[k], gaps[k], *times)


def _refusal(mechanism: Mechanism, c: float, t: float, T: float, ranges: np.ndarray) -> str:
    """Why nothing is a height c, m, above what stands at t, and stands again at T, s; "" where it may be."""
    g = float(np.linalg.norm(mechanism.gravity))
    allowed = 0.5 * g * t * (T - t)
    if c > allowed:
        return (
            f"is {c:.3g} m higher than the machine reaches from the ground, and gravity allows {allowed:.3g} m at "
            f"{t:.3g} s of what stands again at {T:.3g} s: expected a lower goal, or to stand again after "
            f"{math.sqrt(8.0 * c / g):.2g} s or more with the goal half-way."
        )
    if c <= 0.0:
        return ""
    rising = min(t, math.sqrt(2.0 * c / g))
    needed = c / rising + 0.5 * g * rising
    reached = _takeoff_speed(mechanism, ranges)
    if reached >= needed:
        return ""
    return (
        f"is a jump for which the machine leaves the ground at {needed:.3g} m/s, and the work of its actuators over "
        f"the whole ranges of their joints gives {reached:.3g} m/s at most: expected a lower goal, of at most "
        f"{0.5 * reached**2 / g:.2g} m above what it reaches from the ground, or stronger actuators."
    )


def check_flight_time(mechanism: Mechanism, label: str, seconds: float, ranges: np.ndarray) -> None:
    """Refuse a flight of `seconds` that the legs cannot push: v = g T / 2, where it lands as high as it leaves.

    Args:
        mechanism: The machine.
        label: Of the flight, for the message.
        seconds: T, without a foot on the ground.
        ranges: (nv, 2) rad or m, of hinges and slides.

    Raises:
        PlannerError: See above.
    """
    g = float(np.linalg.norm(mechanism.gravity))
    needed, reached = 0.5 * g * seconds, _takeoff_speed(mechanism, ranges)
    if needed > reached:
        raise PlannerError(
            f"{label} has no foot on the ground for {seconds:.3g} s, for which the machine leaves it at {needed:.3g} "
            f"m/s, and the work of its actuators over the whole ranges of their joints gives {reached:.3g} m/s at "
            f"most: expected a foot that stands, or at most {2.0 * reached / g:.2g} s."
        )


def _takeoff_speed(mechanism: Mechanism, ranges: np.ndarray) -> float:
    """m/s, at most, by the actuators' work over ranges (nv, 2); inf with thrusters, or springs that may have more."""
    if np.any(mechanism.stiffness) or np.any(mechanism.ball_stiffness) or np.any(thrusters(mechanism)):
        return math.inf
    force, stroke = strongest(mechanism), np.diff(ranges, axis=1)[:, 0]
    pushing = mechanism.directly_actuated & (force > 0.0)
    return math.sqrt(2.0 * float(force[pushing] @ stroke[pushing]) / float(mechanism.mass.sum()))


def missing_height(mechanism: Mechanism, targets: Sequence[Target], q: np.ndarray, ranges: np.ndarray) -> float:
    """What legs lack to targets, m, with the best one of the feet that stand at q (nq,) on the ground."""
    depths = contact_forces(mechanism, q, np.zeros(mechanism.nv)).depths
    lowest = {mechanism.contacts[k].link: int(k) for k in np.argsort(depths) if depths[k] > 0.0}
    return min(_missing_with(mechanism, targets, q, k, ranges) for k in lowest.values())


def _missing_with(
    mechanism: Mechanism, targets: Sequence[Target], q: np.ndarray, which: int, ranges: np.ndarray
) -> float:  # fmt: skip
    """Distance of the targets from the nearest pose with a contact as high as at q (nq,), m."""
    contact = mechanism.contacts[which]
    foot, n = Frame.at(contact.link, contact.centre), np.array(contact.plane.normal)
    level = float(n @ frame_pose(mechanism, q, foot)[:3, 3])
    scaled = [one._replace(metre_scale=GOAL_SCALE) for one in targets]

    def on_ground(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away = n @ frame_pose(mechanism, at, foot)[:3, 3] - level
        return np.array([away / FOOT_SCALE]), (n @ jacobian(mechanism, at, foot)[:3])[None] / FOOT_SCALE

    reached = ~unreached_dofs(mechanism)
    found = inverse_kinematics(mechanism, scaled, q, ranges=ranges, free=reached, starts=1, missing=on_ground).q
    away = [
        float(np.linalg.norm(frame_pose(mechanism, found, one.frame)[:3, 3] - one.position))
        for one in targets if one.position is not None
    ]  # fmt: skip
    return max(away)
