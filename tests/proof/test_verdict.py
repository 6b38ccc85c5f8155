"""The first line of a verdict: goals of every cost, the path, the cost's own error, and optimality."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from carts import cart
from rolled_out_plans import rolled_out

import planner
from planner import FrameCost, Mechanism, Problem, RigidBodyDynamics, TrackingCost, cases
from planner.base.measured import Measurement, Section
from planner.model.coordinates import coordinates_of
from planner.problem.goals import MIN_TOLERANCES, SHARE, goals_of, unchecked_goals
from planner.problem.objective import with_objective
from planner.proof.consistency import recomputed
from planner.proof.error_scales import SHARE as OF_RANGE
from planner.proof.error_scales import path_error_bounds
from planner.proof.prove_plan import _reason

PENDULUM = """
<mujoco>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0.5 0 0" mass="1" diaginertia="0.01 0.02 0.02"/>
      <site name="hand" pos="1 0 0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
N, DT = 50, 0.02


def pendulum(final=1e4, effort=0.01, cost=None, **others):
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(PENDULUM), DT, "rk4")
    if cost is None:
        cost = TrackingCost.joints(dynamics, [1.5, 0.0], N, effort=effort, final_position=final, final_velocity=final)
    else:
        cost = cost(dynamics)
    return Problem(dynamics, cost, [0.0, 0.0], horizon=N, **others)


def proof_of(plan, **options):
    return planner.prove(plan, rollouts=0, **options)


def measured(section):
    return {one.name: one for one in section.measured}


def test_the_first_line_says_feasible_and_optimal():
    proof = proof_of(planner.solve(pendulum()))
    assert proof.passed, proof.reason
    assert proof.headline == "PASS (open-loop); feasible, optimal"
    assert proof.to_dict()["feasible"] is True
    assert proof.to_dict()["optimal"] is True


def test_what_gains_alone_touch_in_the_file_is_said_in_a_sentence():
    touch = "geom 'wall' and geom 'arm' touch from t = 0.5 s, by up to 0.01 m."
    lost = Measurement("unknown_contacts", 1.0, "", 0.0, touch), Measurement("largest_angle_error", 4.0, "rad", 2.0)
    proof = replace(proof_of(planner.solve(pendulum())), lost_with_gains=lost, lost_in_file=True)
    assert proof.results == f"feasible, optimal, open loop only: in your file with its gains {touch[:-1]}"
    path = replace(proof, lost_with_gains=lost[1:])
    assert path.results.endswith("in your file with its gains largest angle error 4 rad, 2 times its bound")


def test_a_goal_of_a_problem_made_in_python_is_judged():
    plan = planner.solve(pendulum(final=1e-3, effort=10.0))  # far too soft: it hangs down
    assert plan.success
    proof = proof_of(plan)
    assert not proof.passed
    assert "planned angle miss" in proof.reason
    assert "hinge" in measured(proof.goal)["planned_angle_miss"].note
    assert proof.headline.startswith("FAIL; not feasible, optimal")


def test_a_goal_of_a_frame_is_judged_in_metres():
    def to(place):
        def cost(dynamics):
            still = TrackingCost.joints(dynamics, [0.0, 0.0], N, effort=0.01)
            return still + FrameCost(dynamics, "hand", position=place, final_position_weight=1e5)

        return cost

    reached = proof_of(planner.solve(pendulum(cost=to([0.6, 0.0, 0.2]))))
    assert reached.passed, reached.reason
    beyond = proof_of(planner.solve(pendulum(cost=to([0.9, 0.0, 0.2]))))  # 1.2 m from the hinge of an arm of 1 m
    assert not beyond.passed
    one = measured(beyond.goal)["planned_distance_miss"]
    assert one.unit == "m"
    assert one.value == pytest.approx(np.hypot(0.9, 0.8) - 1.0, abs=1e-3)
    assert "position of hand" in one.note


def test_a_soft_goal_is_shown_and_not_judged():
    plan = planner.solve(pendulum(final=1e-3, effort=10.0, tolerance="soft"))
    proof = proof_of(plan)
    assert proof.passed, proof.reason
    assert proof.headline == "PASS (open-loop), 2 of 2 goals not judged; feasible, optimal"
    assert all(one.bound is None for one in proof.goal.measured)


def test_a_problem_without_a_goal_says_so():
    plan = planner.solve(pendulum(final=0.0))
    assert ", no goal was asked for;" in proof_of(plan).headline


def test_the_end_of_a_cost_of_ones_own_is_said_not_to_be_judged():
    class Own(TrackingCost):
        goal_specs = property()  # as a cost that does not know the method

    def cost(dynamics):
        Q = np.zeros((N + 1, 2, 2))
        Q[N] = np.eye(2)
        return Own(Q, np.tile(0.01 * np.eye(1), (N, 1, 1)), [1.5, 0.0])

    assert ", the end of Own was not judged;" in proof_of(planner.solve(pendulum(cost=cost))).headline


def test_the_end_of_the_packages_own_costs_is_judged():
    """An objective of energy asks nothing of the end, beside the goals that are judged."""
    problem = with_objective(cases.two_link(horizon=30), {"effort": 1.0, "energy": 1.0})
    xs = np.linspace(0.0, 1.0, 31)[:, None] * np.ones(4)  # it moves in its last stage, too
    assert unchecked_goals(problem, xs, np.ones((30, 2))) == ()


def test_tolerances_are_2_per_cent_of_the_way_and_of_the_peak():
    problem = pendulum()
    plan = planner.solve(problem)
    angle, rate = goals_of(problem, plan.xs)
    assert (angle.name, angle.unit, rate.name, rate.unit) == ("hinge", "rad", "velocity of hinge", "rad/s")
    assert angle.tolerance == pytest.approx(SHARE * 1.5)
    assert rate.tolerance == pytest.approx(max(SHARE * np.abs(plan.xs[:, 1]).max(), MIN_TOLERANCES["rad/s"]))
    angle, rate = goals_of(replace(problem, tolerance={"hinge": 0.5, "velocity": float("inf")}))
    assert (angle.tolerance, rate.tolerance) == (0.5, np.inf)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, "hard", True, {"hinge": 0.0}, [1.0]])
def test_a_wrong_tolerance_is_refused(tolerance):
    with pytest.raises(planner.PlannerError, match="expected a number above 0"):
        pendulum(tolerance=tolerance)


def test_a_tolerance_of_an_unknown_goal_is_refused():
    with pytest.raises(planner.PlannerError, match="elbow"):
        goals_of(pendulum(tolerance={"elbow": 0.1}))


def test_the_tolerance_is_in_the_plan_file(tmp_path):
    plan = planner.solve(pendulum(final=1e-3, effort=10.0, tolerance={"position": "soft", "velocity": 7.0}))
    plan.save(tmp_path / "plan.npz")
    loaded = planner.load_plan(tmp_path / "plan.npz")
    assert loaded.problem.tolerance == {"position": float("inf"), "velocity": 7.0}


def test_a_solve_that_stopped_does_not_pass():
    plan = planner.solve(cases.two_link(horizon=100), max_iterations=3)
    assert not plan.success
    proof = proof_of(plan)
    assert not proof.passed
    assert "not optimal" in proof.headline
    assert proof_of(replace(plan, problem=replace(plan.problem, tolerance="soft")), optimal=False).passed


def test_a_status_that_says_converged_does_not_make_a_plan_optimal():
    problem = replace(cases.two_link(horizon=100), tolerance="soft")
    guess = rolled_out(problem)
    now = recomputed(guess, problem, guess.xs, guess.us)
    proof = proof_of(replace(guess, K=now.sweep.K, gradient_norm=now.gradient_norm))
    assert proof.feasible, proof.reason
    assert not proof.optimal
    assert not proof.passed
    assert "decrease left" in proof.reason


def test_the_cost_error_does_not_follow_the_final_weights():
    """The running cost is compared: a millimetre at the end times a weight of 1e6 is the goal's to judge."""
    for final in (1e3, 1e6):
        plan = planner.solve(pendulum(final=final))
        shown = measured(proof_of(plan).refined_open_loop)["cost_error"]
        assert "running cost" in shown.note
        assert shown.value < 0.1  # per cent; the controls are the same, only the states' part could differ


def test_the_path_is_judged_between_the_knots_and_in_each_coordinates_own_range():
    plan = planner.solve(pendulum())
    bounds = path_error_bounds(plan)
    assert bounds == pytest.approx(OF_RANGE * np.ptp(plan.xs, axis=0))
    section = proof_of(plan).refined_open_loop
    assert {"path_angle_error", "path_angular_velocity_error"} <= set(measured(section))
    assert measured(section)["path_angle_error"].bound == pytest.approx(bounds[0])


def test_the_path_of_a_small_machine_has_a_small_bound():
    """A plan that goes 1 mm is not repeated by a replay that goes half of it."""
    plan = planner.solve(replace(cart(), x0=[0.999, 0.0]))
    assert path_error_bounds(plan)[0] == pytest.approx(1e-5, rel=0.01)


def test_coordinates_have_names_and_units():
    names = [(one.name, one.unit) for one in coordinates_of(cases.hopper().dynamics)]
    assert names == [("height", "in"), ("velocity of height", "in/s"), ("piston", "in")]
    diver = coordinates_of(cases.high_dive().dynamics)
    assert len(diver) == cases.high_dive().dynamics.ndx
    assert {one.unit for one in diver} == {"m", "rad", "m/s", "rad/s"}
    own = planner.FunctionDynamics(lambda x, u: u, 1, 1, 0.1, coordinates=[("level", "l")])
    assert coordinates_of(own)[0] == ("level", "l")
    assert coordinates_of(planner.FunctionDynamics(lambda x, u: u, 1, 1, 0.1))[0] == ("x[0]", "")


def test_a_plan_that_only_stays_at_its_goal_is_optimal():
    """Its cost is rounding, and so is what another step promises of it."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(PENDULUM), DT)
    still = [np.pi / 2, 0.0]
    cost = TrackingCost.joints(dynamics, still, N, effort=0.01, final_position=1e4, final_velocity=1e4)
    plan = planner.solve(Problem(dynamics, cost, [np.pi / 2 + 1e-15, 0.0]))
    assert plan.cost < 1e-20
    proof = proof_of(plan)
    assert proof.passed, proof.reason


def test_the_cost_of_a_light_machine_is_what_its_solve_stops_at():
    """A gram on a tenth of a metre costs 1e-10: a solve ends where it promises less than that."""
    light = PENDULUM.replace('mass="1" diaginertia="0.01 0.02 0.02"', 'mass="1e-5" diaginertia="1e-8 2e-8 2e-8"')
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(light.replace('damping="0.1"', 'damping="1e-6"')), DT)
    cost = TrackingCost.joints(dynamics, [1.5, 0.0], N, effort=0.01, final_position=100.0, final_velocity=100.0)
    proof = proof_of(planner.solve(Problem(dynamics, cost, [0.0, 0.0])))
    assert proof.passed, proof.reason


def test_stops_that_a_plan_keeps_to_its_tolerance_are_not_of_the_same_step():
    text = PENDULUM.replace('damping="0.1"', 'damping="0.1" range="-1 1.2" limited="true"').replace(
        "<mujoco>", '<mujoco><compiler angle="radian"/>')  # fmt: skip
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text), DT)
    cost = TrackingCost.joints(dynamics, [1.19, 0.0], N, effort=0.01, final_position=1e3, final_velocity=1.0)
    limits = planner.Limits(position="model", tolerance=1e-3)
    plan = planner.solve(Problem(dynamics, cost, [0.0, 3.0], limits=limits))
    assert proof_of(plan).same_step.passed


@pytest.mark.parametrize("case", ["passes", "fails", "not applicable"])
def test_a_plan_that_fails_in_shorter_steps_alone_says_that_its_file_passes(case):
    off = Measurement("path_angle_error", 2.0, "rad", 1.0, "")
    judged = (
        Section("refined, open loop", (off,)),
        Section(
            "your file", (off,) if case == "fails" else (), "it has no actuators" if case == "not applicable" else ""
        ),
    )
    run = SimpleNamespace(warnings=(), reached=(), plan=None)
    assert ("Your file passes with this plan" in _reason(False, judged, [], run)) is (case == "passes")
