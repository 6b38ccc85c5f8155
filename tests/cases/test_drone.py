"""A drone from a file of four lines: planned, proved, described."""

import numpy as np
import pytest
from commands import run
from thrusters import QUADROTOR

import planner

PROBLEM = """
model = "quadrotor.xml"
start = {}
duration = 1.5
goal = { base = [1, 0, 0.5, 1, 0, 0, 0] }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drone")
    (folder / "quadrotor.xml").write_text(QUADROTOR)
    (folder / "problem.toml").write_text(PROBLEM)
    return folder


@pytest.mark.slow
def test_a_drone_flies_a_metre_and_passes(folder):
    plan = planner.solve(planner.load_problem(folder / "problem.toml"))
    assert plan.converged
    assert plan.us.min() >= 0.0
    assert plan.us.max() <= 4.0
    speeds = np.linalg.norm(plan.xs[:, 7:10], axis=1)
    assert speeds.max() < 1.5 * 1.875 / 1.5  # the peak of a minimum-jerk motion is 1.875 m in 1.5 s
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof


def test_effort_is_counted_from_hover(folder):
    cost = planner.load_problem(folder / "problem.toml").cost
    np.testing.assert_allclose(cost.u_ref, 0.6 * 9.81 / 4.0)


def test_its_description_warns_of_nothing(folder):
    done = run("model", "quadrotor.xml", "--no-picture", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "4 actuators" in done.stdout
    for word in ("falls", "floor", "ignore", "refused"):
        assert word not in done.stdout.replace("floor'", "")


def test_a_frame_s_goal_moves_the_base(folder):
    file = folder / "frame.toml"
    file.write_text(
        PROBLEM.replace(
            "goal = { base = [1, 0, 0.5, 1, 0, 0, 0] }", '[[goal]]\nframe = "frame"\nposition = [0, 0.8, 0.9]'
        )
    )
    plan = planner.solve(planner.load_problem(file))
    assert plan.converged
    np.testing.assert_allclose(plan.xs[-1, :3], [0.0, 0.8, 0.9], atol=5e-3)


def test_a_drone_that_stays_is_not_judged_by_rounding(folder):
    """Its running cost is some 1e-30, of controls off the hover by rounding: no percent of that is an error."""
    file = folder / "hover.toml"
    pose = "{ base = [0, 0, 0.5, 1, 0, 0, 0] }"
    file.write_text(f'model = "quadrotor.xml"\nduration = 1\nstart = {pose}\ngoal = {pose}')
    proof = planner.prove(planner.solve(planner.load_problem(file)), rollouts=0)
    for section in (proof.refined_open_loop, proof.refined_feedback):
        assert section.passed, section
