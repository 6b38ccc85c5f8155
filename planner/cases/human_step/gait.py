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

import csv
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, number, short_repr
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable, read_text

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


WHEN = ("percent", "time")
ALSO = {
    "tilt": ("pelvis_tilt",),
    "list": ("pelvis_list",),
    "rotation": ("pelvis_rotation",),
    "hip_flexion": ("hip_flexion_r", "hip_flexion_angle_r"),
    "hip_adduction": ("hip_adduction_r", "hip_adduction_angle_r"),
    "hip_rotation": ("hip_rotation_r", "hip_rotation_angle_r"),
    "knee": ("knee_r", "knee_angle_r", "knee_angle", "knee_flexion", "knee_flexion_r"),
    "ankle": ("ankle_r", "ankle_angle_r", "ankle_angle", "ankle_dorsiflexion", "ankle_flexion"),
}
UNITS = {"deg": 1.0, "rad": math.degrees(1.0)}
MIN_ROWS = 20  # thirteen coefficients, and some more to check the fit
WIDEST_GAP = 1.0 / (2 * HARMONICS)  # of the cycle: rows farther apart do not determine the harmonics
LARGEST = 1e9  # of any number, s, percent or degrees
MAX_RADIANS, MIN_DEGREES = 3.0, 5.0  # of the largest angle of a walk; a value in between may be either
MAX_JUMP = 5.0  # deg, between end and beginning of a cycle: the difference of two strides
MAX_MISFIT = 3.0  # deg rms, of a column from its series; the higher harmonics of a walk are below one
MAX_EXTENSION = 30.0  # deg, of a knee


def read_gait(path: str | Path) -> Gait:
    """Read a Gait from measured angles: a CSV file of one cycle, with a header line and a row per instant.

        percent, tilt_deg, list_deg, rotation_deg, hip_flexion_deg, hip_adduction_deg, hip_rotation_deg, knee_deg, ...
        0, -1.5, -0.6, ...
        2, ...

    The column of times is `percent` of the cycle (0 is the right heel strike) or `time` in seconds; with `time` the
    first row is a right heel strike and the last row the next one. The other columns are angles of the pelvis and the
    right leg, with the signs of this module and names with or without a unit:

        name             also                                       sign
        tilt             pelvis_tilt                                backward positive
        list             pelvis_list                                right side down positive: about the axis ahead
        rotation         pelvis_rotation                            to the left positive: about the axis up
        hip_flexion      hip_flexion_r, hip_flexion_angle_r         flexion positive
        hip_adduction    hip_adduction_r, hip_adduction_angle_r     adduction positive
        hip_rotation     hip_rotation_r, hip_rotation_angle_r       inward positive
        knee             knee_r, knee_angle_r, knee_angle           flexion negative
                         knee_flexion, knee_flexion_r               flexion positive
        ankle            ankle_r, ankle_angle_r, ankle_angle, ankle_dorsiflexion, ankle_flexion  dorsiflexion positive

    Either all names of angles end in _deg or _rad or none does. Without a unit the values decide: no joint turns by
    more than three radians, and the knee of a walk turns by at least five degrees. Other columns are ignored. The six
    harmonics of a Gait are fitted to the angles by least squares; terms that break the symmetry of left and right are
    dropped.

    Raises:
        FileError: The file cannot be read, a column is missing or holds other things than numbers, the rows are too
            few, do not cover a cycle or do not end where they began, the unit or sign of the angles is not clear, or
            the angles are not one cycle of a walk.
    """
    what = f"the gait {printable(path)}"
    header, rows = _rows(read_text(path, "the gait"), what)
    when, places, units, flips = _columns(header, what)
    table = _numbers(rows, header, [when, *places], what)
    t = _fractions(table[:, 0], header[when], what)
    degrees = table[:, 1:] * flips * _factor(units, table[:, 1:], what)
    _check_cycle(t, degrees, what)
    t = t if t[-1] < 1.0 else t[:-1]  # the last row repeats the first
    return Gait(*(_fitted(name, t, degrees[: len(t), i], what) for i, name in enumerate(ANGLES)))


def _rows(text: str, what: str) -> tuple[list[str], list[list[str]]]:
    """The names of the columns in lower case, and the rows that are not empty."""
    try:
        rows = [row for row in csv.reader(io.StringIO(text), skipinitialspace=True) if any(map(str.strip, row))]
    except csv.Error as error:
        raise FileError(f"{what} is no CSV: {error}.") from None
    if not rows:
        raise FileError(f"{what} is empty, expected a header and rows of numbers.")
    header, rows = [name.strip().lower() for name in rows[0]], rows[1:]
    if len(rows) < MIN_ROWS:
        raise FileError(f"{what} has {len(rows)} rows below its header, expected at least {MIN_ROWS}.")
    return header, rows


def _columns(header: list[str], what: str) -> tuple[int, list[int], list[str], np.ndarray]:
    """The column of times, and for each angle its column, unit ("" for none) and sign."""
    when = [header.index(name) for name in WHEN if name in header]
    found: dict[str, tuple[int, str, str]] = {}
    for i, name in enumerate(header):
        stem, _, unit = name.rpartition("_")
        stem, unit = (stem, unit) if unit in UNITS else (name, "")
        for angle, others in ALSO.items():
            if stem == angle or stem in others:
                if angle in found:
                    raise FileError(f"{what} has two columns of {angle}, {header[found[angle][0]]} and {name}.")
                found[angle] = i, unit, stem
    missing = [angle for angle in ANGLES if angle not in found]
    if not when:
        missing.insert(0, " or ".join(WHEN))
    if missing:
        raise FileError(f"{what} has no column {', '.join(missing)}, expected a header with them.")
    if len(when) == 2:
        raise FileError(f"{what} has columns percent and time, expected one of them.")
    places, units, stems = zip(*(found[angle] for angle in ANGLES), strict=True)
    if len(set(units)) > 1:
        raise FileError(f"{what} says the unit of its angles differently, expected _deg or _rad on all, or on none.")
    return when[0], [*places], [*units], np.where([stem.startswith("knee_flexion") for stem in stems], -1.0, 1.0)


def _numbers(rows: list[list[str]], header: list[str], columns: list[int], what: str) -> np.ndarray:
    """(rows, columns) finite floats."""
    table = np.empty((len(rows), len(columns)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            word = row[column].strip() if column < len(row) else ""
            try:
                table[i, j] = float(word)
            except ValueError:
                table[i, j] = math.nan
            if not abs(table[i, j]) <= LARGEST:
                raise FileError(
                    f"{what} has something else in row {i + 1} of {header[column][:40]}, expected a number of at most "
                    f"{LARGEST:g}."
                )
    return table


def _fractions(times: np.ndarray, name: str, what: str) -> np.ndarray:
    """Times of the rows, fractions of the cycle."""
    if not np.all(np.diff(times) > 0.0):
        i = int(np.argmin(np.diff(times) > 0.0))
        raise FileError(f"{what} has {times[i + 1]:g} after {times[i]:g} in {name}, expected values that rise.")
    if name == "time":
        return (times - times[0]) / (times[-1] - times[0])
    t = times / 100.0
    if t[0] < 0.0 or t[-1] > 1.0 or t[0] > WIDEST_GAP or t[-1] < 1.0 - WIDEST_GAP:
        raise FileError(
            f"{what} goes from {times[0]:g} to {times[-1]:g} percent, expected a whole cycle from 0 to 100."
        )
    return t


def _factor(units: list[str], values: np.ndarray, what: str) -> float:
    """Degrees per unit of the angles (rows, 8)."""
    if units[0]:
        return UNITS[units[0]]
    largest = float(np.abs(values).max())
    if MAX_RADIANS < largest < MIN_DEGREES:
        raise FileError(
            f"{what} has a largest angle of {largest:g}, which may be degrees or radians, "
            "expected names of columns that end in _deg or _rad."
        )
    return UNITS["deg" if largest >= MIN_DEGREES else "rad"]


def _check_cycle(t: np.ndarray, degrees: np.ndarray, what: str) -> None:
    """Check that the rows at t (K,) are close enough and that the angles (K, 8) are a cycle of a walk."""
    gap = float(np.diff(t).max())
    if gap > WIDEST_GAP:
        raise FileError(
            f"{what} has no rows for {100.0 * gap:.3g} percent of the cycle, expected gaps of at most "
            f"{100.0 * WIDEST_GAP:.3g}."
        )
    largest = float(np.abs(degrees).max())
    if largest > HIGHEST:
        raise FileError(f"{what} has an angle of {largest:.4g} deg, expected at most {HIGHEST:g}.")
    # Between the last row and the next heel strike an angle may change as fast as it does anywhere in the cycle.
    allowed = MAX_JUMP + np.abs(np.diff(degrees, axis=0) / np.diff(t)[:, None]).max(axis=0) * (t[0] + 1.0 - t[-1])
    jump = np.abs(degrees[-1] - degrees[0])
    if np.any(jump > allowed):
        worst = int(np.argmax(jump - allowed))
        raise FileError(
            f"{what} ends {jump[worst]:.3g} deg from where it begins in {ANGLES[worst]}, expected one cycle that comes "
            f"back to within {MAX_JUMP:g}."
        )
    extension = float(degrees[:, ANGLES.index("knee")].max())
    if extension > MAX_EXTENSION:
        raise FileError(
            f"{what} has a knee that extends by {extension:.3g} deg, expected flexion to be negative, or a column "
            "knee_flexion where it is positive."
        )


def _fitted(name: str, t: np.ndarray, degrees: np.ndarray, what: str) -> tuple[float, ...]:
    """Fit the thirteen coefficients to an angle (K,) at t (K,)."""
    functions = basis(t)[0]
    series = np.linalg.lstsq(functions, degrees, rcond=None)[0]
    misfit = float(np.sqrt(np.mean((functions @ series - degrees) ** 2)))
    if misfit > MAX_MISFIT:
        raise FileError(
            f"{what} is {misfit:.3g} deg rms from any series of {HARMONICS} harmonics in {name}, expected one cycle of "
            f"a walk, to {MAX_MISFIT:g}."
        )
    return tuple(np.where(used(name), series, 0.0).tolist())
