"""Jumps: how a machine crouches, pushes itself off the ground, flies and is caught, as a reference.

Where no foot stands for T seconds the centre of mass is on a parabola, c = g T^2 / 8 high, which it enters and leaves
at v = g T / 2. Before, it goes down to a depth d below the height of the take-off and is pushed up as

    z = d s^3,    s = 0 ... 1 in 3 d / v seconds,

which ends at v and accelerates by at most 2/3 v^2 / d, 2 g where legs bend so far: they carry three times the weight;
else 4 or 8 g. A landing is the same backwards. Feet stay where they stand, and legs go from their pose at the take-off
to that at the landing.
A motion with one flight, and no foot that steps beside it, goes its way along the ground, and turns, in the same time:
as s^3 while it is pushed, so that the force has one direction, and at one speed while it rises and while it falls.
With the crouch by default 3/4 of the way are in the air. At the apex it is where the motion has it.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.kinematics import center_of_mass
from planner.model.mechanism import Mechanism
from planner.problem.initial_guess import minimum_jerk
from planner.problem.tasks.legs import REACHED, STILL, Foot, bent, legs_of, points_of_feet, shifted

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
