"""Problem files of machines with closed chains: the examples, what is said of starts, grips that are kept."""

import re
from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

import planner
from planner import Mechanism, PlannerError
from planner.cases.problem_file import load
from planner.constraints import ChainForce, Constraint
from planner.dynamics import constraint_forces, loops
from planner.dynamics.quasi_static import quasi_static_controls
from planner.problem.goals import goals_of

FOLDER = ROOT / "examples" / "closed_chains"


def files(slow=()):
    """The files, of which some take long: the poses of the platform's goal alone take 8 s."""
    marks = dict.fromkeys(slow, pytest.mark.slow)
    return [pytest.param(path, id=path.stem, marks=marks.get(path.stem, ())) for path in sorted(FOLDER.glob("*.toml"))]


@pytest.mark.parametrize("dt", [pytest.param(0.01, marks=pytest.mark.slow), 0.02])
@pytest.mark.parametrize("path", files(slow=["stewart"]))
def test_it_converges_and_meets_every_goal(path, dt):
    plan = planner.solve(load(path, dt=dt).problem)
    assert plan.success
    assert plan.nit < 250  # of a guess that only holds the start: 315 for the platform
    for one in goals_of(plan.problem, plan.xs):
        assert one.miss(plan.t, plan.xs) <= 0.5 * one.tolerance, one.name
    m = plan.problem.dynamics.mechanism
    assert max(np.abs(loops.misses(m, x[: m.nq])).max() for x in plan.xs) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("path", files())
def test_it_passes(path):
    proof = planner.prove(planner.solve(load(path).problem), rollouts=0)
    assert proof.passed, proof.reason


def test_neither_arm_holds_the_bar_alone():
    """At the goal both arms hold it within the limits of their motors, and one arm with the bar on it does not."""
    m = Mechanism.from_mjcf((FOLDER / "two_arms.xml").read_text(encoding="utf-8"))
    goal = load(FOLDER / "two_arms.toml").problem.cost.x_ref[-1]
    most = m.actuators.control_range[:, 1]
    assert np.all(np.abs(quasi_static_controls(m, goal)) < 0.9 * most)
    assert np.abs(quasi_static_controls(replace(m, loops=()), goal)[0]) > 1.2 * most[0]


def four_bar(folder, **changed):
    """The four-bar's file with other keys, beside its model."""
    (folder / "four_bar.xml").write_text((FOLDER / "four_bar.xml").read_text(encoding="utf-8"), encoding="utf-8")
    keys = {"model": '"four_bar.xml"', "start": "{ crank = -1.2 }", "goal": "{ crank = 0.0 }", "duration": "1.0"}
    text = "\n".join(f"{key} = {value}" for key, value in (keys | changed).items() if key != "more")
    path = folder / "problem.toml"
    path.write_text(f"{text}\n{changed.get('more', '')}", encoding="utf-8")
    return path


def test_a_start_at_a_stop_is_put_off_it_with_the_chain_closed(tmp_path):
    path = four_bar(tmp_path)
    model = tmp_path / "four_bar.xml"
    text = model.read_text(encoding="utf-8")
    assert '<joint name="crank"' in text
    model.write_text(
        text.replace('<joint name="crank"', '<joint name="crank" range="-68.75493541569878 170"'), encoding="utf-8"
    )
    problem = load(path).problem
    m = problem.dynamics.mechanism
    assert problem.x0[0] > -1.2
    assert np.abs(loops.misses(m, problem.x0[: m.nq])).max() < 1e-12


def test_a_goal_is_reached_the_way_the_start_is_put_together():
    """In small steps of the crank: the rocker swings to and fro, and the coupler never turns over."""
    problem = load(FOLDER / "four_bar.toml").problem
    crank, coupler, rocker = problem.cost.x_ref[-1][:3] - problem.x0[:3]
    assert crank == pytest.approx(3.2, abs=1e-12)
    assert abs(crank + coupler) < 1.0
    assert abs(rocker) < 1.0


def test_a_start_that_is_moved_is_told_and_one_that_cannot_close_is_refused(tmp_path):
    given = load(four_bar(tmp_path)).problem.x0
    off = [given[0], given[1] + 0.01, given[2]]
    (note,) = (one for one in load(four_bar(tmp_path, start=str([float(x) for x in off]))).notes if "chains" in one)
    assert re.fullmatch(r"start is moved so that its chains close, \w+ by -?0\.00\d+ rad\.", note)
    with pytest.raises(PlannerError, match=r"goal misses equality 'pin' by 0\.\d+ m, and no motion"):
        load(four_bar(tmp_path, goal="{ crank = 0.0, rocker = 2.5 }"))


def test_a_pin_is_loaded_no_more_than_it_may_be(tmp_path):
    """The largest force of the plan without the constraint is more than what the file then allows."""
    short = {"dt": 0.05, "duration": 0.75}  # a force is differentiated in Python, stage by stage
    free = planner.solve(load(four_bar(tmp_path, **short)).problem)
    dynamics = free.problem.dynamics
    largest = np.linalg.norm(constraint_forces(dynamics, free.xs[:-1], free.us), axis=1).max()
    most = 0.9 * largest
    path = four_bar(tmp_path, **short, more=f'[[constraint]]\nchain = "pin"\nupper = {most}\n')
    plan = planner.solve(load(path).problem)
    assert plan.success
    assert np.linalg.norm(constraint_forces(dynamics, plan.xs[:-1], plan.us), axis=1).max() <= most * (1.0 + 1e-3)


def test_a_force_of_a_chain_that_is_none_is_refused():
    problem = load(ROOT / "examples" / "crane.toml").problem
    with pytest.raises(PlannerError, match="force of pin needs a closed chain"):
        planner.solve(replace(problem, constraints=[Constraint(ChainForce("pin"), upper=1.0)]))
