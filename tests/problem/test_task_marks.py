"""What pictures are told of a task: places and numbers of goals, paths, and what is missed over time."""

import numpy as np
import pytest
from arms import START, hand, mechanism
from rolled_out_plans import rolled_out
from scipy.spatial.transform import Rotation

import planner
from planner.dynamics.inverse_kinematics import Target, residuals
from planner.problem.appearance import Appearance
from planner.problem.constraints.quantities import FramePositionAlong
from planner.problem.default_appearance import MAX_CURVES, task_panels, with_marks
from planner.problem.tasks.cost import _frame_error

N, DT = 40, 0.02
PLACE = hand(0.9, -0.4)


def problem_of(goals):
    return planner.task(mechanism(), start=START, goals=goals, duration=N * DT, dt=DT)


@pytest.fixture(scope="module")
def problem():
    return problem_of([planner.Goal(frame="hand", position=(PLACE[0], 0.0, PLACE[1]), time=0.4, through=True),
                       planner.Goal(joints={"elbow": -0.2})])  # fmt: skip


def test_goals_are_marks_at_their_places():
    seen = problem_of(
        [planner.Goal(frame="hand", position=(PLACE[0], 0.0, PLACE[1]), time=0.4, through=True),
         planner.Goal(frame="hand", orientation={"pitch": -30}, time=0.6, tolerance=0.1),
         planner.Goal(frame="lower", pointing={"axis": "x", "to": (2, 0, 0)})]
    ).appearance  # fmt: skip
    assert seen.trail == seen.frames == ("hand", "lower")
    place, turned, pointing = seen.goals
    assert (place.position, place.time, place.number) == ((PLACE[0], 0.0, PLACE[1]), 0.4, "1")
    assert place.orientation is None
    assert place.direction is None
    # a turn by -30 degrees about y takes x to (cos, 0, sin)
    np.testing.assert_allclose(turned.orientation[:, 0], [np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6)], atol=1e-12)
    assert turned.position is None
    assert turned.number == "2"
    assert pointing.direction == (1.0, 0.0, 0.0)  # of length 1
    assert (pointing.frame, pointing.time, pointing.number) == ("lower", N * DT, "3")


def test_goals_at_one_time_have_no_numbers():
    goals = [planner.Goal(frame="hand", position=(PLACE[0], 0.0, PLACE[1])), planner.Goal(joints={"elbow": -0.4})]
    assert [one.number for one in problem_of(goals).appearance.goals] == [""]


def test_paths_are_lines_and_long_ones_have_few_pieces():
    def line(rows):
        follow = planner.Follow(frame="hand", points=rows, tolerance=0.05)
        return planner.task(mechanism(), start=START, follow=[follow], duration=N * DT, dt=DT).appearance.paths

    t = np.linspace(0.2, N * DT, 200)
    way = np.array([[hand(*pose)[0], 0.0, hand(*pose)[1]] for pose in np.linspace([0.5, -1.0], [0.9, -0.4], 200)])
    (corners,), (many,) = line(np.column_stack([t, way])[[0, 100, 199]]), line(np.column_stack([t, way]))
    np.testing.assert_allclose(corners, way[[0, 100, 199]], atol=1e-12)
    assert len(many) == 65  # points of 64 pieces
    np.testing.assert_allclose(many[[0, -1]], way[[0, -1]], atol=1e-12)


def test_a_machine_without_a_task_is_shown_as_before():
    appearance = Appearance(title="plain")
    assert with_marks(appearance, None) is appearance
    power = planner.Constraint(lambda xs: xs[:, 0], upper=1.0)
    assert with_marks(appearance, None, [power]) is appearance
    kept = with_marks(appearance, None, [planner.Constraint(FramePositionAlong("hand"), upper=1.0)])
    assert (kept.trail, kept.frames, kept.goals, kept.paths) == (("hand",), ("hand",), (), ())


def test_misses_of_all_states_at_once_are_those_of_inverse_kinematics():
    """The slow twin is one state at a time; rounding of a few lengths of 1."""
    machine = mechanism()
    xs = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 4))
    quaternion = Rotation.from_rotvec([0.3, -0.8, 0.1]).as_quat()[[3, 0, 1, 2]]
    pointing = (np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8]))
    for target in (
        Target("hand", position=np.array([0.1, 0.2, 0.3])), Target("hand", orientation=quaternion),
        Target("hand", pointing=pointing),
    ):  # fmt: skip
        slow = np.array([np.linalg.norm(residuals(machine, x[:2], target)[0]) for x in xs])
        slow = slow if target.pointing is None else 2.0 * np.arcsin(0.5 * slow)
        np.testing.assert_allclose(_frame_error(machine, target, xs), slow, rtol=1e-10, atol=1e-12)
    xs[3] = np.nan
    assert np.isinf(_frame_error(machine, Target("hand", position=np.zeros(3)), xs)[3])


def test_misses_over_time_have_their_tolerance_at_their_time(problem):
    plan = rolled_out(problem)
    elsewhere = plan.xs + 0.1
    panels = task_panels(problem, plan.t, [(plan.xs, plan.us), (elsewhere, plan.us)])
    assert [(one.title, one.ylabel) for one in panels] == [
        ("Goals: position of hand at 0.4 s", "miss, m"), ("Goals: elbow", "miss, rad")
    ]  # fmt: skip
    miss, joint = panels
    for moved, xs in zip(miss.motions, (plan.xs, elsewhere), strict=True):
        away = [np.linalg.norm(hand(*x[:2]) - PLACE) for x in xs]
        np.testing.assert_allclose(moved[:, 0], away, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(miss.upper[:, 0])), [20])  # 0.4 s
    assert miss.upper[20, 0] == 5e-3  # docs/tasks.md
    np.testing.assert_allclose(joint.motions[0][:, 0], np.abs(plan.xs[:, 1] + 0.2), atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(joint.upper[:, 0])), [N])


def test_goals_that_are_one_curve_share_it():
    goal = {"frame": "hand", "position": (PLACE[0], 0.0, PLACE[1])}
    asked = problem_of([planner.Goal(**goal, time=0.4), planner.Goal(**goal, time=0.6)])
    plan = rolled_out(asked)
    position, speed = task_panels(asked, plan.t, [(plan.xs, plan.us)])
    for panel, title in ((position, "Goals: position of hand"), (speed, "Goals: speed of hand")):
        assert panel.title == title
        np.testing.assert_array_equal(np.argwhere(np.isfinite(panel.upper)), [[20, 0], [30, 0]])


def test_a_path_is_missed_while_it_lasts():
    points = [[0.2, *_place(0.6, -0.9)], [0.6, *_place(0.7, -0.7)]]
    follow = planner.Follow(frame="hand", points=points, tolerance=0.05)
    asked = planner.task(mechanism(), start=START, follow=[follow], duration=N * DT, dt=DT)
    plan = rolled_out(asked)
    (panel,) = task_panels(asked, plan.t, [(plan.xs, plan.us)])
    for known in (np.isfinite(panel.motions[0][:, 0]), panel.upper[:, 0] == 0.05):
        np.testing.assert_array_equal(np.flatnonzero(known), np.arange(10, 31))
    misses = []
    for part in np.linspace(-0.5, 0.5, 11):  # of a stage, where the path is judged that is shown at this knot
        near, share = plan.xs[20 + int(np.sign(part))], abs(part)
        q = (1.0 - share) * plan.xs[20, :2] + share * near[:2]
        along = (20 + part - 10) / 20
        misses.append(
            np.linalg.norm(_place(*q) - ((1 - along) * np.array(points[0]) + along * np.array(points[1]))[1:])
        )
    assert panel.motions[0][20, 0] == pytest.approx(max(misses))


def test_constraints_over_time_beside_their_bounds(problem):
    height = planner.Constraint(FramePositionAlong("hand"), lower=-2.0, upper=2.0, when=(0.1, 0.3), name="height")
    power = planner.Constraint(lambda xs, us: us[:, 0] * xs[:, 2], upper=500.0, name="power", unit="W")
    kept = planner.Problem(problem.dynamics, problem.cost, problem.x0, us=problem.us, constraints=[height, power])
    plan = rolled_out(kept)
    ran_away = plan.xs.copy()
    ran_away[30:] = np.nan
    first, second = task_panels(kept, plan.t, [(plan.xs, plan.us), (ran_away, plan.us)])
    assert (first.title, first.ylabel, first.names) == ("Constraint: height", "m", ("height",))
    np.testing.assert_allclose(first.motions[0][:, 0], [hand(*x[:2])[1] for x in plan.xs], atol=1e-12)
    np.testing.assert_array_equal(np.isfinite(first.motions[1][:, 0]), np.arange(N + 1) < 30)
    np.testing.assert_allclose(first.upper[5:16, 0], 2.0)
    np.testing.assert_allclose(first.lower[5:16, 0], -2.0)
    assert not np.isfinite(np.delete(first.upper[:, 0], np.arange(5, 16))).any()
    assert (second.title, second.ylabel) == ("Constraint: power", "W")
    last = np.append(plan.us, plan.us[-1:], axis=0)  # held to the end
    np.testing.assert_allclose(second.motions[0][:, 0], last[:, 0] * plan.xs[:, 2], atol=1e-12)
    np.testing.assert_allclose(second.upper[:, 0], 500.0)


def test_of_many_rows_the_nearest_are_shown():
    """By the protocol of what is kept apart: named rows, and values for pictures that the solver does not need."""

    class Distances:
        unit = "m"
        names = tuple(f"pair {k}" for k in range(12))

        def __str__(self):
            return "clearance"

        def residual_function(self, dynamics, N):
            return self

        rows, of_controls, same = 12, False, "distances"

        def values(self, xs, us, n):
            return np.minimum(self.shown(xs, us, n), 0.2)

        def shown(self, xs, us, n):
            return 0.1 + 0.05 * np.arange(12)[::-1] + 0.0 * xs[:, :1]

    base = problem_of([planner.Goal(joints={"elbow": -0.2})])
    apart = planner.Constraint(Distances(), lower=np.full(12, 0.02), name="clearance")
    kept = planner.Problem(base.dynamics, base.cost, base.x0, us=base.us, constraints=[apart])
    plan = rolled_out(kept)
    (panel,) = task_panels(kept, plan.t, [(plan.xs, plan.us)])
    assert panel.title == f"Constraint: clearance, the {MAX_CURVES} nearest to their bound of 12"
    assert panel.names == tuple(f"pair {k}" for k in range(4, 12))
    np.testing.assert_allclose(panel.motions[0][0], 0.1 + 0.05 * np.arange(8)[::-1])
    np.testing.assert_allclose(panel.lower, 0.02)
    assert panel.decades


def _place(shoulder, elbow):
    x, z = hand(shoulder, elbow)
    return x, 0.0, z
