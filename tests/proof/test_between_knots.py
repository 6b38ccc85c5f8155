"""What is judged between the knots, by bounds of its own; and the grade of a plan whose gains lead it astray."""

import numpy as np
import pytest
from corpus import wrong_between
from corpus.asking import reach
from corpus.machines import arm

import planner
from planner import Limits, Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.proof.error_scales import path_error_bounds, ranges_of_motion, resolutions

SLIDE = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody><actuator><motor joint="x"/></actuator></mujoco>
"""


@pytest.mark.parametrize("make", [wrong_between.coarse_path, wrong_between.wiggle, wrong_between.other_time])
def test_goals_at_times_are_judged_between_the_knots(make):
    proof = planner.prove(make(np.random.default_rng(5)), rollouts=0)
    assert not proof.passed
    assert any(one.name.startswith("planned") for one in proof.goal.failures), proof.reason


def test_what_hardly_moves_is_judged_by_no_other_joints_motion():
    plan = planner.solve(wrong_between.spindle(np.random.default_rng(1)))
    hinge = plan.problem.dynamics.mechanism.joint("j0").start
    spindle = plan.problem.dynamics.mechanism.joint("spindle").start
    moved = np.ptp(plan.xs, axis=0)
    assert moved[spindle] > 200.0
    np.testing.assert_allclose(ranges_of_motion(plan)[[hinge, spindle]], moved[[hinge, spindle]])
    np.testing.assert_allclose(resolutions(plan)[[hinge, spindle]], 1e-3)  # rad: a range is not wider for many turns
    assert path_error_bounds(plan)[hinge] == pytest.approx(0.01 * moved[hinge])


FINGER = """<mujoco><worldbody><body><joint name="arm" axis="0 1 0" damping=".1"/>
<geom type="capsule" size=".02" fromto="0 0 0 .5 0 0" mass="1"/><body pos=".5 0 0"><joint name="finger" type="slide"
axis="0 1 0" damping="1"/><geom size=".01" pos="0 .1 0" mass=".05"/></body></body></worldbody>
<actuator><motor joint="arm"/><motor joint="finger"/></actuator></mujoco>"""


def test_the_speed_of_what_hardly_moves_is_judged_at_the_rate_of_the_motion():
    """A finger that moves half a millimetre while its arm turns by a radian: 1 mm at the arm's rate is its range."""
    problem = reach(FINGER, [1.0, 5e-4], start=[0.0, 0.0, 0.0, 0.0], N=50)
    plan = planner.solve(problem)
    moved = np.ptp(plan.xs, axis=0)
    assert moved[2] / moved[0] > 1.5
    assert path_error_bounds(plan)[3] == pytest.approx(0.01 * 1e-3 * moved[2] / moved[0])
    assert planner.prove(plan, rollouts=0).passed


def test_a_range_is_kept_between_the_knots_too():
    """A mass that turns round at its range: between two knots it would leave it by far more than passes."""
    problem = reach(SLIDE, [-1.0], start=[0.0, 2.0], N=10, limits=Limits(position={"x": (-5.0, 0.12)}))
    loose = planner.solve(problem, planner.SolverOptions(max_tightenings=0))
    plan = planner.solve(problem)
    highest = [one.between_knots(40)[:, 0].max() for one in (loose, plan)]
    assert highest[0] > 0.122
    assert highest[1] < 0.121
    assert plan.success
    assert planner.prove(plan, rollouts=0).passed


def test_a_plan_whose_gains_lead_astray_is_for_open_loop_only():
    """A loop of 600 rad/s on a machine that needs no gains: at 500 Hz and a period late it diverges."""
    text = arm(np.random.default_rng(0), 1, length=0.02, mass=0.01, joint=lambda i: 'damping="1e-5"', gravity="0 0 0")
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text), 5e-4)
    inertia = 0.01 * 0.02**2 / 3.0
    cost = TrackingCost.joints(dynamics, [0.5, 0.0], 400, effort=inertia**-2, position=600.0**4, velocity=600.0**2,
                               final_position=600.0**3, final_velocity=600.0)  # fmt: skip
    proof = planner.prove(planner.solve(Problem(dynamics, cost, np.zeros(2))), rollouts=0)
    assert proof.passed
    assert proof.misleads
    assert proof.robustness == "open loop only"
    assert "; feasible, optimal, open loop only: with its gains" in proof.headline
    assert {one.name for one in proof.lost_with_gains} >= {"path_angle_error"}


def test_a_rod_does_not_pass_a_wire_between_two_steps():
    proof = planner.prove(wrong_between.through_wire(np.random.default_rng(2)), rollouts=0)
    assert not proof.passed
    assert "pass through each other" in proof.reason or "touch" in proof.reason
