"""A machine with feet passes at the first try with four lines: nothing of it is tuned."""

import numpy as np
import pytest
from machines import dog

from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces, contact_jacobians
from planner.dynamics.kinematics import frame_pose
from planner.model.mechanism import Frame
from planner.problem.costs.tracking import tracking_of
from planner.proof import prove
from planner.solvers.slq import solve

FOUR_LINES = """model = "dog.xml"
start = {}
goal = { "fore hip" = 0.15, "hind hip" = 0.15, "fore knee" = -0.1, "hind knee" = -0.1 }
duration = 0.8
"""


def loaded(tmp_path, more=""):
    (tmp_path / "dog.xml").write_text(dog())
    (tmp_path / "problem.toml").write_text(FOUR_LINES + more)
    return load(tmp_path / "problem.toml").problem


def test_a_dog_bends_its_legs(tmp_path):
    problem = loaded(tmp_path)
    plan = solve(problem)
    proof = prove(plan, rollouts=0)
    assert proof.verdict == "PASS", proof.reason
    assert len(plan.history) <= 20  # it takes 4: a goal that drags feet, or a tight end, took 20 to 200


def test_the_goal_is_where_the_feet_carry_the_trunk(tmp_path):
    """Legs that turn backwards carry it forwards: its feet roll, and none slides."""
    problem = loaded(tmp_path)
    m, goal = problem.dynamics.mechanism, problem.cost.x_ref[-1]
    way = m.space.difference(goal, problem.x0)
    assert abs(way[0]) > 0.02
    middle = m.space.integrate(problem.x0, 0.5 * way)[: m.nq]
    carrying = np.flatnonzero(contact_forces(m, goal[: m.nq], np.zeros(m.nv)).forces.any(axis=1))
    slides = contact_jacobians(m, middle, carrying)[:, 0] @ way[: m.nv]
    # Both legs bend alike on a level ground, so what one slides forwards the other slides back: little.
    assert len(carrying) == 2
    assert np.abs(slides).max() < 0.05 * abs(way[0])


@pytest.mark.parametrize("x", [0.1, -0.05])
def test_a_place_that_is_asked_for_stays(tmp_path, x):
    text = FOUR_LINES.replace("goal = {", f"goal = {{ x = {x},")
    (tmp_path / "dog.xml").write_text(dog())
    (tmp_path / "problem.toml").write_text(text)
    assert tracking_of(load(tmp_path / "problem.toml").problem.cost).x_ref[-1][0] == x


def trunk_goal(tmp_path, dx, dz):
    at = loaded(tmp_path)
    x, _, z = frame_pose(at.dynamics.mechanism, at.x0[: at.dynamics.mechanism.nq], "trunk")[:3, 3]
    goal = f'[[goal]]\nframe = "trunk"\nposition = [{x + dx}, 0, {z + dz}]\n'
    text = "".join(line for line in FOUR_LINES.splitlines(True) if not line.startswith("goal"))
    (tmp_path / "trunk.toml").write_text(text + goal)
    return load(tmp_path / "trunk.toml").problem


@pytest.mark.slow
def test_a_trunk_is_brought_to_a_place_while_its_feet_stay(tmp_path):
    """No actuator moves the trunk in the air: the legs carry it there."""
    problem = trunk_goal(tmp_path, 0.01, -0.02)
    m = problem.dynamics.mechanism
    plan = solve(problem)
    assert plan.converged
    proof = prove(plan, rollouts=0)
    assert proof.verdict == "PASS", proof.reason
    shank = next(c for c in m.contacts if "fore foot" in c.name)
    feet = [frame_pose(m, x[: m.nq], Frame(shank.link, np.eye(4)))[:3] @ [*shank.centre, 1] for x in plan.xs[[0, -1]]]
    assert abs(feet[1][0] - feet[0][0]) < 0.035  # m: a ball rolls by its radius in a radian


@pytest.mark.slow
def test_a_trunk_out_of_its_legs_reach_is_refused_with_the_nearest_place(tmp_path):
    with pytest.raises(PlannerError, match=r"goal 1 \(trunk\) is out of reach by 0\.\d+ m"):
        trunk_goal(tmp_path, 0.0, 0.5)
