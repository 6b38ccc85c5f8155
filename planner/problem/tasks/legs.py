"""Legs: where feet stand and swing along a motion, and the phases of a problem file that say which stand until when.

Feet that stand stay, those that swing move along a smooth curve to their next place. The base is shifted such
that those that stand carry the machine, and lowered where legs are too short; inverse kinematics bends the legs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, choice, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import center_of_mass, center_of_mass_jacobian, points_of
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.mechanism import Mechanism
from planner.problem.initial_guess import minimum_jerk

NEWTON = 50  # iterations of the legs' inverse kinematics
LONGEST_STEP = 0.3  # rad or m: beyond it a leg that is nearly stretched turns over
REACHED = 5e-3  # m: of a foot from its place; a sole that turns on its way is bent by less
JERK_WEIGHT = 1e-6  # s^6, of the centre of mass beside the zero-moment point (Kajita et al. 2003)
LOWERINGS = 5  # of the base, each by what the legs then lack: of a leg that is nearly upright one or two suffice
DAMPING = 1e-3  # m: of a singular leg, which is stretched
RANGE_MARGIN = 1e-6  # rad or m: by which the search for a leg begins within its ranges
STILL = 1e-6  # m or rad and their rates: by which a motion at rest changes by rounding alone


class Foot(NamedTuple):
    """A body that stands on the ground at the start."""

    name: str
    link: int
    points: np.ndarray  # (K, 3) m, its loaded contacts in the link's frame: of a sole its corners
    normal: np.ndarray  # (3,) of the ground


def standing_feet(mechanism: Mechanism, x: np.ndarray) -> list[Foot]:
    """The bodies that bear load at a state (nx,)."""
    forces = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).forces
    loaded = [one for one, force in zip(mechanism.contacts, forces, strict=True) if force.any()]
    feet = []
    for link in dict.fromkeys(one.link for one in loaded):
        own = [one for one in loaded if one.link == link]
        points, normal = np.array([one.centre for one in own]), np.array(own[0].plane.normal)
        feet.append(Foot(mechanism.body_of(link), link, points, normal))
    return feet


def points_of_feet(mechanism: Mechanism, q: np.ndarray, feet: list[Foot]) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, K, 3) m of the feet's points at configurations q (N, nq), and Jacobians (N, K, 3, nv)."""
    links = np.repeat([foot.link for foot in feet], [len(foot.points) for foot in feet])
    return points_of(mechanism, q, links, np.vstack([foot.points for foot in feet]))


def centres_of(standing: list[Foot], points: np.ndarray) -> np.ndarray:
    """(N, F, 3) m, the middles of feet, of places (N, K, 3) of their points."""
    firsts = np.cumsum([0, *(len(foot.points) for foot in standing[:-1])])
    return np.stack([part.mean(axis=1) for part in np.split(points, firsts[1:], axis=1)], axis=1)


def height_of(mechanism: Mechanism, x: np.ndarray, standing: list[Foot]) -> float:
    """m, of the centre of mass above the feet at a state (nx,)."""
    q = x[: mechanism.nq]
    feet = centres_of(standing, points_of_feet(mechanism, q[None], standing)[0])[0]
    return float(standing[0].normal @ (center_of_mass(mechanism, q) - feet.mean(axis=0)))


def last_change(rows: np.ndarray) -> int:
    """The knot at which a motion (N+1, ...) comes to rest; all of it where it does not move."""
    changes = np.flatnonzero(np.abs(np.diff(rows, axis=0)).reshape(len(rows) - 1, -1).max(axis=1) > STILL)
    return int(changes[-1]) + 1 if len(changes) else len(rows) - 1


def evenly_paced(
    dragged: np.ndarray, normals: np.ndarray, swings: list[list[tuple[float, float]]], dt: float
) -> np.ndarray:
    """(N+1,) s, when feet that are dragged are where those that step in even strides have the machine at each knot.

    The machine goes at one speed from when the first foot leaves the ground until the last one lands.

    Args:
        dragged: (N+1, F, 3) m.
        normals: (F, 3) of the ground.
        swings: Of each foot, s, when swings begin and end; inf for one that ends in the air.
        dt: s.
    """
    t, moves = dt * np.arange(len(dragged)), np.diff(dragged, axis=0)
    level = moves - np.einsum("nfa,fa,fb->nfb", moves, normals, normals)
    traveled = np.append(0.0, np.cumsum(np.linalg.norm(level, axis=2).mean(axis=1)))
    times = [swing for foot in swings for swing in foot]
    if traveled[-1] < STILL or not times:
        return t
    first, last = min(begin for begin, _ in times), min(max(end for _, end in times), t[-1])
    if last <= first:
        return t
    return np.interp(traveled[-1] * np.clip((t - first) / (last - first), 0.0, 1.0), traveled, t)


def stepping(
    dragged: np.ndarray, when: np.ndarray, normals: np.ndarray, swings: list[list[tuple[float, float]]], lift: float,
    dt: float,
) -> np.ndarray:  # fmt: skip
    """(N+1, F, 3) m, feet that stand and swing along where they are dragged.

    Args:
        dragged: (N+1, F, 3) m.
        when: (N+1,) s, the time of the dragged motion at each knot.
        normals: (F, 3) of the ground, along which feet stay as high as at the start.
        swings: Of each foot, s, when swings begin and end; inf for one that ends in the air, where it waits from when
            it is no longer dragged.
        lift: m.
        dt: s.
    """
    t, rest = dt * np.arange(len(dragged)), dt * last_change(dragged)
    places = np.tile(dragged[0], (len(t), 1, 1))
    for k, n in enumerate(normals):
        level = dragged[:, k] - np.outer((dragged[:, k] - dragged[0, k]) @ n, n)
        here = level[0]
        following = [*(begin for begin, _ in swings[k]), np.inf][1:]
        for (begin, end), then in zip(swings[k], following, strict=True):
            middle = np.interp(min(0.5 * (end + then), t[-1]), t, when)
            there = np.array([np.interp(middle, t, level[:, axis]) for axis in range(3)])
            lands = end < math.inf
            if not lands:
                there, end = dragged[-1, k], rest if rest > begin else t[-1]
            after = t > begin
            s = np.minimum((t[after] - begin) / (min(end, t[-1]) - begin), 1.0)
            places[after, k] = here + minimum_jerk(s)[0][:, None] * (there - here)
            if lands:
                places[after, k] += lift * 64.0 * ((s * (1.0 - s)) ** 3)[:, None] * n
            here = there
    return places


def over_support(
    mechanism: Mechanism, q: np.ndarray, places: np.ndarray, stands: np.ndarray, n: np.ndarray, dt: float
) -> np.ndarray:  # fmt: skip
    """Configurations whose base is shifted along the ground such that the standing feet carry the machine.

    Where some feet swing the zero-moment point is in the middle of the others; before, between and after it changes
    smoothly, as far as a pendulum that begins and ends at rest lets it. Where all swing at once nothing carries it.

    Args:
        mechanism: The machine.
        q: (N+1, nq), where the motion has it.
        places: (N+1, K, 3) m, of the feet's points.
        stands: (N+1, K) bool.
        n: (3,) the normal of the ground.
        dt: s.
    """
    some, g = np.asarray(stands.any(axis=1) & ~stands.all(axis=1)), mechanism.gravity
    if not some.any() or not g @ n:
        return q
    weights = stands[some] / stands[some].sum(axis=1, keepdims=True)
    centre = center_of_mass(mechanism, q)
    shift = np.zeros((len(q), 3))
    shift[some] = np.einsum("nk,nka->na", weights, places[some]) - centre[some]
    shift -= np.outer(shift @ n / (g @ n), g)  # along the ground, to what is above the point
    for a, b in pairwise(sorted({0, len(q) - 1, *np.flatnonzero(some).tolist()})):
        share = minimum_jerk(np.linspace(0.0, 1.0, b - a + 1))[0][1:-1, None]
        shift[a + 1 : b] = shift[a] + share * (shift[b] - shift[a])
    h = float(np.mean((centre[:, None] - places) @ n))
    shift = _pendulum(centre + shift, h / abs(float(g @ n)), dt) - centre
    return shifted(mechanism, q, shift - np.outer(shift @ n, n))


def _pendulum(p: np.ndarray, stiff: float, dt: float) -> np.ndarray:
    """The centre of mass c (N+1, 3) m of a linear inverted pendulum, at rest at both ends, for zero-moment points p.

    It has the least sum of (c - h/g d2c/dt2 - p)^2 + JERK_WEIGHT (d3c/dt3)^2 (Kajita et al., "Biped walking pattern
    generation by using preview control of zero-moment point", 2003), over all of the motion instead of a preview.

    Args:
        p: (N+1, 3) m.
        stiff: h / g, s^2.
        dt: s.
    """
    from scipy import sparse  # only where feet swing
    from scipy.sparse.linalg import spsolve

    N = len(p) - 1
    if N < 6:  # two knots at each end are given
        return p
    first, second, third = (sparse.eye_array(n, n + 1, k=1) - sparse.eye_array(n, n + 1) for n in (N, N - 1, N - 2))
    second = second @ first / dt**2
    third = third @ second / dt
    moment = sparse.eye_array(N - 1, N + 1, k=1) - stiff * second
    rows = sparse.vstack([moment, math.sqrt(JERK_WEIGHT) * third]).tocsc()
    c = p.copy()
    c[1], c[-2] = c[0], c[-1]
    ends, inner = [0, 1, N - 1, N], rows[:, 2:-2]
    wanted = np.vstack([p[1:-1], np.zeros((N - 2, 3))]) - rows[:, ends] @ c[ends]
    c[2:-2] = spsolve((inner.T @ inner).tocsc(), inner.T @ wanted)
    return c


def shifted(mechanism: Mechanism, q: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Configurations (N+1, nq) whose base is shifted by (N+1, 3) m; as they are where it is fixed."""
    whole = center_of_mass_jacobian(mechanism, q[0])  # of slides that move all of the machine it is their axis
    base = np.flatnonzero((np.abs(np.linalg.norm(whole, axis=0) - 1.0) < 1e-9) & ~mechanism.directly_actuated)
    q = q.copy()
    q[:, mechanism.q_address[base]] += shift @ np.linalg.pinv(whole[:, base]).T
    return q


def longest_step(places: np.ndarray) -> float:
    """m, of the longest step: feet stand between steps."""
    displacements = np.linalg.norm(np.diff(places, axis=0), axis=2)
    steps = [part.sum() for row in displacements.T for part in np.split(row, np.flatnonzero(row == 0.0))]
    return float(max(steps, default=0.0))


def with_legs(
    mechanism: Mechanism, q: np.ndarray, feet: list[Foot], places: np.ndarray, ranges: np.ndarray, ends: bool = True
) -> np.ndarray:  # fmt: skip
    """Configurations (N+1, nq) with the feet's points at places (N+1, K, 3), m, by Newton steps of the legs from q.

    Where legs are too short on the way, the base is lowered: smoothly from the start and back to the end, which stay
    as they are if `ends`, else everywhere.

    Raises:
        PlannerError: Legs with closed chains or couplings, or that reach their places from no lower base either.
    """
    if mechanism.reduction is not None or mechanism.has_closed_chains:
        raise PlannerError("gait is for legs without closed chains and coupled joints, expected a [[goal]] without it.")
    found, missing = bent(mechanism, q, feet, places, ranges)
    left = missing
    if missing.max() > REACHED and (not ends or missing[[0, -1]].max() <= REACHED):
        share, drop = np.ones(len(q)), 0.0
        if ends:
            first, last = np.flatnonzero(missing.max(axis=1) > REACHED)[[0, -1]].tolist()
            share[:first] = minimum_jerk(np.linspace(0.0, 1.0, first + 1))[0][:-1]
            share[last + 1 :] = minimum_jerk(np.linspace(1.0, 0.0, len(q) - last))[0][1:]
        for _ in range(LOWERINGS):
            drop += left.max()
            lower = shifted(mechanism, q, -drop * np.outer(share, feet[0].normal))
            found, errors = bent(mechanism, lower, feet, places, ranges)
            if errors.max() >= left.max():
                break
            left = errors
            if left.max() <= REACHED:
                return found
    if left.max() > REACHED:
        names, worst = [foot.name for foot in feet for _ in foot.points], int(left.max(axis=0).argmax())
        raise PlannerError(
            f"the gait takes {names[worst]} {left.max():.2g} m further than its leg reaches within its ranges: "
            "expected a smaller stride, travel or lift, a lower trunk at both ends, or a longer duration."
        )
    return found


def legs_of(mechanism: Mechanism, feet: list[Foot]) -> np.ndarray:
    """Degrees of freedom of the actuated joints that carry some feet."""
    legs = np.zeros(mechanism.nv, dtype=bool)
    for foot in feet:
        legs[chain_of(mechanism.parent, foot.link)] = True
    return np.flatnonzero(legs & mechanism.directly_actuated)


def bent(
    mechanism: Mechanism, q: np.ndarray, feet: list[Foot], places: np.ndarray, ranges: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Configurations with the feet's points as close to their places as legs take them, and (N+1, K) m, how close."""
    own = legs_of(mechanism, feet)
    at, rows, q = mechanism.q_address[own], 3 * places.shape[1], q.copy()
    for _ in range(NEWTON):
        here, J = points_of_feet(mechanism, q, feet)
        away = (places - here).reshape(len(q), rows)
        if np.abs(away).max() < 0.002 * REACHED:
            break
        J = J.reshape(len(q), rows, mechanism.nv)[:, :, own]
        damped = J @ np.swapaxes(J, 1, 2) + DAMPING**2 * np.eye(rows)
        step = (np.swapaxes(J, 1, 2) @ np.linalg.solve(damped, away[:, :, None]))[:, :, 0]
        q[:, at] = np.clip(q[:, at] + np.clip(step, -LONGEST_STEP, LONGEST_STEP), *ranges[own].T)
    errors = np.linalg.norm(places - points_of_feet(mechanism, q, feet)[0], axis=2)
    for k in np.flatnonzero(
        errors.max(axis=1) > REACHED
    ).tolist():  # a leg nearly stretched: again, from the knot before

        def error(y: np.ndarray, k: int = k) -> tuple[np.ndarray, np.ndarray]:
            q[k, at] = y
            here, J = points_of_feet(mechanism, q[k : k + 1], feet)
            return (here[0] - places[k]).ravel(), J.reshape(-1, mechanism.nv)[:, own]

        from scipy.optimize import least_squares  # 0.4 s that `planner run` need not pay

        low, high = ranges[own].T
        begin = np.clip(q[max(k - 1, 0), at], low + RANGE_MARGIN, high - RANGE_MARGIN)
        found = least_squares(lambda y: error(y)[0], begin, lambda y: error(y)[1], bounds=(low, high))  # pyright: ignore
        errors[k] = np.linalg.norm(error(found.x)[0].reshape(-1, 3), axis=1)
    return q, errors


class Phase(NamedTuple):
    """A part of a motion, and who stands in it."""

    until: float  # s
    stand: tuple[str, ...]  # names of bodies or geoms; the other feet swing


def phase_of(table: Any, k: int, of: int) -> Phase:
    """Phase k of a list, from its table."""
    where = f"[[phase]] {k}"
    if not isinstance(table, Mapping):
        raise PlannerError(f"{where} is {short_repr(table)}, expected a table of until and stand.")
    for key in table:
        choice(f"a key of {where}", key, ("until", "stand"))
    stand = table.get("stand")
    if not isinstance(stand, (list, tuple)) or not all(isinstance(name, str) for name in stand):
        raise PlannerError(f"stand of {where} is {short_repr(stand)}, expected names of bodies or geoms, [] for none.")
    if "until" not in table and k < of:
        raise PlannerError(f"{where} has no `until`, expected the time of its end, s; only the last needs none.")
    until = number(f"until of {where}", table["until"], greater_than=0.0) if "until" in table else math.inf
    return Phase(until, tuple(stand))


def free_times(phases: Any, duration: float) -> tuple[Any, dict[int, tuple[float, float]]]:
    """Tables of phases with the middle of each range of times, and the ranges, s, by the numbers of phases, from 0.

    Raises:
        PlannerError: A range that is none, or that reaches the time of another one or the duration, s.
    """
    if not isinstance(phases, list) or not all(isinstance(table, Mapping) for table in phases):
        return phases, {}  # gait_of says what is expected
    found, fixed, before = {}, [], 0.0
    for k, table in enumerate(phases):
        until = table.get("until")
        ends = [until, until]
        if isinstance(until, (list, tuple)):
            said = f"until of [[phase]] {k + 1}, the earliest and the latest time, s"
            ends = array(said, until, (2,)).tolist()
            table, found[k] = {**table, "until": 0.5 * (ends[0] + ends[1])}, (ends[0], ends[1])
        fixed.append(table)
        if not all(isinstance(end, (int, float)) for end in ends):
            continue  # gait_of says what is expected
        if k in found and not before < ends[0] < ends[1] < duration:
            raise PlannerError(
                f"until of [[phase]] {k + 1} is {short_repr(until)}, expected the earliest and the latest time of its "
                f"end, s, after the phase before and before the duration, {duration:g} s."
            )
        if found and k not in found and not ends[0] > before:
            raise PlannerError(
                f"until of [[phase]] {k + 1} is {short_repr(until)}, expected a time after {before:g} s, the latest "
                "end of the phase before."
            )
        before = ends[1]
    return fixed, found
