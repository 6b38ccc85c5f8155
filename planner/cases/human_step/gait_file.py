"""Read a gait from measured angles: a CSV file of one cycle, with a header line and a row per instant.

    percent, tilt_deg, list_deg, rotation_deg, hip_flexion_deg, hip_adduction_deg, hip_rotation_deg, knee_deg, ankle_deg
    0, -1.5, -0.6, ...
    2, ...

The column of times is `percent` of the cycle (0 is the right heel strike) or `time` in seconds; with `time` the first
row is a right heel strike and the last row the next one. The other columns are angles of the pelvis and the right leg,
with the signs of planner.cases.human_step.gait and names with or without a unit:

    name             also                                       sign
    tilt             pelvis_tilt                                backward positive
    list             pelvis_list                                right side down positive: about the axis ahead
    rotation         pelvis_rotation                            to the left positive: about the axis up
    hip_flexion      hip_flexion_r, hip_flexion_angle_r         flexion positive
    hip_adduction    hip_adduction_r, hip_adduction_angle_r     adduction positive
    hip_rotation     hip_rotation_r, hip_rotation_angle_r       inward positive
    knee             knee_r, knee_angle_r, knee_angle           flexion negative
                     knee_flexion, knee_flexion_r               flexion positive
    ankle            ankle_r, ankle_angle_r, ankle_angle, ankle_dorsiflexion, ankle_flexion     dorsiflexion positive

Either all names of angles end in _deg or _rad or none does. Without a unit the values decide: no joint turns by more
than three radians, and the knee of a walk turns by at least five degrees. Other columns are ignored. The six harmonics
of a Gait are fitted to the angles by least squares; terms that break the symmetry of left and right are dropped.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np

from planner.base.errors import FileError
from planner.base.files import printable, read_text
from planner.cases.human_step.gait import ANGLES, HARMONICS, HIGHEST, Gait, basis, used

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
    """Read a Gait from a CSV file of one cycle; the columns are listed above.

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
