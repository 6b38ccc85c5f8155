"""Normal gait: joint angles over a cycle as Fourier series, and the motion of the pelvis over a belt.

A cycle goes from one right heel strike to the next; t is a fraction of it. Every angle is a series of six harmonics,

    angle(t) = c_0 + sum_k (c_2k-1 cos 2 pi k t + c_2k sin 2 pi k t),          k = 1 .. 6,

so its rates are exact and a longer cycle is the same series over more seconds. The left leg does the same as the right
one, half a cycle later. By this symmetry list and rotation of the pelvis have only odd harmonics and its tilt has only
even ones; other terms of these series are ignored.

The place of the pelvis follows from the feet. Its height puts the lowest point of both feet a little into the belt; the
mean and the second harmonic of this height are kept (two steps a cycle). The pelvis sways to the standing leg and does
not move along the belt, whose speed is that of the standing foot.

    number                  value    from
    series                           OpenSim's data of normal gait; signs are OpenSim's: flexion of hip and ankle,
                                     adduction and inner rotation of the hip positive, flexion of the knee negative
    sway                    0.02 m   ours, on the side of the right leg at t = 0.3, the middle of its stance
    sink                    0.003 m  ours: how deep the lowest point of the feet is in the belt
    stance                  0.08-0.5 ours, part of the cycle in which the right ankle moves with the belt

On the body of 70 kg and 1.75 m with a cycle of 1.2 s the pelvis is at z = 0.9093 - 0.00842 cos 4 pi t
- 0.00677 sin 4 pi t and the belt runs at 1.055 m/s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, number, short_repr
from planner.base.errors import PlannerError

HARMONICS = 6
COEFFICIENTS = 1 + 2 * HARMONICS
PELVIS = ("tilt", "list", "rotation")
LEG = ("hip_flexion", "hip_adduction", "hip_rotation", "knee", "ankle")
ANGLES = (*PELVIS, *LEG)
COLUMNS = ("pelvis_x", "pelvis_y", "pelvis_z", *(f"pelvis_{name}" for name in PELVIS),
           *(f"{side}_{name}" for side in ("right", "left") for name in LEG))  # fmt: skip
"""Columns of q."""
SWAY, SINK = 0.02, 0.003  # m
MIDSTANCE = 0.3  # of the cycle, where the pelvis is farthest over the right leg
STANCE = (0.08, 0.5)  # of the cycle, where the right foot moves with the belt
SAMPLES = 200  # over a cycle, from which height and belt speed are computed
HIGHEST = 180.0  # deg, of any coefficient

_ORDER = np.r_[0, np.repeat(np.arange(1, HARMONICS + 1), 2)]  # harmonic of each coefficient
_USED = {"tilt": _ORDER % 2 == 0, "list": _ORDER % 2 == 1, "rotation": _ORDER % 2 == 1}


def used(name: str) -> np.ndarray:
    """Whether each coefficient (13,) of an angle agrees with the symmetry of left and right."""
    return _USED.get(name, np.ones(COEFFICIENTS, dtype=bool))


def basis(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The thirteen functions of a series at fractions t (K,) of the cycle and their two derivatives: (K, 13) each."""
    w = 2.0 * np.pi * _ORDER
    phase = np.asarray(t)[:, None] * w
    odd = np.arange(COEFFICIENTS) % 2 == 1  # the cosines; the mean is sin(0) + 1
    c, s = np.cos(phase), np.sin(phase)
    value, slope = np.where(odd, c, s), np.where(odd, -s, c) * w
    value[:, 0] = 1.0
    return value, slope, -value * w**2


@dataclass(frozen=True)
class Gait:
    """Angles of a symmetric walk as Fourier series, thirteen coefficients (deg) each: mean, cos 1, sin 1, ... sin 6.

    The angles of the leg are those of the right one; the left leg has the same half a cycle later.

    Raises:
        PlannerError: Not thirteen finite numbers between -180 and 180.
    """

    tilt: tuple[float, ...]  # of the pelvis about -y (to the right), backward positive
    list: tuple[float, ...]  # of the pelvis about x (ahead)
    rotation: tuple[float, ...]  # of the pelvis about z (up)
    hip_flexion: tuple[float, ...]
    hip_adduction: tuple[float, ...]
    hip_rotation: tuple[float, ...]  # inward positive
    knee: tuple[float, ...]  # flexion negative
    ankle: tuple[float, ...]  # dorsiflexion positive

    def __post_init__(self) -> None:
        for field in fields(self):
            series = array(field.name, getattr(self, field.name), (COEFFICIENTS,))
            far = float(np.abs(series).max())
            if far > HIGHEST:
                raise PlannerError(f"{field.name} has a coefficient of {far:g} deg, expected at most {HIGHEST:g}.")
            object.__setattr__(self, field.name, tuple(series.tolist()))

    def to_dict(self) -> dict[str, Any]:
        """JSON values: Gait.from_dict(gait.to_dict()) == gait."""
        return {name: [*series] for name, series in asdict(self).items()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Gait:
        """The gait that to_dict() wrote.

        Raises:
            PlannerError: Not a table of the eight angles.
        """
        if not isinstance(table, Mapping) or set(table) != set(ANGLES):
            raise PlannerError(f"a gait is {short_repr(table)}, expected a table of: {', '.join(ANGLES)}.")
        return cls(**table)

    def angles(self, t: np.ndarray, duration: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Angles, rates and accelerations, (K, 8) each, rad and s, columns as ANGLES, at fractions t (K,) of a cycle.

        The duration of the cycle is in s; t beyond 0 .. 1 repeats it.
        """
        series = np.radians([np.where(used(name), getattr(self, name), 0.0) for name in ANGLES]).T
        value, slope, curvature = (part @ series for part in basis(t))
        return value, slope / duration, curvature / duration**2


class GaitSamples(NamedTuple):
    """Positions, rates and accelerations of pelvis and legs, (K, 16) each; columns as COLUMNS."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


@dataclass(frozen=True)
class Reference:
    """A gait on a body: the motion of pelvis and legs over a belt."""

    gait: Gait
    duration: float  # s, of a cycle
    sway: float  # m, of the pelvis to each side
    height: tuple[float, float, float]  # m, of the pelvis: mean, cosine and sine of the second harmonic
    belt_speed: float  # m/s, backward

    def at(self, t: np.ndarray) -> GaitSamples:
        """The Motion at fractions t (K,) of the cycle; t may be beyond 0 .. 1."""
        t = np.asarray(t, dtype=float)
        right, left = self.gait.angles(t, self.duration), self.gait.angles(t + 0.5, self.duration)
        place = np.zeros((len(t), 3))
        motion = GaitSamples(*(np.hstack([place, a, b[:, len(PELVIS) :]]) for a, b in zip(right, left, strict=True)))
        w = 2.0 * np.pi / self.duration
        c, s = np.cos(2.0 * np.pi * (t - MIDSTANCE)), np.sin(2.0 * np.pi * (t - MIDSTANCE))
        for part, wave in zip(motion, (c, -w * s, -(w**2) * c), strict=True):
            part[:, 1] = -self.sway * wave
        mean, a, b = self.height
        c, s, w = np.cos(4.0 * np.pi * t), np.sin(4.0 * np.pi * t), 2.0 * w
        bob = a * c + b * s
        for part, wave in zip(motion, (mean + bob, w * (b * c - a * s), -(w**2) * bob), strict=True):
            part[:, 2] = wave
        return motion


def reference(
    gait: Gait, foot_points: Callable[[np.ndarray], np.ndarray], duration: float, *, sway: float = SWAY,
    sink: float = SINK,
) -> Reference:  # fmt: skip
    """Fit a gait to a body: compute the height of the pelvis and the speed of the belt from the places of the feet.

    `foot_points` of q (K, 16), columns as COLUMNS, are the places (K, 6, 3) of ankle, heel and toe of the right foot,
    then of the left, m. The duration of a cycle is in s; sway and sink are those of a Reference, m.
    """
    duration = number("duration", duration, greater_than=0.0)
    sway, sink = number("sway", sway, minimum=0.0), number("sink", sink, minimum=0.0)
    t = np.arange(SAMPLES) / SAMPLES
    q = Reference(gait, duration, sway, (0.0, 0.0, 0.0), 0.0).at(t).q
    points = array("foot_points", foot_points(q), (SAMPLES, 6, 3))
    lowest = points[:, [1, 2, 4, 5], 2].min(axis=1)  # heels and toes
    waves = np.fft.rfft(-lowest - sink) / SAMPLES
    height = float(waves[0].real), float(2.0 * waves[2].real), float(-2.0 * waves[2].imag)
    stance = (t > STANCE[0]) & (t < STANCE[1])
    speed = -np.polyfit(duration * t[stance], points[stance, 0, 0], 1)[0]
    return Reference(gait, duration, sway, height, float(speed))


NORMAL_GAIT = Gait(
    tilt=(-1.995, 0.124, -0.004, -0.002, 0.459, 0.006, -0.015, -0.048, 0.024, 0.009, 0.014, -0.008, -0.045),
    list=(0.229, -1.635, -2.625, 0.030, -0.096, 1.079, -0.263, 0.014, -0.052, 0.043, 0.074, 0.004, -0.017),
    rotation=(-0.697, 1.575, 2.670, -0.046, 0.226, 0.582, -0.120, -0.009, 0.173, 0.222, 0.143, -0.009, 0.093),
    hip_flexion=(7.689, 20.709, -3.797, -3.689, -0.952, 0.079, 1.564, -0.109, -0.141, -0.180, 0.198, 0.099, 0.038),
    hip_adduction=(1.705, 0.527, 4.064, 0.159, -0.687, -1.212, 0.379, 0.083, 0.017, -0.144, -0.187, -0.021, 0.030),
    hip_rotation=(-0.007, -0.456, 2.330, 0.177, 2.145, 0.127, 0.622, 0.110, -0.224, -0.667, -0.122, -0.012, -0.060),
    knee=(-20.310, 1.805, 19.382, 13.827, -8.289, -0.016, -4.508, 0.694, -0.501, 0.331, -0.815, -0.245, -0.148),
    ankle=(1.142, -2.261, 5.018, 0.946, -5.808, -3.542, 0.521, 1.891, -0.054, -0.338, -1.083, 0.401, 0.386),
)
