"""The motion through a task's poses: at each of them in time, at rest where it is to stop, and followed."""

import numpy as np
import pytest
from arms import START, mechanism

import planner
from planner.dynamics.protocol import rollout_states
from planner.problem.initial_guess import quintic
from planner.problem.tasks.goal import Goal
from planner.problem.tasks.poses import Poses, poses_of
from planner.problem.tasks.reference_motion import controls, interpolate, joint_displacement, reference_states
from planner.problem.tasks.timed_task import task_of

N, DT = 100, 0.02
GOALS = [
    Goal(joints={"shoulder": 1.0, "elbow": -0.5}, time=0.6, through=True),
    Goal(joints={"shoulder": 1.2, "elbow": 0.5}, time=1.0),
    Goal(joints={"shoulder": 0.0, "elbow": 0.0}),
]


@pytest.fixture(scope="module")
def way():
    machine = mechanism()
    dynamics = planner.RigidBodyDynamics(machine, DT)
    task = task_of(machine, GOALS, [], N, DT)
    x0 = np.array([*START.values(), 0.0, 0.0])
    return task, poses_of(task, dynamics, x0, machine.joint_range), dynamics, x0


def test_it_is_at_every_goal_in_time_and_stops_where_it_is_not_passed(way):
    task, poses, _, x0 = way
    xs = reference_states(task, poses, x0)
    np.testing.assert_allclose(xs[[0, 30, 50, 100], :2], [[0.5, -1.0], [1.0, -0.5], [1.2, 0.5], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(xs[[0, 50, 100], 2:], 0.0, atol=1e-12)
    assert np.abs(xs[30, 2:]).min() > 0.1
    np.testing.assert_allclose(joint_displacement(task, poses), [0.7 + 1.2, 1.5 + 0.5])


def test_velocities_and_accelerations_are_differences_of_the_positions(way):
    task, poses, _, x0 = way
    t = np.array([0.31, 0.73, 1.4])
    h = 1e-5
    before, here, after = (interpolate(task, poses, x0, t + s * h) for s in (-1, 0, 1))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * h), here[1], atol=1e-7)  # h^2 and 1e-16 / h
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), here[2], atol=1e-6)


def test_between_two_poses_at_rest_it_is_the_straight_line_of_all_guesses():
    machine = mechanism()
    task = task_of(machine, [Goal(joints="bent")], [], N, DT)
    poses = Poses(np.array([0, N]), np.array([[0.0, 0.0], [0.5, -1.0]]), np.array([True, True]))
    t = DT * (np.arange(N) + 0.5)
    for got, wanted in zip(
        interpolate(task, poses, np.zeros(4), t), quintic(np.zeros(2), np.array([0.5, -1.0]), N * DT, N), strict=True
    ):
        np.testing.assert_allclose(got, wanted, atol=1e-12)


def test_its_controls_move_the_machine_along_it(way):
    task, poses, dynamics, x0 = way
    us = controls(task, poses, dynamics, x0)
    xs = rollout_states(dynamics, x0, us)
    # Controls are held over a stage: of second order in dt, so a fifth of dt brings the end 25 times nearer.
    away = np.abs(xs - reference_states(task, poses, x0))[:, :2].max()
    fine = task_of(dynamics.mechanism, GOALS, [], 5 * N, DT / 5)
    finer = planner.RigidBodyDynamics(dynamics.mechanism, DT / 5)
    poses = poses_of(fine, finer, x0, dynamics.mechanism.joint_range)
    near = np.abs(rollout_states(finer, x0, controls(fine, poses, finer, x0)) - reference_states(fine, poses, x0))[
        :, :2
    ].max()
    assert away < 0.02
    assert near < away / 15.0


def test_a_machine_with_a_ball_joint_has_states_but_no_controls():
    text = """<mujoco><worldbody><body><joint name="hip" type="ball"/><inertial pos="0 0 -1" mass="1"
        diaginertia="1 1 1"/><body pos="0 0 -1"><joint name="knee" axis="0 1 0"/><inertial pos="0 0 -1" mass="1"
        diaginertia="1 1 1"/><site name="foot" pos="0 0 -1"/></body></body></worldbody>
        <actuator><motor joint="knee"/></actuator></mujoco>"""
    machine = planner.Mechanism.from_mjcf(text)
    dynamics = planner.RigidBodyDynamics(machine, DT)
    task = task_of(machine, [Goal(frame="foot", position=(0.3, 0.2, -1.7))], [], N, DT)
    poses = poses_of(task, dynamics, machine.home, machine.joint_range)
    xs = reference_states(task, poses, machine.home)
    assert controls(task, poses, dynamics, machine.home) is None
    foot = planner.dynamics.frame_pose(machine, xs[-1, : machine.nq], "foot")[:3, 3]
    np.testing.assert_allclose(foot, [0.3, 0.2, -1.7], atol=5e-4)
    np.testing.assert_allclose(np.linalg.norm(xs[:, :4], axis=1), 1.0, atol=1e-12)
    # its velocities are those of the positions: one stage apart, to second order
    middle = machine.space.difference(xs[51], xs[49])[: machine.nv] / (2 * DT)
    np.testing.assert_allclose(middle, xs[50, machine.nq :], atol=2e-3)
