"""Which feet phases and gaits ask to stand: how much of it a motion keeps, and what it is called that keeps none."""

from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load
from planner.problem.goals import missed_goal_message
from planner.problem.plan import Status
from planner.problem.stances import BOUND, Stance, kept_shares, least_kept, stances_of_swings
from planner.proof.diagnostics import suggested_fixes
from planner.proof.diagnostics.goals import ignored_stance

JUMP = f"""model = "{ROOT}/mjcf/monopod/scene.xml"
start = {{ leg = 0.15 }}
goal = {{}}
duration = 1.4
[[phase]]
until = 0.5
stand = ["foot"]
[[phase]]
until = 0.9
stand = []
[[phase]]
stand = ["foot"]
"""


@pytest.fixture(scope="module")
def jump(tmp_path_factory):
    path = tmp_path_factory.mktemp("jump") / "p.toml"
    path.write_text(JUMP)
    return load(path).problem


@pytest.fixture
def grounded(tmp_path):
    """The same without the parabola, so that the guess stays where it stands."""
    (tmp_path / "p.toml").write_text(JUMP)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("planner.problem.tasks.gait.jumping", lambda *_: None)
        return load(tmp_path / "p.toml").problem


def in_air(problem, x, height):
    """States (N+1, nx) that stand, and are higher in the air for some knots of the flight of 0.4 s."""
    xs = np.tile(x, (problem.horizon + 1, 1))
    t = problem.dynamics.dt * np.arange(len(xs))
    xs[(t > 0.5) & (t < 0.5 + height), 1] += 0.1  # of the slide z
    return t, xs


def test_a_jump_in_place_is_in_the_air_in_its_phase(jump):
    plan = planner.solve(jump)
    assert plan.success, plan.message
    shares = kept_shares(jump.stances, jump.dynamics, plan.t, plan.xs)
    assert min(shares) > 90.0  # 100, but for knots at which feet leave and land
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed
    measured = {one.name: one for one in proof.sections["goal"].measured}
    assert measured["planned_ignored_stance"].value < 10.0
    assert measured["replayed_ignored_stance"].passed


def test_a_plan_that_stays_on_the_ground_misses_its_phase(grounded):
    plan = planner.solve(grounded)
    assert plan.status is Status.GOAL_MISSED
    assert "phase 2, in which shank swings is kept in 0 %" in plan.message
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    measured = {one.name: one for one in proof.sections["goal"].measured}
    assert measured["planned_ignored_stance"].value == pytest.approx(100.0)
    cause = suggested_fixes(plan, proof)[0]
    assert (cause.code, cause.key) == ("stance_outweighed", "weights.position")  # its reference lifts the foot
    assert cause.values["share"] == 0.0
    assert "phase 2, in which shank swings" in cause.sentence


def test_a_plan_that_leaves_a_motion_that_keeps_its_phases_is_to_follow_it_more(jump):
    """A plan that stands, of a problem whose reference flies."""
    xs, plan = in_air(jump, jump.x0, 0.0)[1], planner.solve(jump, max_iterations=1)
    (cause,) = ignored_stance(replace(plan, xs=xs), jump, None)
    assert (cause.code, cause.key) == ("stance_outweighed", "weights.position")
    own = np.diagonal(jump.cost.Q[0])[:4] / jump.dynamics.dt
    assert list(cause.value) == list(jump.dynamics.mechanism.joint_names)
    assert np.all(np.array(list(cause.value.values())) >= 10.0 * own * (1.0 - 1e-9))
    assert ignored_stance(replace(plan, xs=in_air(jump, jump.x0, 0.4)[1]), jump, None) == []


@pytest.mark.parametrize(("seconds", "kept"), [(0.4, 100.0), (0.3, 75.0), (0.1, 25.0), (0.0, 0.0)])
def test_the_share_is_that_of_the_phase_s_time(jump, seconds, kept):
    t, xs = in_air(jump, jump.x0, seconds)
    assert kept_shares(jump.stances, jump.dynamics, t, xs) == pytest.approx([100.0, kept, 100.0], abs=3.0)  # a knot
    assert bool(missed_goal_message(jump, t, xs)) == (kept < BOUND)


def test_a_motion_that_is_not_finite_keeps_none(jump):
    t, xs = in_air(jump, jump.x0, 0.4)
    xs[-1] = np.nan
    assert kept_shares(jump.stances, jump.dynamics, t, xs) == [0.0, 0.0, 0.0]


def test_of_several_feet_that_stand_one_may_carry_nothing(jump):
    t, xs = in_air(jump, jump.x0, 0.4)
    both = [Stance("phase 1", ((0.0, 0.5),), ("shank", "none"), ()), Stance("phase 2", ((0.5, 0.9),), ("shank",), ())]
    assert kept_shares(both, jump.dynamics, t, xs) == pytest.approx([100.0, 0.0], abs=3.0)  # a knot


def test_turns_ask_each_foot_to_swing(jump):
    swings = [[(0.1, 0.2), (0.5, 0.6)], [(0.3, 0.4)]]
    assert stances_of_swings(["left", "right"], swings) == (
        Stance("swings of left", ((0.1, 0.2), (0.5, 0.6)), (), ("left",)),
        Stance("swings of right", ((0.3, 0.4),), (), ("right",)),
    )
    t, xs = in_air(jump, jump.x0, 0.0)
    asked = stances_of_swings(["shank"], [[(0.2, 0.4), (0.6, 0.8)]])
    assert kept_shares(asked, jump.dynamics, t, xs) == [0.0]
    assert least_kept(asked, jump.dynamics, t, xs) == (asked[0], 0.0)
