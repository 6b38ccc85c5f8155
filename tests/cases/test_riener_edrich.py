"""Riener and Edrich's passive moments in the human step: the formulas, the study's swing with them, its replay."""

import math

import numpy as np
import pytest

import planner
from planner.__main__ import main
from planner.base.errors import PlannerError
from planner.cases import human_step
from planner.cases.human_step.gait import NORMAL_GAIT
from planner.cases.human_step.measures import measures
from planner.cases.human_step.walker import BRACES, CURVED, PASSIVE, SIDES, SIGNS, TERMS, GaitPhase, Walker
from planner.dynamics.contacts import generalized_forces

WALKER = Walker(legs=("right",), belt=False, passive="riener-edrich")


@pytest.fixture(scope="module")
def swing():
    return planner.solve(human_step(phase="swing", cost="study", passive="riener-edrich"))


def moments(h, k, a):
    """N m of degrees, as the paper counts both: hip and knee flexion, plantar flexion."""
    return (
        math.exp(1.4655 - 0.0034 * k - 0.0750 * h) - math.exp(1.3403 - 0.0226 * k + 0.0305 * h) + 8.072,
        math.exp(1.800 - 0.0460 * a - 0.0352 * k + 0.0217 * h)
        - math.exp(-3.971 - 0.0004 * a + 0.0495 * k - 0.0128 * h)
        - 4.820
        + math.exp(2.220 - 0.150 * k),
        math.exp(2.1016 - 0.0843 * a - 0.0176 * k) - math.exp(-7.9763 + 0.1949 * a + 0.0008 * k) - 1.792,
    )


@pytest.mark.parametrize("degrees", [(0.0, 0.0, 0.0), (30.0, 60.0, -10.0), (-15.0, 10.0, 30.0)])
@pytest.mark.parametrize("stiffness", [1.0, 0.5])
def test_the_moments_are_the_formulas(degrees, stiffness):
    m = Walker(stiffness=stiffness, passive="riener-edrich").mechanism
    q = np.zeros(m.nq)
    q[m.joint("pelvis_z").start] = 5.0  # above the belt
    for side in SIDES:
        for joint, angle in zip(CURVED, degrees, strict=True):
            q[m.joint(f"{side}_{joint}").start] = SIGNS[joint] * np.radians(angle)
    tau = generalized_forces(m, q, np.zeros(m.nv))
    for side in SIDES:
        for joint, moment in zip(CURVED, moments(*degrees), strict=True):
            assert SIGNS[joint] * tau[m.joint(f"{side}_{joint}").start] == pytest.approx(stiffness * moment, rel=1e-12)
    assert np.count_nonzero(tau) == 2 * len(CURVED)


def test_joints_resist_at_their_ends_and_hardly_between():
    """Within a normal stride some N m; towards the ends of the joints' ranges tens, back to the middle."""
    inside = moments(20.0, 30.0, 0.0)
    assert max(map(abs, inside)) < 10.0
    assert moments(-20.0, 0.0, 0.0)[0] > 20.0  # a hip stretched back is pulled forward
    assert moments(110.0, 30.0, 0.0)[0] < -40.0
    assert moments(0.0, -5.0, 0.0)[1] > 20.0  # a knee bent backwards is pushed to bend forwards
    assert moments(0.0, 130.0, 0.0)[1] < -10.0
    assert moments(0.0, 0.0, -30.0)[2] > 50.0  # a lifted foot is pushed down
    assert moments(0.0, 0.0, 55.0)[2] < -10.0


def test_springs_and_the_knees_stop_make_room():
    m = WALKER.mechanism
    assert m.stops == ()
    for joint, (k, b, _) in PASSIVE.items():
        i = m.joint(f"right_{joint}").start
        assert m.stiffness[i] == (0.0 if joint in CURVED else k)
        assert m.damping[i] == b
    braced = Walker(passive="riener-edrich", brace="ankle").mechanism
    ankle = braced.joint("left_ankle").start
    assert braced.stiffness[ankle] == BRACES["ankle"][0]
    assert ankle not in {curve.dof for curve in braced.curves}
    assert len(braced.curves) == 2 * (len(TERMS["hip_flexion"]) + len(TERMS["knee"]) + 2)  # and a constant each


def test_the_swing_is_the_studys(swing):
    """Its 10 iterations, J 20.0, RMS of hip flexion, adduction, rotation, knee and ankle, lift of the hip."""
    assert swing.status is planner.Status.CONVERGED
    assert swing.nit <= 11
    assert swing.cost == pytest.approx(20.0, abs=0.05)
    found = measures(GaitPhase(WALKER, NORMAL_GAIT, 1.2, 0.62, 114, 0.004), swing.xs)
    np.testing.assert_allclose(list(found.rms.values()), [5.6, 7.9, 2.9, 12.4, 19.4], atol=0.051)
    assert found.hip_lift["right"] == pytest.approx(0.068, abs=1e-3)


def test_the_swing_is_proved_from_its_file(swing, tmp_path):
    """Nothing touches, nothing stops: MuJoCo repeats it to a hundred thousandth of a degree."""
    loaded = planner.load_plan(swing.save(tmp_path / "plan.npz"))
    assert loaded.twin.curves == loaded.problem.dynamics.mechanism.curves == WALKER.mechanism.curves
    assert np.degrees(np.abs(planner.replay(loaded).error[:, :11]).max()) < 1e-4
    assert planner.parity(loaded.problem).passed


def test_the_command_line_asks_for_passive_joints(tmp_path):
    file = tmp_path / "plan.npz"
    assert main(["solve", "human-step", "--phase", "swing", "--passive", "riener-edrich", "--out", str(file)]) == 0
    assert planner.load_plan(file).parameters["passive"] == "riener-edrich"


def test_bad_input_is_refused():
    with pytest.raises(PlannerError, match="passive is 'riener', expected one of: table, riener-edrich"):
        human_step(passive="riener")
