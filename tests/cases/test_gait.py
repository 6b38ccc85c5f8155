"""Normal gait: exact rates, the symmetry of left and right, and the pelvis and belt that follow from the feet."""

from dataclasses import replace

import numpy as np
import pytest
from leg_chain import LegChain

from planner.base.errors import PlannerError
from planner.cases.human_step.gait import ANGLES, COLUMNS, NORMAL_GAIT, Gait, reference

# A body of 1.75 m by Winter's table; heel and toe of the study of the human step
BODY = LegChain(0.0955 * 1.75 / 2, 0.245 * 1.75, 0.246 * 1.75, (-0.055, -0.039 * 1.75), (0.165, -0.039 * 1.75))
T = np.linspace(-0.3, 1.7, 41)


def shaped(scale):
    return LegChain(
        *(scale * length for length in (BODY.hip_half_width, BODY.thigh, BODY.shank)),
        heel=(scale * BODY.heel[0], scale * BODY.heel[1]),
        toe=(scale * BODY.toe[0], scale * BODY.toe[1]),
    )


def test_pelvis_and_belt_are_those_of_the_study():
    """Section 1 of the study of the human step, to the digits that it states."""
    walk = reference(NORMAL_GAIT, BODY.foot_points, 1.2)
    assert np.all(np.abs(np.subtract(walk.height, (0.9093, -0.00842, -0.00677))) < [5e-5, 5e-6, 5e-6])
    assert abs(walk.belt_speed - 1.055) < 5e-4
    q = walk.at(T).q
    np.testing.assert_allclose(q[:, 0], 0.0)
    np.testing.assert_allclose(q[:, 1], -0.02 * np.cos(2 * np.pi * (T - 0.3)), atol=1e-15)
    expected = 0.9093 - 0.00842 * np.cos(4 * np.pi * T) - 0.00677 * np.sin(4 * np.pi * T)
    np.testing.assert_allclose(q[:, 2], expected, atol=6e-5)


def test_angles_are_the_series_in_degrees():
    """Written out by hand for the knee, whose series has no symmetry to keep."""
    knee = np.zeros_like(T) + NORMAL_GAIT.knee[0]
    for k in range(1, 7):
        cosine, sine = NORMAL_GAIT.knee[2 * k - 1 : 2 * k + 1]
        knee += cosine * np.cos(2 * np.pi * k * T) + sine * np.sin(2 * np.pi * k * T)
    np.testing.assert_allclose(np.degrees(NORMAL_GAIT.angles(T)[0][:, ANGLES.index("knee")]), knee, atol=1e-12)
    assert -60 < knee.min() < -55  # flexion is negative, and its peak that of normal gait
    assert -5 < knee.max() < 0


@pytest.mark.parametrize("duration", [1.0, 1.2, 1.8])
def test_rates_are_derivatives(duration):
    walk, h = reference(NORMAL_GAIT, BODY.foot_points, duration), 1e-5
    before, at, after = (walk.at(T + shift / duration) for shift in (-h, 0.0, h))  # h in seconds
    np.testing.assert_allclose((after.q - before.q) / (2 * h), at.qd, atol=1e-6)
    np.testing.assert_allclose((after.qd - before.qd) / (2 * h), at.qdd, atol=1e-5)
    assert np.abs(at.qdd).max(axis=0)[1:].min() > 0.1  # every column but x moves


def test_a_longer_cycle_is_the_same_path():
    short, long = (reference(NORMAL_GAIT, BODY.foot_points, duration) for duration in (1.0, 2.0))
    np.testing.assert_allclose(short.at(T).q, long.at(T).q, atol=1e-14)
    np.testing.assert_allclose(short.at(T).qdd, 4.0 * long.at(T).qdd, rtol=1e-12, atol=1e-12)
    assert short.belt_speed == pytest.approx(2.0 * long.belt_speed)


def test_half_a_cycle_later_left_is_right():
    walk = reference(NORMAL_GAIT, BODY.foot_points, 1.2)
    now, later = walk.at(T), walk.at(T + 0.5)
    mirrored = np.ones(16)
    mirrored[[COLUMNS.index(name) for name in ("pelvis_y", "pelvis_list", "pelvis_rotation")]] = -1.0
    exchanged = np.r_[0:6, 11:16, 6:11]
    for a, b in zip(now, later, strict=True):
        np.testing.assert_allclose(b, mirrored * a[:, exchanged], atol=1e-11)
    feet_now, feet_later = BODY.foot_points(now.q), BODY.foot_points(later.q)
    np.testing.assert_allclose(feet_later[:, :3], feet_now[:, 3:] * [1.0, -1.0, 1.0], atol=1e-13)


def test_larger_bodies_are_higher_and_faster():
    small, large = (
        reference(NORMAL_GAIT, shaped(scale).foot_points, 1.2, sway=0.02 * scale, sink=0.003 * scale)
        for scale in (1.0, 1.1)
    )
    np.testing.assert_allclose(large.height, 1.1 * np.array(small.height), rtol=1e-12)
    assert large.belt_speed == pytest.approx(1.1 * small.belt_speed)


def test_lowest_points_are_near_the_belt():
    """As near as a mean and one harmonic bring them; of the same numbers the study says -9 to 0 mm."""
    walk = reference(NORMAL_GAIT, BODY.foot_points, 1.2)
    t = np.arange(200) / 200
    lowest = BODY.foot_points(walk.at(t).q)[:, :, 2].min(axis=1)
    assert -0.0103 < lowest.min() < lowest.max() < 0.0032
    assert lowest.mean() == pytest.approx(-0.003, abs=1e-12)


def test_a_gait_survives_json():
    assert Gait.from_dict(NORMAL_GAIT.to_dict()) == NORMAL_GAIT


@pytest.mark.parametrize(
    ("make", "fragment"),
    [
        (lambda: replace(NORMAL_GAIT, knee=(1.0, 2.0)), "knee is (1.0, 2.0), expected 13 numbers"),
        (lambda: replace(NORMAL_GAIT, ankle=(np.nan,) * 13), "ankle[0] is nan"),
        (lambda: replace(NORMAL_GAIT, list=(300.0,) * 13), "list has a coefficient of 300 deg"),
        (lambda: Gait.from_dict({"knee": [0.0] * 13}), "expected a table of: tilt"),
        (lambda: reference(NORMAL_GAIT, BODY.foot_points, 0.0), "duration is 0.0"),
        (lambda: reference(NORMAL_GAIT, lambda q: q, 1.0), "foot_points has shape (200, 16)"),
    ],
)
def test_wrong_curves_of_a_gait_are_refused(make, fragment):
    with pytest.raises(PlannerError) as caught:
        make()
    assert fragment in str(caught.value)
