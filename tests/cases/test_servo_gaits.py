"""Gaits of machines with position servos: their controls are weighed from those that go along the gait."""

import re

import numpy as np
import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load
from planner.dynamics import RigidBodyDynamics, algorithms
from planner.dynamics.protocol import rollout_states
from planner.dynamics.quasi_static import quasi_static_controls
from planner.problem.costs.tracking import tracking_of
from planner.problem.default_weights import servos_of

FOLDER = ROOT / "mjcf" / "quadruped"
STIFFNESS, DAMPING = 80.0, 2.0  # N m/rad, N m s/rad
GOAL = "goal = { root = [0.25, 0, 0.326, 1, 0, 0, 0] }\n"
TROT = 'model = "model.xml"\nstart = "stand"\nduration = 1.0\n'


def loaded(tmp_path, text, servos="aside|hip|knee"):
    """A problem of the quadruped, some of whose motors are position servos with a force range."""
    servo = f'<position kp="{STIFFNESS}" kv="{DAMPING}" forcerange="-35 35" name="\\1"'
    model = re.sub(rf'<motor name="(\w+_(?:{servos}))"', servo, (FOLDER / "quadruped.xml").read_text())
    (tmp_path / "quadruped.xml").write_text(model)
    (tmp_path / "model.xml").write_text((FOLDER / "scene.xml").read_text().replace("..", str(FOLDER.parent)))
    (tmp_path / "problem.toml").write_text(TROT + text)
    return load(tmp_path / "problem.toml").problem


def in_the_air(problem):
    """(N, 12) bool: the controls of legs whose foot is more than 2 cm above where it stood at the start."""
    mechanism, tracking = problem.dynamics.mechanism, tracking_of(problem.cost)
    links = np.array([one.link for one in mechanism.contacts])
    centres = np.array([one.centre for one in mechanism.contacts])
    feet = planner.dynamics.kinematics.points_of(mechanism, tracking.x_ref[:-1, : mechanism.nq], links, centres)[0]
    up = feet[:, :, 2] - feet[0, :, 2] > 0.02
    return np.repeat(up, 3, axis=1)  # feet and legs have the same order


@pytest.mark.parametrize(
    "text",
    [
        GOAL + 'gait = "trot"\n',
        '[[goal]]\nframe = "trunk"\nposition = [0.25, 0, 0.326]\norientation = [1, 0, 0, 0]\n',
        'gait = "trot"\nperiodic = { travel = 0.125 }\n',
    ],
    ids=["state", "frame", "cycle"],
)
def test_a_swinging_leg_costs_nothing_where_its_servos_follow_it(tmp_path, text):
    """kp (u - q) - kv v is the torque of inverse dynamics: no force of the ground acts on a leg in the air."""
    text = 'guess = "hold"\n' + text
    problem = loaded(tmp_path, text if "gait" in text else 'gait = "trot"\n' + text)
    dynamics, tracking = problem.dynamics, tracking_of(problem.cost)
    mechanism, xs = dynamics.mechanism, tracking.x_ref
    middle = dynamics.space.integrate(xs[:-1], 0.5 * dynamics.space.difference(xs[1:], xs[:-1]))
    q, v = middle[:, : mechanism.nq], middle[:, mechanism.velocities]
    acceleration = np.diff(xs[:, mechanism.velocities], axis=0) / dynamics.dt
    torque = algorithms.rnea(mechanism, q, v, acceleration)[:, 6:]
    told = STIFFNESS * (tracking.u_ref - q[:, 7:]) - DAMPING * v[:, 6:]
    legs = in_the_air(problem)
    assert np.sum(legs) > 100
    assert np.abs(torque[legs]).max() > 1.0  # N m, where a leg swings
    np.testing.assert_allclose(told[legs], torque[legs], atol=1e-6)


def test_motors_are_weighed_from_what_holds_the_goal(tmp_path):
    """The servos of a machine that has both follow the gait; the weights of neither change."""
    for servos in ("knee", "none"):
        problem = loaded(tmp_path, GOAL + 'guess = "hold"\ngait = "trot"\n', servos)
        tracking, one = tracking_of(problem.cost), servos_of(problem.dynamics)
        assert one.sum() == (4 if servos == "knee" else 0)
        held = quasi_static_controls(problem.dynamics, tracking.x_ref[-1])
        np.testing.assert_allclose(tracking.u_ref[:, ~one], np.tile(held[~one], (problem.N, 1)), atol=1e-6)
        assert np.ptp(tracking.u_ref[:, one], axis=0).min(initial=1.0) > 0.2  # rad
        weights = problem.parameters["resolved"]["weights"]
        np.testing.assert_array_equal(tracking.R[0], np.diag(problem.dynamics.dt * np.array(weights["effort"])))


def test_a_machine_that_leans_on_its_feet_is_weighed_from_what_holds_its_goal(tmp_path):
    """Without a gait nothing swings: servos are counted from one pose."""
    problem = loaded(tmp_path, GOAL.replace("0.25", "0.02"))
    assert np.ptp(tracking_of(problem.cost).u_ref, axis=0).max() == 0.0


@pytest.mark.slow
def test_a_quadruped_with_servos_trots_from_a_line(tmp_path):
    """With one pose for reference each swing was paid as effort, three times as much in all."""
    problem = loaded(tmp_path, GOAL + 'gait = "trot"\n')
    start = problem.cost.value(rollout_states(problem.dynamics, problem.x0, problem.us), problem.us)
    assert start < 6.0  # 3.0; multiple shooting from servos at 0 ends at 12.7
    plan = planner.solve(problem)
    assert plan.converged, plan
    assert plan.nit < 60  # 30
    assert plan.cost < 4.0  # 2.2
    again = problem.recipe.rebuilt()
    np.testing.assert_array_equal(tracking_of(again.cost).u_ref, tracking_of(problem.cost).u_ref)
    np.testing.assert_array_equal(again.first_guess, problem.first_guess)


def test_inertia_is_a_further_force_of_a_pose():
    mechanism = planner.Mechanism.from_mjcf(FOLDER / "scene.xml", contacts="off")
    dynamics = RigidBodyDynamics(mechanism, 0.01)
    x, force = mechanism.keyframe("stand"), np.zeros(mechanism.nv)
    force[6:] = np.linspace(-3.0, 3.0, 12)
    change = quasi_static_controls(dynamics, x, inertia=force) - quasi_static_controls(dynamics, x)
    still = quasi_static_controls(dynamics, x, inertia=0.0)
    np.testing.assert_array_equal(still, quasi_static_controls(dynamics, x))
    np.testing.assert_allclose(change, force[6:], atol=1e-9)
