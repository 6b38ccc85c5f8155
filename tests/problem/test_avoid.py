"""What a plan keeps apart: a wall on the straight way, what is between knots, and what is wrong."""

import re

import numpy as np
import pytest
from machines import gantry
from places import ROOT

import planner
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.cases.problem_file.tasks import resolved_defaults
from planner.problem.collision_free_path import CollisionChecker, rrt_connect
from planner.problem.constraints.clearance import Avoid, PairClearance, pair_clearance_of
from planner.problem.problem import Problem

TOML = """model = "gantry.xml"
start = "left"
goal = "right"
duration = 2.0
dt = 0.05
"""
AVOID = "[avoid]\nclearance = 0.03\n"


@pytest.fixture
def problem_of(tmp_path):
    def load(more="", **scene):
        (tmp_path / "gantry.xml").write_text(gantry(**scene))
        (tmp_path / "problem.toml").write_text(TOML + more)
        return planner.load_problem(tmp_path / "problem.toml")

    return load


def distances(problem, plan, parts=8):
    apart = pair_clearance_of(problem.constraints)
    measure = apart.residual_function(problem.dynamics, problem.N)
    return measure._distances.values(plan.between_knots(parts)[:, :2])


def test_a_plan_goes_around_a_wall_that_it_would_go_through(problem_of):
    through = planner.solve(problem_of("contacts = 'avoid'\n"))
    proof = planner.prove(through, rollouts=0)
    assert not proof.passed
    assert "geom 'wall' and geom 'tool' touch" in proof.reason
    around = planner.solve(problem_of(AVOID))
    assert around.success
    assert planner.prove(around, rollouts=0).passed
    problem = around.problem
    assert problem.constraints[0].name == "clearance"
    least = pair_clearance_of(problem.constraints).lower
    assert distances(problem, around).min() > least.min() - problem.constraints[0].tolerance - 1e-9
    assert around.xs[:, 1].max() > 0.38  # over the wall of 0.3, with the tool of 0.05 and the clearance


def test_a_stored_plan_knows_what_it_keeps_apart(problem_of, tmp_path):
    plan = planner.solve(problem_of(AVOID), max_iterations=3)
    again = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert again.problem.parameters["avoid"] == {"clearance": 0.03}
    one, other = (pair_clearance_of(p.constraints) for p in (plan.problem, again.problem))
    np.testing.assert_array_equal(one.lower, other.lower)
    assert plan.problem.parameters["resolved"]["reasons"]["avoid"] == "1 pair of shapes are kept 0.03 m apart."


def test_what_is_kept_apart_at_knots_is_kept_apart_between_them(problem_of, monkeypatch):
    """A thin wall above which the tool is fast: the corner that it goes over lies between two knots."""
    scene = {"wall": 'type="box" size="0.01 0.5 0.45"', "tool": 'type="sphere" size="0.02"'}
    text = TOML.replace("duration = 2.0", "duration = 1.5")

    def nearest(**options):
        problem = problem_of(AVOID, **scene)
        plan = planner.solve(problem, options=planner.SolverOptions(**options))
        return distances(problem, plan, 16).min() - pair_clearance_of(problem.constraints).lower.min()

    monkeypatch.setitem(globals(), "TOML", text)
    assert nearest() > -0.0006 - 1e-6  # the tolerance, 2 % of the clearance
    assert nearest(max_tightenings=0) < -0.001


def test_what_passes_a_thin_thing_between_two_knots_is_seen(problem_of):
    problem = problem_of(AVOID, wall='type="box" size="0.002 0.5 0.3"', tool='type="sphere" size="0.02"')
    measure = pair_clearance_of(problem.constraints).residual_function(problem.dynamics, problem.N)
    xs = np.zeros((problem.N + 1, 4))
    xs[:, 0], xs[:, 2] = np.where(np.arange(problem.N + 1) < 20, -0.2, 0.2), 8.0  # 0.4 m in a stage of 0.05 s
    assert measure.values(xs, problem.first_guess, None).min() > 0.1
    short = measure.clearance_violation(problem.dynamics, xs, np.zeros((problem.N, 2)))
    assert short[19].max() > 0.02  # it was in the wall, or may have been
    assert short[5].max() < 0.0 or xs[5, 2] > 0.0  # others drift, since the states are no rollout


def test_python_says_the_same():
    machine = planner.Mechanism.from_mjcf(gantry(), contacts="avoid")
    dynamics = planner.RigidBodyDynamics(machine, 0.05)
    start, goal = machine.keyframe("left"), machine.keyframe("right")
    kept, notes = Avoid(clearance=0.03).constraint(machine, start, goal)
    assert notes[0] == "1 pair of shapes are kept 0.03 m apart."
    assert isinstance(kept.of, PairClearance)
    problem = Problem(dynamics, planner.costs.default_cost(dynamics, start, goal, 40), start, constraints=[kept])
    assert problem.trajectory_constraints.initial_penalties() is not None
    way = CollisionChecker(kept.of, machine).find_path(start[:2], goal[:2])
    np.testing.assert_allclose(way[[0, -1]], [start[:2], goal[:2]], rtol=0, atol=1e-12)
    assert way[:, 1].max() > 0.38


def test_a_way_that_is_free_is_straight():
    start, goal = np.zeros(3), np.ones(3)
    way = rrt_connect(lambda q: np.ones(len(q), dtype=bool), start, goal, -np.ones(3), 2.0 * np.ones(3))
    np.testing.assert_allclose(way, np.linspace(0.0, 1.0, len(way))[:, None] * np.ones(3), atol=1e-12)
    blocked = rrt_connect(lambda q: np.abs(q[:, 0] - 0.5) > 0.1, start, goal, -np.ones(3), 2.0 * np.ones(3))
    assert blocked is None  # a wall without an end


@pytest.mark.parametrize(
    ("more", "scene", "expected"),
    [
        ("[avoid]\nclearence = 0.1\n", {}, "[avoid] of "),
        ("[avoid]\nclearance = -0.1\n", {}, "clearance of avoid is -0.1, expected a finite number greater than 0."),
        ("[avoid]\nself = 1\n", {}, "self of avoid is 1, expected true or false."),
        ("[avoid]\nself = false\nworld = false\n", {}, "self and world of avoid are false, expected one of them true."),
        ("[avoid]\nextra_clearance = 1\n", {}, "extra_clearance of avoid is 1, expected a table of m by the names "
                                               "of pairs."),
        (AVOID, {"wall": 'type="box" size="0.5 0.5 0.3"'},
         "the start is in collision: geom 'wall' and geom 'tool' overlap by 0.05 m, expected a pose where nothing"),
        (AVOID, {"wall": 'type="box" size="0.44 0.5 0.3"'},
         "the start has geom 'wall' and geom 'tool' 0.01 m apart, expected at least the clearance 0.03 m: write "
         "clearance = 0.008 in [avoid], or move one of the two."),
        (AVOID, {"wall": 'type="box" size="0.05 0.5 0.3" contype="0" conaffinity="0"'},
         "avoid has nothing to keep apart: no shapes of the model can touch; leave it out."),
        (AVOID, {"others": '<geom name="box" type="box" size=".1 .1 .1" pos=".5 0 .1"/>'},
         "the goal is in collision: geom 'box' and geom 'tool' overlap by 0.15 m"),
    ],
)  # fmt: skip
def test_mistakes_are_one_sentence(problem_of, more, scene, expected):
    with pytest.raises(PlannerError) as error:
        problem_of(more, **scene)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_touch_is_answered_with_clearance(problem_of):
    """A fit that says it is further away than it is, as one that overlaps at the start may: MuJoCo sees the touch."""
    from dataclasses import replace

    from planner.proof.repair.clearance import refine_clearance, with_clearance

    problem = problem_of(AVOID)
    one = problem.constraints[0]
    lying = replace(one.of, pairs=tuple(pair._replace(distance_offset=0.035) for pair in one.of.pairs))
    plan = planner.solve(replace(problem, constraints=[replace(one, of=lying)]))
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    wider = refine_clearance(plan, proof)
    assert wider.proof.passed
    assert len(wider.notes) == 1
    assert wider.notes[0].startswith("geom 'tool' and geom 'wall' touch and are kept ")
    assert refine_clearance(wider.plan, wider.proof).notes == ()
    name = problem.constraints[0].of.pairs[0].names
    again = with_clearance(with_clearance(problem, {name: 0.01}), {name: 0.02})  # of a file: its table says so
    assert again.parameters["avoid"]["extra_clearance"] == pytest.approx({name: 0.03})
    assert pair_clearance_of(again.constraints).lower[0] == pytest.approx(0.06)


def test_what_is_printed_of_avoid_is_one_sentence_and_the_report_has_the_names():
    asked = load(ROOT / "examples" / "tasks" / "around_a_post.toml")
    (told,) = [note for note in asked.notes if "apart" in note]
    assert told == "48 pairs of shapes are kept 0.02 m apart; the report names them."
    details = resolved_defaults(asked.problem.parameters)["avoid, details"]
    assert "no pose brings the shapes nearer, though their fits overlap: geom 'link1' and geom 'base'" in details


# What stands for a cylinder as wide as high is a ball, 4 cm larger than its side.
DRUM = 'type="cylinder" size="0.1 0.1"'


def test_a_goal_at_which_only_fits_overlap_is_no_collision(problem_of):
    machine = planner.Mechanism.from_mjcf(gantry(tool=DRUM), contacts="avoid")
    goal = planner.Goal(joints={"x": -0.19, "z": 0.1})  # its side is 4 cm from the wall, its ball in it
    problem = planner.task(machine, "left", [goal], duration=2.0, dt=0.05, avoid={"clearance": 0.03})
    details = problem.parameters["resolved"]["reasons"]["avoid, details"]
    assert "Fits overlap at the start or goal where shapes do not" in details
    plan = planner.solve(problem)
    assert plan.success
    assert planner.prove(plan, rollouts=0).passed
    with pytest.raises(PlannerError, match=r"goal 1 \(joints\) is in collision: geom 'wall' and geom 'tool' overlap"):
        planner.task(machine, "left", [planner.Goal(joints={"x": -0.14})], duration=2.0, avoid={"clearance": 0.03})


def test_fits_that_no_plan_keeps_apart_may_come_nearer_where_the_shapes_are_far(problem_of):
    """A drum that passes below a beam, with room for it, and not for the ball that stands for it."""
    from planner.proof.repair.clearance import refine_clearance

    more = "[avoid]\nclearance = 0.02\n[limits.position]\nz = [0.08, 0.12]\n"
    beam = 'type="box" size="0.05 0.5 2" pos="0 0 2.23"'
    plan = planner.solve(problem_of(more, tool=DRUM, wall=beam), max_iterations=100)
    proof = planner.prove(plan, rollouts=0)
    assert "clearance violation" in proof.reason
    wider = refine_clearance(plan, proof)
    assert wider.proof.passed
    assert re.search(r"the fits of geom 'tool' and geom 'wall' may come [\d.]+ cm nearer", wider.notes[0])
