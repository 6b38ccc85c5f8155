"""Jumps: how a machine crouches, pushes itself off the ground, flies and is caught, as a reference.

Where no foot stands for T seconds the centre of mass is on a parabola, c = g T^2 / 8 high, which it enters and leaves
at v = g T / 2. Before, it goes down to a depth d below the height of the take-off and is pushed up as

    z = d s^3,    s = 0 ... 1 in 3 d / v seconds,

which ends at v and accelerates by at most 2/3 v^2 / d, 2 g by default: legs carry three times the weight. A landing
is the same backwards. Feet stay where they stand, and legs go from their pose at the take-off to that at the landing.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.kinematics import center_of_mass
from planner.model.mechanism import Mechanism
from planner.problem.initial_guess import minimum_jerk
from planner.problem.tasks.legs import REACHED, Foot, bent, legs_of, points_of_feet, shifted

DEPTH = 2.0 / 3.0  # of c: for an acceleration of 2 g
LONGEST_PUSH = 0.6  # of the time on the ground before a take-off, the rest of it for the way down
HALVINGS = 6  # of the interval in which legs begin to reach the ground: to 2 % of it
MATCHES = 5  # times that the centre of mass is put on its way and legs bent: each moves the other


def flights_of(stands: np.ndarray) -> list[tuple[int, int]]:
    """The last knot before and the first one after each flight that begins and ends on the ground; stands (N+1, K)."""
    up = np.flatnonzero(np.diff(np.concatenate([[0], (~stands.any(axis=1)).astype(int), [0]])))
    return [(int(a) - 1, int(b)) for a, b in up.reshape(-1, 2) if a > 0 and b < len(stands)]


def jumping(
    mechanism: Mechanism, q: np.ndarray, feet: list[Foot], places: np.ndarray, flights: list[tuple[int, int]],
    ranges: np.ndarray, dt: float,
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
    """
    if mechanism.reduction is not None or mechanism.has_closed_chains:
        return None
    n = feet[0].normal
    wanted = _heights(center_of_mass(mechanism, q) @ n, flights, abs(float(mechanism.gravity @ n)), dt)
    if wanted is None:
        return None
    on_ground = np.ones(len(q), dtype=bool)
    for a, b in flights:
        on_ground[a + 1 : b] = False
    at = mechanism.q_address[legs_of(mechanism, feet)]
    errors = np.zeros(1)
    for _ in range(MATCHES):
        q = shifted(mechanism, q, np.outer(wanted - center_of_mass(mechanism, q) @ n, n))
        q[on_ground], errors = bent(mechanism, q[on_ground], feet, places[on_ground], ranges)
        for a, b in flights:
            share = minimum_jerk(np.linspace(0.0, 1.0, b - a + 1))[0][:, None]
            q[a : b + 1, at] = q[a, at] + share * (q[b, at] - q[a, at])
    return q if errors.max() <= REACHED else None


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


def _heights(z: np.ndarray, flights: list[tuple[int, int]], g: float, dt: float) -> np.ndarray | None:
    """(N+1,) m, of the centre of mass with its flights, from those of the motion z (N+1,)."""
    found, stood = z.copy(), 0
    for k, (a, b) in enumerate(flights):
        T = (b - a) * dt
        c, v, t = g * T**2 / 8.0, g * T / 2.0, dt * np.arange(b - a + 1)
        low = z[(a + b) // 2] - c
        end = (b + flights[k + 1][0]) // 2 if k + 1 < len(flights) else len(z) - 1
        if low < min(z[stood], z[end]):
            return None
        found[a : b + 1] = low + v * t - 0.5 * g * t**2
        found[stood : a + 1] = _push(z[stood], low, (c, v), a - stood, dt)
        found[b : end + 1] = _push(z[end], low, (c, v), end - b, dt)[::-1]
        stood = end
    return found


def _push(z: float, low: float, of: tuple[float, float], knots: int, dt: float) -> np.ndarray:
    """(knots + 1,) m, heights from z at rest to `low`, at the speed of a flight `of` c, m, and v, m/s."""
    c, v = of
    depth = max(min(DEPTH * c, LONGEST_PUSH * knots * dt * v / 3.0), low - z)
    pushes = min(max(round(3.0 * depth / v / dt), 1), knots)
    down = minimum_jerk(np.linspace(0.0, 1.0, knots - pushes + 1))[0] if knots > pushes else np.ones(1)
    rise = low - depth + depth * np.linspace(0.0, 1.0, pushes + 1) ** 3
    return np.concatenate([z + down * (rise[0] - z), rise[1:]])
