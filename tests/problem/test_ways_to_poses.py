"""Of the poses that reach a goal one is taken to which a path without collisions leads; and what is said of none."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from machines import gantry

import planner
from planner.problem.collision_free_path import MORE_SAMPLES, PATHS, CollisionChecker
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.costs.tracking import tracking_of
from planner.proof.diagnostics import suggested_fixes

# Two links of 0.5 m in a vertical plane, with a small box on the other side, so that there is something to avoid.
ARM = """<mujoco><option gravity="0 0 0"/><worldbody><geom name="box" type="box" size="0.05 0.05 0.05" pos="-0.8 0 0"/>
  <body><joint name="a" axis="0 1 0" range="-170 170"/><geom type="capsule" fromto="0.1 0 0 0.4 0 0" size="0.03"/>
    <body pos="0.5 0 0"><joint name="b" axis="0 1 0" range="-170 170"/>
      <geom type="capsule" fromto="0.1 0 0 0.5 0 0" size="0.03"/><site name="tip" pos="0.5 0 0"/></body></body>
  </worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
TOML = """model = "arm.xml"
start = { a = 0.2, b = 0.4 }
duration = 1.0
avoid = {}
[[goal]]
frame = "tip"
position = [0.6, 0.0, -0.3]
"""


@pytest.fixture
def elbow(tmp_path):
    """The elbow's angle in the goal's pose, rad."""
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    (tmp_path / "problem.toml").write_text(TOML, encoding="utf-8")

    def of():
        problem = planner.load_problem(tmp_path / "problem.toml")
        return tracking_of(problem.cost).x_ref[-1, 1]

    return of


def test_a_pose_with_a_way_is_preferred(elbow, monkeypatch):
    """The elbow stays on its side; where no way leads there, it goes to the other, as far from a straight arm."""
    near = elbow()
    assert near > 0.0
    own = CollisionChecker.find_path
    monkeypatch.setattr(
        CollisionChecker, "find_path", lambda self, a, b, *more, **named: None if b[1] > 0 else own(self, a, b)
    )
    assert elbow() == pytest.approx(-near, abs=2e-3)


def test_without_any_way_the_nearest_pose_stays_after_a_few_searches(elbow, monkeypatch):
    near, calls = elbow(), []
    monkeypatch.setattr(CollisionChecker, "find_path", lambda self, a, b, *more, **named: calls.append(named))
    assert elbow() == pytest.approx(near, abs=2e-3)
    of_poses = [named for named in calls if not named]
    assert PATHS <= len(of_poses) <= PATHS + 1  # one more for the first guess
    assert {"samples": MORE_SAMPLES} in calls


# A search that finds nothing takes 20 s.
@pytest.mark.parametrize("height", [0.3, pytest.param(3.0, marks=pytest.mark.slow)], ids=["low", "without an end"])
def test_a_wall_without_an_end_is_said(tmp_path, height):
    (tmp_path / "gantry.xml").write_text(gantry(wall=f'type="box" size="0.05 0.5 {height}"'), encoding="utf-8")
    lines = ('model = "gantry.xml"', 'start = "left"', 'goal = "right"', "duration = 2.0", "dt = 0.05", "avoid = {}")
    (tmp_path / "problem.toml").write_text("\n".join(lines), encoding="utf-8")
    problem = planner.load_problem(tmp_path / "problem.toml")
    plan = planner.solve(problem, options=planner.SolverOptions(homotopy=False))
    codes = [one.code for one in suggested_fixes(plan)]
    assert codes == (["no_way_around"] if height > 1.0 else [])


def test_checkers_of_other_offsets_or_clearances_search_for_themselves(tmp_path, monkeypatch):
    """They share a machine, whose paths are cached: else a plan would depend on what was searched before it."""
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    (tmp_path / "problem.toml").write_text(TOML, encoding="utf-8")
    problem = planner.load_problem(tmp_path / "problem.toml")
    apart, searched = pair_clearance_of(problem.constraints), []
    moved = replace(apart, pairs=tuple(pair._replace(distance_offset=0.01) for pair in apart.pairs))
    wider = replace(apart, more=np.full(len(apart.pairs), 0.01))
    monkeypatch.setattr(CollisionChecker, "_search", lambda self, *ends: searched.append(self) or np.zeros((2, 2)))
    checkers = [CollisionChecker(one, problem.dynamics.mechanism) for one in (apart, moved, wider, apart)]
    for checker in checkers:
        checker.find_path(np.zeros(2), np.ones(2), samples=8)
    assert searched == checkers[:3]


def test_the_way_to_a_pose_begins_where_the_machine_was(tmp_path, monkeypatch):
    """Not where the joints that have goals of their own at that time are to be."""
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    (tmp_path / "problem.toml").write_text(f"{TOML}[[goal]]\njoints = {{ b = 0.5 }}\n", encoding="utf-8")
    starts, own = [], CollisionChecker.violation_from
    monkeypatch.setattr(CollisionChecker, "violation_from", lambda self, q: starts.append(q) or own(self, q))
    with contextlib.suppress(planner.PlannerError):  # whether this place is reached does not matter
        planner.load_problem(tmp_path / "problem.toml")
    np.testing.assert_array_equal(starts[0], [0.2, 0.4])


def test_more_clearance_is_not_tried_where_the_required_one_finds_nothing(tmp_path, monkeypatch):
    """So that a plan does not depend on what was searched before it."""
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    (tmp_path / "problem.toml").write_text(TOML, encoding="utf-8")
    problem = planner.load_problem(tmp_path / "problem.toml")
    apart = pair_clearance_of(problem.constraints)
    wider = replace(apart, more=np.full(len(apart.pairs), 0.1))
    searched = []
    monkeypatch.setattr(CollisionChecker, "_search", lambda self, *ends: searched.append(self._lower.max()))
    checker = CollisionChecker(wider, problem.dynamics.mechanism)
    assert checker.find_path(np.zeros(2), np.ones(2), samples=7) is None
    assert searched == [apart.lower.max()]


# A ball of 0.1 m between two boxes that are 0.11 m apart: 0.005 m on both sides.
GAP = """<mujoco><option gravity="0 0 0"/><worldbody><geom name="up" type="box" size="0.05 1 0.2" pos="0 1.055 0"/>
  <geom name="down" type="box" size="0.05 1 0.2" pos="0 -1.055 0"/><body><joint name="x" type="slide" range="-1 1"
  axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0" range="-1 1"/><geom name="ball" size="0.05" mass="1"/></body>
  </worldbody><actuator><motor joint="x"/><motor joint="y"/></actuator></mujoco>"""


def test_a_gap_that_the_clearance_closes_has_no_way_through(tmp_path, monkeypatch):
    own = CollisionChecker._search
    monkeypatch.setattr(CollisionChecker, "_search", lambda self, *ends: own(self, *ends[:3], min(20, ends[3])))
    (tmp_path / "gap.xml").write_text(GAP, encoding="utf-8")
    lines = ('model = "gap.xml"', "start = { x = -0.6 }", "goal = { x = 0.6, y = 0 }", "duration = 2.0", "dt = 0.05")
    (tmp_path / "problem.toml").write_text("\n".join([*lines, "avoid = { self = false }"]))
    problem = planner.load_problem(tmp_path / "problem.toml")
    plan = planner.solve(problem, options=planner.SolverOptions(homotopy=False))
    assert [one.code for one in suggested_fixes(plan)] == ["no_way_around"]


def test_no_way_is_only_said_where_neither_search_finds_one(monkeypatch):
    """The two spread their samples differently: one may find what the other does not."""
    checker, path = object.__new__(CollisionChecker), np.zeros((2, 2))
    for first, second in ((path, None), (None, path), (None, None)):
        found = {False: first, True: second}
        monkeypatch.setattr(CollisionChecker, "find_path", lambda self, a, b, found=found, **more: found[bool(more)])
        assert (checker.seek_path(path[0], path[1]) is None) == (first is None and second is None)
