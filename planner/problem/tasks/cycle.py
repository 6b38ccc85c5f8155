"""Cycle: a gait that goes on, one cycle of which ends as it began, further along the ground, or half of one, mirrored.

The end of a cycle is the image of its start: the machine `travel` further in the axes of its base, turned about the
vertical by `turn`; with `mirror` its two sides have changed places, so that the second half of the gait is the first
one, mirrored (planner.solvers.periodic finds the start).

The reference is the middle of WHOLE cycles of a motion at one speed from rest to rest: by then the centre of mass, a
pendulum above the feet that stand, has forgotten the ends.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.kinematics import LinkPlaces
from planner.model.mechanism import Mechanism
from planner.model.space import StateMap, StateSpace, exp_quaternion, product
from planner.problem.costs.residual_functions import rotation_of
from planner.problem.stances import Stance, stances_of_swings
from planner.problem.tasks.flight import check_flight_time
from planner.problem.tasks.gait import Gait, centres_of, feet_of, height_of, stands_at
from planner.problem.tasks.legs import Foot, Phase, longest_step, over_support, points_of_feet, stepping, with_legs
from planner.problem.tasks.mirror import Mirror, base_dofs, compared_sides, mirror_of, quaternion_of_base

WHOLE = 5  # cycles of the motion of which the middle one is the reference
PASSES = 20  # solves: a trot takes 3 to 6, a bound whose reference falls 12
FARTHEST = 1e3  # m, of a cycle
AXES = "m along the ground, ahead (the base's x axis) and to the left"


@dataclass(frozen=True)
class Cycle:
    """What a cycle of a gait is to do, or half of one with `mirror`.

    Attributes:
        travel: m along the ground, in the base's axes at the start: ahead, and to the left.
        turn: rad, about the vertical.
        mirror: Whether the machine's sides have changed places at the end.
        cycles: How many of them a plan has, one after another.
        left_open: Names of coordinates that need not return: there `travel` is a reference on the way alone.
        passes: Solves, at most, until they have found where the cycle begins.
    """

    travel: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0
    mirror: bool = False
    cycles: int = 1
    left_open: tuple[str, ...] = ()
    passes: int = PASSES


class CycleMotion(NamedTuple):
    """A cycle of a gait."""

    states: np.ndarray  # (N+1, nx) reference
    image: StateMap  # From the start of the cycle to its end
    said: str  # A sentence
    stances: tuple[Stance, ...]  # From the start of the cycle on

    def repeated(self, space: StateSpace, cycles: int) -> CycleMotion:
        """So many cycles, one after another; each is the image of the one before."""
        states, last = [self.states[:-1]], self.states[-1:]
        for _ in range(cycles - 1):
            states.append(self.image.apply(space, states[-1]))
            last = self.image.apply(space, last)
        return CycleMotion(np.concatenate([*states, last]), self.image.power(space, cycles), self.said, self.stances)


class _Ground(NamedTuple):
    """Directions (3,) along the ground: ahead of the base, to its left, and up; m of a cycle."""

    ahead: np.ndarray
    left: np.ndarray
    up: np.ndarray

    def displacement(self, cycle: Cycle, share: float) -> np.ndarray:
        """(3,) m, after a share of a cycle, along an arc where it turns."""
        turn = share * cycle.turn
        chord = share * np.sinc(0.5 * turn / np.pi)  # at half of the angle
        ahead = np.cos(0.5 * turn) * self.ahead + np.sin(0.5 * turn) * self.left
        left = np.cos(0.5 * turn) * self.left - np.sin(0.5 * turn) * self.ahead
        return chord * (cycle.travel[0] * ahead + cycle.travel[1] * left)


def cycle_of(value: Any) -> Cycle:
    """A Cycle from a table of its attributes; travel may be a number, ahead.

    Raises:
        PlannerError: Another type, an unknown key, or a number out of range.
    """
    keys = ("travel", "turn", "mirror", "cycles", "left_open", "passes")
    if not isinstance(value, Mapping):
        raise PlannerError(f"periodic is {short_repr(value)}, expected a table of some of: {', '.join(keys)}.")
    given = {choice("a key of periodic", key, keys): part for key, part in value.items()}
    travel = given.get("travel", 0.0)
    if isinstance(travel, (list, tuple)):
        ahead, left = array(f"travel of periodic, {AXES}", travel, (2,)).tolist()
    else:
        ahead, left = number("travel of periodic", travel), 0.0
    if max(abs(ahead), abs(left)) > FARTHEST:
        raise PlannerError(f"travel of periodic is {short_repr(travel)}, expected at most {FARTHEST:g} m.")
    turn = number("turn of periodic", given.get("turn", 0.0), minimum=-2.0 * math.pi, maximum=2.0 * math.pi)
    mirror = given.get("mirror", False)
    if not isinstance(mirror, bool):
        raise PlannerError(f"mirror of periodic is {short_repr(mirror)}, expected true or false.")
    if mirror and turn:
        raise PlannerError("periodic has mirror and a turn, whose image turns the other way: expected one of them.")
    left_open = given.get("left_open", ())
    if not isinstance(left_open, (list, tuple)) or not all(isinstance(name, str) for name in left_open):
        raise PlannerError(f"left_open of periodic is {short_repr(left_open)}, expected a list of coordinates' names.")
    cycles = count("cycles of periodic", given.get("cycles", 1))
    if left_open and cycles > 1:
        raise PlannerError("periodic has left_open and cycles, which begin where one has ended: expected one of them.")
    passes = count("passes of periodic", given.get("passes", PASSES))
    return Cycle((ahead, left), turn, mirror, cycles, tuple(left_open), passes)


def cycle_motion(
    gait: Gait, cycle: Cycle, dynamics: RigidBodyDynamics, x0: np.ndarray, N: int, ranges: np.ndarray
) -> CycleMotion:
    """The reference of a cycle, or half of one, in N stages.

    Args:
        gait: Which feet swing when; its turns are shares of a whole cycle, its phases parts of the N stages.
        cycle: What it is to do.
        dynamics: The machine.
        x0: (nx,) a state in which it stands.
        N: Stages.
        ranges: (nv, 2) rad or m, of hinges and slides.

    Raises:
        PlannerError: The machine stands on no foot, has other feet or no base, cannot turn, its legs do not reach
            their footholds, or it has, or the gait has, no mirror image.
    """
    m, space, dt = dynamics.mechanism, dynamics.space, dynamics.dt
    standing = feet_of(m, x0)
    ground = _ground(m, x0, standing[0].normal)
    across = ground.left if cycle.travel == (0.0, 0.0) else np.cross(ground.up, ground.displacement(cycle, 1.0))
    mirror = mirror_of(m, x0, across / np.linalg.norm(across)) if cycle.mirror else None
    halves = 2 if cycle.mirror else 1
    shares = np.arange(-(WHOLE // 2) * halves * N, (WHOLE // 2 + 1) * halves * N + 1) / N
    rows = np.stack([_displaced(m, x0, ground, cycle, share) for share in shares])
    dragged = points_of_feet(m, rows[:, : m.nq], standing)[0]
    feet, h = centres_of(standing, dragged), height_of(m, x0, standing)
    lift, t, T = gait.lift_of(h), dt * np.arange(len(rows)), dt * halves * N
    if gait.stride is not None:
        raise PlannerError("gait has stride and there is periodic, whose travel is that of a cycle: expected one.")
    swings = _swings(gait, standing, feet, T, mirror)
    of_foot = np.repeat(np.arange(len(standing)), [len(foot.points) for foot in standing])
    normals, of_points = np.array([foot.normal for foot in standing])[of_foot], [swings[k] for k in of_foot]
    places = stepping(dragged, t, normals, of_points, lift, dt)
    stands = stands_at(t, of_points)
    _check_flights(m, t, stands, ranges)
    middle = (WHOLE // 2) * halves * N
    part = slice(middle - 1, middle + N + 2)  # and a knot on either side, of which velocities are differences
    q = over_support(m, rows[:, : m.nq], places, stands, normals[0], dt)[part]
    q = with_legs(m, q, standing, places[part], ranges, ends=False)
    xs = np.tile(x0, (N + 3, 1))
    xs[:, : m.nq] = q
    xs[1:-1, m.velocities] = space.difference(xs[2:], xs[:-2])[:, : m.nv] / (2.0 * dt)
    xs = xs[1:-1]
    duty = stands[part][1:-2].mean()
    said = (
        f"Gait: {'half a cycle, mirrored,' if cycle.mirror else 'a cycle'} of {dt * N:.3g} s that goes on, feet "
        f"standing for {duty:.2g} of the time, steps of up to {longest_step(places[middle:]):.2g} m, feet lifted by "
        f"{lift:.2g} m."
    )
    image = _displacement(m, dynamics, x0, ground, cycle)
    if mirror is not None:
        image = mirror.image.then(space, image)
        said += compared_sides(dynamics, mirror, x0, ground.up)
    begin = dt * middle
    stances = stances_of_swings(
        [foot.name for foot in standing], [[(a - begin, b - begin) for a, b in own] for own in swings]
    )
    return CycleMotion(xs, image, said, stances)


def _ground(mechanism: Mechanism, x: np.ndarray, up: np.ndarray) -> _Ground:
    """Ahead of the base, to its left and up, at a state (nx,)."""
    base = base_dofs(mechanism)
    ahead = LinkPlaces(mechanism, x[None, : mechanism.nq]).T[0, base - 1, :3, 0] if base else np.array([1.0, 0.0, 0.0])
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 1e-3:
        raise PlannerError("the base's x axis points up at the start, expected it along the ground with periodic.")
    ahead /= np.linalg.norm(ahead)
    return _Ground(ahead, np.cross(up, ahead), up)


def _displaced(mechanism: Mechanism, x: np.ndarray, ground: _Ground, cycle: Cycle, share: float) -> np.ndarray:
    """A state (nx,) after a share of a cycle, as it is but for where it is."""
    x, at, move = x.copy(), quaternion_of_base(mechanism), ground.displacement(cycle, share)
    if at is not None:
        x[at - 3 : at] += move
        x[at : at + 4] = product(exp_quaternion(share * cycle.turn * ground.up), x[at : at + 4])
        return x
    base = base_dofs(mechanism)
    slides = [i for i in range(base) if not mechanism.kind[i] and not np.any(mechanism.S[i, :3])]
    axes = np.array([mechanism.S[i, 3:] for i in slides]).reshape(-1, 3).T
    found = np.linalg.lstsq(axes, move, rcond=None)[0] if slides else np.zeros(0)
    if cycle.turn or np.linalg.norm(axes @ found - move) > 1e-9:
        raise PlannerError(
            "periodic has a travel or a turn that the machine's base cannot make: expected a free joint at its root, "
            "or travel along the slides there."
        )
    x[mechanism.q_address[slides]] += found
    return x


def _displacement(
    mechanism: Mechanism, dynamics: RigidBodyDynamics, x0: np.ndarray, ground: _Ground, cycle: Cycle
) -> StateMap:
    """The displacement of a cycle, as a map of states."""
    origin = mechanism.at_rest(x0)
    matrix = np.eye(dynamics.ndx)
    if quaternion_of_base(mechanism) is not None:
        for offset in (0, mechanism.nv):
            matrix[offset : offset + 3, offset : offset + 3] = rotation_of(exp_quaternion(cycle.turn * ground.up))
    return StateMap(origin, _displaced(mechanism, origin, ground, cycle, 1.0), matrix)


def _swings(
    gait: Gait, standing: list[Foot], feet: np.ndarray, T: float, mirror: Mirror | None
) -> list[list[tuple[float, float]]]:
    """Begin and end of each foot's swings, s, in WHOLE cycles of T seconds."""
    names, links = [foot.name for foot in standing], [foot.link for foot in standing]
    other = list(range(len(links))) if mirror is None else [links.index(int(mirror.links[link])) for link in links]
    if gait.phases:
        part = T / (1 if mirror is None else 2)
        gait.swings_of_phases(standing, part)  # refuses what is wrong in those of one cycle
        ends = [*(phase.until for phase in gait.phases[:-1]), part]
        swapped = {name: names[k] for name, k in zip(names, other, strict=True)}
        phases = []
        for k in range(round(WHOLE * T / part)):
            for end, phase in zip(ends, gait.phases, strict=True):
                stand = tuple(swapped.get(one, one) for one in phase.stand) if k % 2 else phase.stand
                phases.append(Phase(k * part + end, stand))
        return replace(gait, phases=tuple(phases)).swings_of_phases(standing, WHOLE * T)[0]
    turns = gait.turns(standing, feet)
    _, duty, lead = gait.times_of(turns)
    if mirror is not None and not np.allclose((turns[other] - turns) % 1.0, 0.5):
        raise PlannerError(
            "mirror is true, and a foot and its mirror image do not swing half a cycle apart in this gait: expected "
            "no mirror and a whole cycle."
        )
    begins = T * (np.arange(-1, WHOLE + 1)[:, None] + lead + turns)  # (cycles, feet) s
    return [[(float(t), float(t + (1.0 - duty) * T)) for t in column if t > 0.0] for column in begins.T]


def _check_flights(mechanism: Mechanism, t: np.ndarray, stands: np.ndarray, ranges: np.ndarray) -> None:
    """Refuse a flight that the machine cannot make."""
    edges = np.flatnonzero(np.diff(np.r_[0, ~stands.any(axis=1), 0].astype(int)))
    for begin, end in edges.reshape(-1, 2).tolist():
        check_flight_time(mechanism, "the gait", float(t[min(end, len(t) - 1)] - t[begin]), ranges)
