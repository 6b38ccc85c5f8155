"""Problem files of the package: each is short, converges and meets its goals by its name; slow, it passes its proof."""

import tomllib
from functools import cache

import numpy as np
import pytest
from commands import refused, run

import planner
from planner.base.data_files import problem_files
from planner.dynamics.contact_kinematics import PlaneContactKinematics
from planner.dynamics.kinematics import LinkPlaces
from planner.dynamics.statics import STRIDE
from planner.problem.goals import goals_of

FILES = problem_files()


@cache
def plan_of(name):
    return planner.solve(planner.load_problem(name))


# Those of 2 s and more, whose plans the proof below shares: what they show is shown by the others.
SLOW = dict.fromkeys(("lander", "pusher"), pytest.mark.slow)


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW.get(name, ())) for name in FILES])
def test_it_converges_and_meets_every_goal(name):
    plan = plan_of(name)
    assert plan.success
    goals = goals_of(plan.problem, plan.xs)
    assert goals
    for one in goals:
        assert one.miss(plan.t, plan.xs) <= one.tolerance, one.name


@pytest.mark.parametrize("name", FILES)
def test_its_file_is_short_and_weighs_nothing(name):
    text = FILES[name].read_text(encoding="utf-8")
    assert len([line for line in text.splitlines() if not line.startswith("#")]) <= 12
    assert "weights" not in tomllib.loads(text)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_it_passes(name):
    proof = planner.prove(plan_of(name), rollouts=0)
    assert proof.passed, proof.reason


@pytest.mark.slow
def test_the_lander_pushes_only_and_the_quadrotor_goes_through_its_window():
    lander, drone = plan_of("lander"), plan_of("quadrotor")
    assert lander.us[:, 0].min() >= 0.0
    x, y, z = drone.xs[abs(drone.xs[:, 0] - 1.2) < 0.04, :3].T  # between the faces of the window's frame
    assert len(x)
    assert abs(y).max() < 0.44  # its opening: see mjcf/quadrotor/scene.xml
    assert z.min() > 1.2
    assert z.max() < 1.7


def test_the_monopod_leaves_the_ground_and_the_satellite_turns_without_momentum():
    hop, turn = plan_of("monopod"), plan_of("satellite")
    assert (hop.xs[:, 1] + hop.xs[:, 3]).max() > 0.1  # m: a sole is at z + leg where the leg is upright
    mechanism = turn.problem.dynamics.mechanism
    for q, qd in zip(turn.xs[:, : mechanism.nq], turn.xs[:, mechanism.nq :], strict=True):
        assert abs(planner.dynamics.angular_momentum(mechanism, q, qd)).max() < 1e-4  # N m s; RK4 keeps it so nearly


def test_the_quadruped_rises_and_its_feet_stay():
    rise = plan_of("quadruped")
    mechanism = rise.problem.dynamics.mechanism
    q, qd = rise.xs[:, : mechanism.nq], rise.xs[:, mechanism.nq :]
    assert q[-1, 2] - q[0, 2] > 0.15  # m
    assert len(mechanism.contacts) == 4
    for foot in mechanism.contacts:
        at = PlaneContactKinematics(LinkPlaces(mechanism, q), foot, qd)
        slip = rise.problem.dynamics.dt * np.linalg.norm(at.v[:, :2], axis=1).sum()
        assert slip < 0.1 * STRIDE  # more than STRIDE is what the proof calls sliding


@pytest.mark.slow
def test_the_pusher_moves_a_trolley_that_no_motor_drives():
    push = plan_of("pusher")
    mechanism = push.problem.dynamics.mechanism
    trolley = mechanism.joint("along").start
    assert not mechanism.directly_actuated[trolley]
    assert abs(push.xs[-1, trolley] - 0.2) < 0.02  # m: the goal and its tolerance in the file


def test_a_name_stands_for_its_file(tmp_path):
    with pytest.raises(planner.PlannerError, match=r"expected planner.load_problem\('lander'\)"):
        planner.cases.build("lander")
    shown = run("list", "monopod", cwd=tmp_path).stdout
    assert FILES["monopod"].read_text(encoding="utf-8") in shown
    refused(run("run", "landr", cwd=tmp_path), "Did you mean 'lander'?")
    done = run("solve", "monopod", "--out", "a.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert planner.load_plan(tmp_path / "a.npz").converged
