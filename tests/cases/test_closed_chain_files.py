"""Problem files of machines with closed chains: the examples, what is said of starts, grips that are kept."""

import re
from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

import planner
from planner import PlannerError
from planner.cases.problem_file import load
from planner.constraints import ChainForce, Constraint
from planner.dynamics import constraint_forces, loops
from planner.problem.goals import goals_of

FOLDER = ROOT / "examples" / "closed_chains"
SLOW = "stewart"  # a minute


def files():
    return [
        pytest.param(path, id=path.stem, marks=pytest.mark.slow if path.stem == SLOW else ())
        for path in sorted(FOLDER.glob("*.toml"))
    ]


@pytest.mark.parametrize("path", files())
def test_it_converges_and_meets_every_goal(path):
    plan = planner.solve(load(path).problem)
    assert plan.success
    for one in goals_of(plan.problem, plan.xs):
        assert one.miss(plan.t, plan.xs) <= 0.5 * one.tolerance, one.name
    m = plan.problem.dynamics.mechanism
    assert max(np.abs(loops.misses(m, x[: m.nq])).max() for x in plan.xs) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("path", files())
def test_it_passes(path):
    proof = planner.prove(planner.solve(load(path).problem), rollouts=0)
    assert proof.passed, proof.reason


def test_neither_arm_swings_the_bar_up_alone(tmp_path):
    """The same task without the pin on the right: the bar hangs on one arm, whose motors do not get it there."""
    model = (FOLDER / "two_arms.xml").read_text(encoding="utf-8")
    (tmp_path / "two_arms.xml").write_text(re.sub("<equality>.*</equality>", "", model, flags=re.S), encoding="utf-8")
    text = (FOLDER / "two_arms.toml").read_text(encoding="utf-8").replace("right-elbow = 0.4", "grip = -3.3")
    (tmp_path / "one_arm.toml").write_text(text.replace("right-shoulder = 2.9, ", ""), encoding="utf-8")
    plan = planner.solve(load(tmp_path / "one_arm.toml").problem)
    missed = [one for one in goals_of(plan.problem, plan.xs) if one.miss(plan.t, plan.xs) > one.tolerance]
    assert missed


def four_bar(folder, **changed):
    """The four-bar's file with other keys, beside its model."""
    (folder / "four_bar.xml").write_text((FOLDER / "four_bar.xml").read_text(encoding="utf-8"), encoding="utf-8")
    keys = {"model": '"four_bar.xml"', "start": "{ crank = -1.2 }", "goal": "{ crank = 0.0 }", "duration": "1.0"}
    text = "\n".join(f"{key} = {value}" for key, value in (keys | changed).items() if key != "more")
    path = folder / "problem.toml"
    path.write_text(f"{text}\n{changed.get('more', '')}", encoding="utf-8")
    return path


def test_a_goal_is_reached_the_way_the_start_is_put_together():
    """In small steps of the crank: the rocker swings to and fro, and the coupler never turns over."""
    problem = load(FOLDER / "four_bar.toml").problem
    crank, coupler, rocker = problem.cost.x_ref[-1][:3] - problem.x0[:3]
    assert crank == pytest.approx(3.2, abs=1e-12)
    assert abs(crank + coupler) < 1.0
    assert abs(rocker) < 1.0


def test_a_start_that_is_moved_is_told_and_one_that_cannot_close_is_refused(tmp_path):
    given = load(four_bar(tmp_path)).problem.x0
    off = (given[:3] + [0.0, 0.01, 0.0]).tolist()
    (note,) = (one for one in load(four_bar(tmp_path, start=str(off))).notes if "chains" in one)
    assert re.fullmatch(r"start is moved so that its chains close, \w+ by -?0\.00\d+ rad\.", note)
    with pytest.raises(PlannerError, match=r"goal misses equality 'pin' by 0\.\d+ m, and no motion"):
        load(four_bar(tmp_path, goal="{ crank = 0.0, rocker = 2.5 }"))


def test_a_pin_is_loaded_no_more_than_it_may_be(tmp_path):
    """The largest force of the plan without the constraint is more than what the file then allows."""
    free = planner.solve(load(four_bar(tmp_path)).problem)
    dynamics = free.problem.dynamics
    largest = np.linalg.norm(constraint_forces(dynamics, free.xs[:-1], free.us), axis=1).max()
    most = 0.9 * largest
    path = four_bar(tmp_path, more=f'[[constraint]]\nchain = "pin"\nmost = {most}\n')
    plan = planner.solve(load(path).problem)
    assert plan.success
    assert np.linalg.norm(constraint_forces(dynamics, plan.xs[:-1], plan.us), axis=1).max() <= most * (1.0 + 1e-3)


def test_a_force_of_a_chain_that_is_none_is_refused():
    problem = load(ROOT / "examples" / "crane.toml").problem
    with pytest.raises(PlannerError, match="force of pin is that of a closed chain"):
        planner.solve(replace(problem, constraints=[Constraint(ChainForce("pin"), most=1.0)]))
