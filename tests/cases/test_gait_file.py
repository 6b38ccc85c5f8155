"""Gaits from files: what is read is what was written, in every form; what is no gait is refused in a sentence."""

import json
import math

import numpy as np
import pytest

from planner import cases
from planner.base.errors import FileError
from planner.cases.human_step.gait import ALSO, ANGLES, NORMAL_GAIT, read_gait

PERCENT = np.arange(0.0, 101.0, 2.0)


def write(path, names=None, when="percent", times=PERCENT, angles=None, factor=1.0):
    """A file of the normal gait, its angles in degrees times a factor."""
    fractions = (times - times[0]) / (times[-1] - times[0]) if when == "time" else times / 100.0
    angles = np.degrees(NORMAL_GAIT.angles(fractions)[0]) if angles is None else angles
    names = [f"{name}_deg" for name in ANGLES] if names is None else names
    lines = [",".join([when, *names])]
    lines += [
        ",".join(f"{value:.9g}" for value in (time, *row)) for time, row in zip(times, factor * angles, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def assert_normal(gait, tolerance=1e-6):
    t = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(np.degrees(gait.angles(t)[0]), np.degrees(NORMAL_GAIT.angles(t)[0]), atol=tolerance)


def changed(column, change):
    """The normal gait with one column changed, degrees."""
    angles = np.degrees(NORMAL_GAIT.angles(PERCENT / 100.0)[0])
    angles[:, ANGLES.index(column)] = change(angles[:, ANGLES.index(column)])
    return angles


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"names": [*ANGLES]},
        {"names": [*ANGLES], "factor": math.pi / 180},
        {"names": [f"{name}_rad" for name in ANGLES], "factor": math.pi / 180},
        {"names": [ALSO[name][0] for name in ANGLES]},
        {"names": [name.upper() + " " for name in ANGLES]},
        {"when": "time", "times": 3.7 + np.linspace(0.0, 1.13, 80)},
        {"times": np.arange(0.0, 100.0, 1.0)},  # without the last row, which repeats the first
        {"times": np.sort(np.random.default_rng(0).uniform(0, 100, 120))},
    ],
)
def test_every_form_is_read(tmp_path, form):
    assert_normal(read_gait(write(tmp_path / "gait.csv", **form)))


def test_knee_flexion_is_positive_where_its_name_says_so(tmp_path):
    names = ["knee_flexion" if name == "knee" else name for name in ANGLES]
    assert_normal(read_gait(write(tmp_path / "gait.csv", names, angles=changed("knee", lambda knee: -knee))))


def test_other_columns_and_empty_lines_do_not_matter(tmp_path):
    path = write(tmp_path / "gait.csv")
    lines = [line + (",remark" if i == 0 else ",none") for i, line in enumerate(path.read_text().splitlines())]
    path.write_text("\ufeff" + "\n\n".join(lines) + "\n\n", encoding="utf-8")
    assert_normal(read_gait(path))


def test_noise_is_averaged(tmp_path):
    """Least squares: 1 deg of noise on 100 rows leaves sqrt(13 / 100) of it in 13 coefficients."""
    times = np.arange(0.0, 100.0)
    angles = np.degrees(NORMAL_GAIT.angles(times / 100.0)[0]) + np.random.default_rng(1).normal(size=(100, 8))
    gait = read_gait(write(tmp_path / "gait.csv", times=times, angles=angles))
    error = np.degrees(gait.angles(times / 100.0)[0] - NORMAL_GAIT.angles(times / 100.0)[0])
    assert 0.2 < np.sqrt(np.mean(error[:, 3:] ** 2)) < 0.5


def test_one_side_is_made_both(tmp_path):
    """What breaks the symmetry of left and right is left out: a mean of the list, the first harmonic of the tilt."""
    angles = changed("list", lambda value: value + 2.0)
    angles[:, ANGLES.index("tilt")] += np.cos(2 * np.pi * PERCENT / 100)
    assert_normal(read_gait(write(tmp_path / "gait.csv", angles=angles)))


def without(*missing):
    return [name for name in ANGLES if name not in missing]


def fewer(*missing):
    angles = np.degrees(NORMAL_GAIT.angles(PERCENT / 100.0)[0])
    return angles[:, [i for i, name in enumerate(ANGLES) if name not in missing]]


@pytest.mark.parametrize(
    ("form", "fragments"),
    [
        ({"names": without("knee", "tilt"), "angles": fewer("knee", "tilt")},
         ("no column tilt, knee,", "expected a header with them")),
        ({"when": "frame"}, ("no column percent or time,", "expected a header with them")),
        ({"names": [*ANGLES[:-1], "pelvis_tilt"]}, ("two columns of tilt, tilt and pelvis_tilt",)),
        ({"names": [*ANGLES[:-1], "ankle_rad"]}, ("unit of its angles differently",)),
        ({"times": PERCENT[::4]}, ("13 rows", "at least 20")),
        ({"times": PERCENT / 2}, ("from 0 to 50 percent", "whole cycle")),
        ({"times": PERCENT / 100}, ("from 0 to 1 percent",)),
        ({"times": PERCENT[::-1]}, ("98 after 100 in percent", "rise")),
        ({"times": np.r_[np.linspace(0, 40, 30), np.linspace(60, 100, 30)]}, ("no rows for 20 percent",)),
        ({"names": [*ANGLES], "factor": 4.0 / 57.88}, ("may be degrees or radians",)),
        ({"angles": changed("knee", lambda knee: -knee)}, ("knee that extends by 58.4 deg", "knee_flexion")),
        ({"angles": changed("ankle", lambda ankle: ankle + 0.2 * PERCENT)}, ("20 deg from where it begins in ankle",)),
        ({"angles": changed("ankle", lambda ankle: ankle + 8 * (-1) ** np.arange(51))}, ("8 deg rms", "in ankle")),
        ({"angles": changed("ankle", lambda ankle: ankle * np.nan)}, ("something else in row 1 of ankle_deg",)),
        ({"angles": changed("knee", lambda knee: 1e5 * knee)}, ("an angle of 5.838e+06 deg",)),
    ],
)  # fmt: skip
def test_files_without_a_gait_are_refused(tmp_path, form, fragments):
    with pytest.raises(FileError) as caught:
        read_gait(write(tmp_path / "gait.csv", **form))
    message = str(caught.value)
    assert "\n" not in message
    assert "gait.csv" in message
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(
    ("content", "fragment"),
    [
        (b"", "is empty"),
        (b"\xff\xfe\x00", "not text"),
        (b"percent,knee\n" + b"1,2\n" * 30, "no column tilt, list"),
        (("percent," + ",".join(ANGLES) + "\n" + "1,2\n" * 30).encode(), "has something else in row 1 of list"),
        (
            ("percent," + ",".join(ANGLES) + "\n" + "0" + ",soon" * 8 + "\n" * 2 + "1,2\n" * 30).encode(),
            "something else in row 1",
        ),
        (b'a,"' + b"b" * 200_000 + b'"\n', "no CSV"),
    ],
)
def test_files_that_are_no_csv_are_refused(tmp_path, content, fragment):
    path = tmp_path / "gait.csv"
    path.write_bytes(content)
    with pytest.raises(FileError) as caught:
        read_gait(path)
    assert fragment in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileError, match=r"cannot read the gait .*No such file"):
        read_gait(tmp_path / "none.csv")


def test_a_plan_needs_the_file_no_more(tmp_path):
    path = write(tmp_path / "gait.csv", angles=changed("knee", lambda knee: 0.9 * knee))
    problem = cases.human_step(phase="swing", reference=str(path))
    parameters = json.loads(json.dumps(problem.parameters))  # as a plan's file keeps them
    path.unlink()
    again = cases.build("human-step", **parameters)
    assert np.array_equal(again.cost.costs[0].x_ref, problem.cost.costs[0].x_ref)
    usual = cases.human_step(phase="swing")
    assert not np.allclose(usual.cost.costs[0].x_ref, problem.cost.costs[0].x_ref)
