"""Ranges of fixed tendons as limits of a plan: kept with margins, met at their very ends, refused outside."""

import numpy as np
import pytest

import planner
from planner import Limits, Mechanism, PlannerError, Problem, RigidBodyDynamics, TrackingCost

FINGER = """
<mujoco>
  <option gravity="0 0 0" timestep="0.001"/>
  <worldbody>
    <body>
      <joint name="near" axis="0 1 0" damping="0.3" armature="0.01"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.3">
        <joint name="far" axis="0 1 0" damping="0.3" armature="0.01"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.3" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="tie" limited="true" range="-0.02 0.02">
      <joint joint="near" coef="0.1"/>
      <joint joint="far" coef="-0.1"/>
    </fixed>
  </tendon>
  <actuator><motor name="a" joint="near"/><motor name="b" joint="far"/></actuator>
</mujoco>
"""
WIDTH = 0.2  # rad: 0.02 over the coefficient
MARGIN = 0.01  # rad, the least of a hinge; 1 % of the range of 0.4 rad is less


def bent(start=(0.0, 0.0), goal=(1.0, 1.0), effort=(0.01, 1.0), text=FINGER, N=50, **limits):
    """Two joints of a finger that go the same way, of which the second is dear to move: it would lag behind."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text, contacts="off"), 0.02, "rk4")
    cost = TrackingCost.joints(
        dynamics, [*goal, 0.0, 0.0], N, effort=dict(zip("ab", effort, strict=True)), final_position=1e4,
        final_velocity=1e3,
    )  # fmt: skip
    return Problem(dynamics, cost, [*start, 0.0, 0.0], limits=Limits(**({"position": "model"} | limits)))


def tie(xs):
    return xs[:, 0] - xs[:, 1]


def test_a_plan_keeps_the_range_of_a_tendon_less_the_margin():
    free = planner.solve(bent(position="off"))
    assert np.abs(tie(free.xs)).max() > 1.2 * WIDTH  # the range is in the way
    plan = planner.solve(bent())
    assert plan.success, plan.message
    assert np.abs(tie(plan.xs)).max() == pytest.approx(WIDTH - MARGIN, abs=2e-4)
    np.testing.assert_allclose(plan.xs[-1, :2], 1.0, atol=0.01)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    kept = {one.name: one for one in proof.plan.measured}["range_of_tendon_tie_violation"]
    assert (kept.unit, kept.passed) == ("rad", True)
    # In the file a stop holds the tendon, which is soft: that it is leant on is judged there, not how far it gives.
    assert "range_of_tendon_tie_violation" in {one.name for one in proof.refined_open_loop.measured}
    assert "range_of_tendon_tie_violation" not in {one.name for one in proof.your_file.measured}


def test_a_range_that_is_switched_off_is_not_kept_and_mujoco_holds_it():
    plan = planner.solve(bent(position="off"))
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    assert "tendon 'tie' is outside its range" in proof.reason


@pytest.mark.parametrize("limits", [{"margin": 0.05}, {"margin": {"tie": 0.05}}])
def test_the_margin_of_limits_is_that_of_tendons_too(limits):
    plan = planner.solve(bent(**limits))
    assert plan.success, plan.message
    assert np.abs(tie(plan.xs)).max() == pytest.approx(WIDTH - 0.05, abs=2e-4)


def test_a_table_of_positions_names_tendons_by_their_lengths():
    plan = planner.solve(bent(position={"tie": (-0.005, 0.01)}))
    assert plan.success, plan.message
    assert tie(plan.xs).max() == pytest.approx(0.1, abs=2e-4)
    assert planner.solve(bent(position={"tie": "off"})).cost == planner.solve(bent(position="off")).cost


def test_starts_and_goals_at_the_very_end_of_a_range_are_met():
    plan = planner.solve(bent(start=(WIDTH, 0.0), goal=(0.5, 0.5 + WIDTH)))
    assert plan.success, plan.message
    np.testing.assert_allclose(plan.xs[-1, :2], [0.5, 0.5 + WIDTH], atol=0.01)
    assert planner.prove(plan, rollouts=0).passed


@pytest.mark.parametrize(
    ("states", "what"), [({"start": (0.3, 0.0)}, "start"), ({"goal": (1.3, 1.0)}, "goal")], ids=["start", "goal"]
)
def test_a_start_or_goal_outside_is_refused_in_one_sentence(states, what):
    with pytest.raises(PlannerError) as error:
        bent(**states)
    assert str(error.value) == (
        f"the {what} has tendon 'tie' at 0.03, expected -0.02 ... 0.02: write 0.02, or limits.position = "
        '{ tie = "off" }.'
    )


def test_joints_that_keep_a_tendon_within_its_range_leave_it_no_row():
    ranges = FINGER.replace('damping="0.3"', 'damping="0.3" limited="true" range="-5 5"')  # degrees: 0.17 rad apart
    problem = bent(goal=(0.05, 0.05), text=ranges)
    assert problem.trajectory_constraints.rows is None
    assert bent().trajectory_constraints.rows.names == ("range of tendon 'tie'",)


def test_a_length_that_an_equality_holds_is_no_matter_of_the_plan():
    # the equality keeps the length at the end of its range, and MuJoCo's is soft
    held = FINGER.replace("<actuator>", '<equality><tendon tendon1="tie"/></equality><actuator>')
    held = held.replace('range="-0.02 0.02"', 'range="0 0.1"')
    problem = bent(text=held)
    assert problem.trajectory_constraints is None or problem.trajectory_constraints.rows is None
    assert planner.prove(planner.solve(problem), rollouts=0).passed
    with pytest.raises(PlannerError, match="tendon 'tie' at 0"):  # a range that the equality leaves
        bent(text=held.replace('range="0 0.1"', 'range="0.1 0.2"'))


def test_the_derivative_of_a_tendon_is_that_of_differences():
    problem = bent()
    part, rng = problem.trajectory_constraints.rows.parts[0], np.random.default_rng(3)
    xs, us, n, e = rng.normal(size=(4, 4)), np.zeros((4, 2)), np.arange(4), 1e-6
    by_x, by_u = part.function.derivatives(xs, us, n)
    ahead, back = (
        np.stack([part.function.values(xs + sign * e * row, us, n) for row in np.eye(4)], axis=-1) for sign in (1, -1)
    )
    np.testing.assert_allclose(by_x, (ahead - back) / (2.0 * e), atol=1e-9)
    assert not by_u.any()
    assert not hasattr(part.function, "arrays")  # kernels do not know it: the solver adds it beside them
