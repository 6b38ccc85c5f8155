"""The fastest rate of a machine, the joint that it belongs to, and the substeps that it needs."""

from __future__ import annotations

import numpy as np
import pytest
from machines import FAST_FINGER
from trees import driven, machines, relative_error

from planner import Mechanism, RigidBodyDynamics
from planner.base.errors import PlannerError
from planner.dynamics.step_stability import (
    GONE,
    TARGET_RATE_STEP,
    FastestMode,
    fastest_mode,
    reason,
    substeps_of,
)

SLIDES = """
<mujoco><worldbody>
  <body><joint name="slow" type="slide" axis="1 0 0" damping="3"/><inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/>
  </body>
  <body><joint name="{first}" type="slide" axis="1 0 0" damping="40"/>
    <inertial mass="0.5" pos="0 0 0" diaginertia="1 1 1"/></body>
  <body><joint name="{second}" type="slide" axis="1 0 0" damping="{damping}"/>
    <inertial mass="0.5" pos="0 0 0" diaginertia="1 1 1"/></body></worldbody>
  <actuator><general joint="slow" gainprm="1" biastype="affine" biasprm="0 -5000 -10"/></actuator></mujoco>
"""


def slides(damping=40, first="left", second="right"):
    return Mechanism.from_mjcf(SLIDES.format(damping=damping, first=first, second=second))


def test_the_rate_of_a_damper_is_damping_over_mass():
    m = slides(damping=200)
    found = fastest_mode(m, m.home)
    assert found.rate == pytest.approx(400.0, rel=1e-9)
    assert found.joint == "right"


def test_the_rate_of_a_servo_is_its_frequency():
    m = slides(damping=1)
    servo = Mechanism.from_mjcf(SLIDES.format(damping=1, first="a", second="b").replace('damping="40"', 'damping="1"'))
    assert fastest_mode(servo, m.home).rate == pytest.approx(np.sqrt(5000.0 / 2.0), rel=1e-9)  # |lambda| = sqrt(k / m)
    assert fastest_mode(servo, m.home).joint == "slow"


@pytest.mark.parametrize(("ratio", "lasts"), [(0.0, True), (0.1, True), (0.3, False)])
def test_an_oscillation_lasts_below_a_damping_ratio_of_a_fifth(ratio, lasts):
    """Of the slow slide alone: x'' = -2500 x - 2 ratio 50 x', at sqrt(1 - ratio^2) 50 rad/s."""
    text = SLIDES.format(damping=1, first="a", second="b").replace('damping="3"', 'damping="0"')
    swing = fastest_mode(Mechanism.from_mjcf(text.replace("-10", f"{-2.0 * ratio * 50.0 * 2.0}")), np.zeros(6)).swing
    assert swing == pytest.approx(lasts * 50.0 * np.sqrt(1.0 - ratio**2), rel=1e-4)  # slopes by an Euler step of 1 us


def test_two_that_are_alike_are_one_of_them():
    assert fastest_mode(slides(), slides().home).joint in ("left", "right")


def test_a_rate_is_the_largest_at_any_of_the_states():
    m = Mechanism.from_mjcf(FAST_FINGER)
    rng = np.random.default_rng(0)
    states = rng.normal(size=(5, 4))
    assert fastest_mode(m, states).rate == pytest.approx(max(fastest_mode(m, x).rate for x in states), rel=1e-9)


@machines(8, max_dofs=8)
def test_rates_are_eigenvalues_of_the_differences_of_the_rates(text, seed):
    dynamics, _, us, _ = driven(text, seed, K=1, prescribe=False)
    m = dynamics.mechanism
    x = m.home  # at rest a deviation's rate does not turn with the body
    columns = []
    for e in np.eye(m.space.ndx):
        ahead, back = (m.space.integrate(x, h * e) for h in (1e-5, -1e-5))
        columns.append((dynamics.rates(ahead[None], 0.0 * us) - dynamics.rates(back[None], 0.0 * us))[0] / 2e-5)
    rate = np.abs(np.linalg.eigvals(np.stack(columns, axis=1))).max()
    # a double eigenvalue moves by the root of the differences' error of 1e-9
    assert relative_error(np.array([fastest_mode(m, x).rate]), np.array([rate])) < 1e-3


def test_substeps_keep_the_fastest_motion_stable():
    m = Mechanism.from_mjcf(FAST_FINGER)
    found = fastest_mode(m, m.home)
    for dt in (1e-4, 1e-3, 5e-3):
        substeps = substeps_of(found, dt)
        assert substeps - 1 < found.rate * dt / TARGET_RATE_STEP <= substeps or found.rate * dt > GONE
        A, _ = RigidBodyDynamics(m, dt, substeps=substeps).linearize(np.stack([m.home, m.home]), np.zeros((1, 2)))
        assert np.abs(np.linalg.eigvals(A[0])).max() <= 1.0


@pytest.mark.parametrize(("damping", "rate", "substeps"), [(0.5, 1000.0, [2, 5, 8]), (1.5, 2618.0, [4, 8, 14])])
def test_what_only_decays_needs_fewer_substeps(damping, rate, substeps):
    """A mass of 1 kg on a spring of 1e6 N/m: what swings takes 0.7 a substep, what is gone after a stage 1.0."""
    m = Mechanism.from_mjcf(f"""<mujoco><worldbody><body><joint name="x" type="slide" stiffness="1e6"
      damping="{damping * 2000.0}"/><geom size=".1" mass="1"/></body></worldbody><actuator><motor joint="x"/></actuator>
      </mujoco>""")
    found = fastest_mode(m, m.home)
    assert found.rate == pytest.approx(rate, rel=1e-4)  # 1000 (zeta + sqrt(zeta^2 - 1)) where it does not swing
    assert [substeps_of(found, dt) for dt in (1e-3, 3e-3, 5e-3)] == substeps


def test_what_needs_more_has_the_joint_its_rate_and_the_stage():
    m = slides(damping=2000)
    with pytest.raises(PlannerError, match=r"right has a rate of 4000 per s.* expected dt = 0.005"):
        substeps_of(fastest_mode(m, m.home), 0.02)
    assert substeps_of(fastest_mode(m, m.home), 0.005) == 16  # of 20, 4000 / s * 0.005 s


@pytest.mark.parametrize(("rate", "dt"), [(4000.0, 0.005), (3200.0, 0.01), (1e6, 2e-5), (32.0, 1.0), (31.9, 1.0)])
def test_the_stage_of_the_sentence_is_enough(rate, dt):
    with pytest.raises(PlannerError, match=f"expected dt = {dt:g},"):
        substeps_of(FastestMode(rate, "x", rate), 1.01 * 32.0 / rate)
    assert substeps_of(FastestMode(rate, "x", rate), dt) <= 16


def test_the_reason_is_a_sentence():
    assert reason(FastestMode(382.44, "wrist", 382.44), 4) == (
        "4 substeps a stage, because wrist has the highest rate, 382.4 per s."
    )
    assert reason(FastestMode(3.0, "wrist", 3.0), 1) == "1 step a stage is enough: wrist has the highest rate, 3 per s."
