"""Goals and paths that cannot be meant: one sentence each, with what to write instead."""

import pytest
from arms import hand, refuse, write
from commands import refused, run
from places import ROOT

import planner

GOAL = '[[goal]]\nframe = "hand"\nposition = [0.3, 0.0, -0.2]\n'


def goals(*tables):
    return "\n".join("[[goal]]\n" + "\n".join(f"{key} = {value}" for key, value in one.items()) for one in tables)


def at(position, **more):
    return {"frame": '"hand"', "position": position} | more


@pytest.mark.parametrize(
    ("tables", "fragments"),
    [
        ([at("[0.9, 0.0, 0.0]")], ("goal 1 (hand) is out of reach by 0.2 m", "nearest point is [0.7, 0, ", "ranges")),
        ([at("[0.3, 0.2, -0.2]")], ("by 0.2 m", "positions are in m", "nearest point is [0.3, 0, -0.2]")),
        ([at("[0.3, 0.0, -0.2]", pointing="[0, 1, 0]")], ("out of reach", "not with that orientation", "rad")),
        (
            [at("[0.3, 0, -0.2]", frame='"hnad"')],
            ("frame is 'hnad'", "hand, world, upper, lower", "Did you mean 'hand'"),
        ),
        ([at("[0.3, 0, -0.2]", time="1.5")], ("goal 1 (hand at 1.5 s)", "after the end", "duration of 1 s")),
        ([at("[0.3, 0, -0.2]", time="-1")], ("time of a goal is -1", "greater than 0")),
        (
            [at("[0.3, 0, -0.2]", time="0.6"), at("[0.3, 0, 0]", time="0.4")],
            ("goal 2 (hand at 0.4 s)", "before the one above it, which is at 0.6 s", "order"),
        ),
        (
            [at("[0.3, 0, -0.2]"), at("[0.3, 0, 0]", time="0.4")],
            ("goal 2", "without a time, which are at the end, last"),
        ),
        (
            [at("[0.3, 0, -0.2]"), at("[0.4, 0, -0.2]")],
            ("goal 1 (hand) and goal 2 (hand) contradict each other at 1 s", "another time"),
        ),
        (
            [{"joints": "{ elbow = 1.0 }"}, {"joints": "{ elbow = 1.2 }"}],
            ("goal 2 (joints) contradicts", "joint 'elbow' is at 1 and 1.2"),
        ),
        (
            [{"joints": "{ shoulder = 0.0, elbow = 0.0 }"}, at("[0.3, 0, -0.2]")],
            ("goal 2 (hand)", "goal 1 (joints) contradict each other"),
        ),
        ([at("[0.3, 0.0]")], ("goal 1: position of a goal is [0.3, 0.0], expected 3 numbers, e.g. [0.0, 0.0, 0.0]",)),
        ([at("[0.3, 0, nan]")], ("position of a goal[2] is nan",)),
        ([{"frame": '"hand"'}], ("goal of 'hand' asks for nothing", "position, orientation or pointing")),
        ([{"position": "[0, 0, 0]"}], ("neither frame nor joints",)),
        ([{"frame": '"hand"', "joints": "{ elbow = 1 }"}], ("or both",)),
        ([at("[0.3, 0, 0]", pointing="[0, 0, 1]", orientation="[1, 0, 0, 0]")], ("orientation and pointing",)),
        ([at("[0.3, 0, 0]", orientation="[0, 0, 0, 0]")], ("orientation of a goal has length zero",)),
        ([at("[0.3, 0, 0]", orientation="{ rol = 90 }")], ("'rol'", "roll, pitch, yaw")),
        ([at("[0.3, 0, 0]", pointing="[0, 0, 0]")], ("pointing of a goal has length zero",)),
        ([at("[0.3, 0, 0]", pointing="{ axis = 'up', to = [0, 0, 1] }")], ("axis of a goal's pointing",)),
        ([at("[0.3, 0, 0]", tolerance="0")], ("tolerance of a goal is 0",)),
        ([at("[0.3, 0, 0]", tolerance="{ speed = 1 }")], ("'speed'", "position, orientation, pointing, velocity")),
        ([at("[0.3, 0, 0]", trough="true")], ("'trough'", "Did you mean 'through'?")),
        ([at("[0.3, 0, 0]", through="1")], ("through of a goal is 1, expected true or false",)),
        ([{"joints": "{ ellbow = 1.0 }"}], ("'ellbow'", "Did you mean 'elbow'?")),
        (
            [{"joints": "{ elbow = 2.9 }", "time": 0.5}, at("[0.3, 0, -0.2]")],
            ("goal 1 (joints at 0.5 s) has joint 'elbow' at 2.9", "outside of its range", "2.56563"),
        ),
        ([{"joints": "{ elbow = 2.9 }"}], ("the goal has elbow at 2.9",)),
        ([{"joints": '"strait"'}], ("keyframe", "bent")),
        ([{"joints": "{ elbow = 0.0 }", "position": "[0, 0, 0]"}], ("goal of joints has position",)),
    ],
    ids=lambda given: str(given)[:50],
)
def test_goals(tmp_path, tables, fragments):
    refuse(write(tmp_path, goals(*tables)), *fragments)


@pytest.mark.parametrize(
    ("lines", "fragments"),
    [
        (['frame = "hand"'], ("follow has no points", "path.csv")),
        (['frame = "hand"', "points = [[0, 0, 0]]"], ("shape (1, 3)", "at least 2 rows of t and x, y, z")),
        (['frame = "hand"', "points = [[0, 0], [1, 1]]"], ("shape (2, 2)",)),
        (['frame = "hand"', "points = [[0.2, 0.1, 0, 0], [0.2, 0.2, 0, 0]]"], ("row 2", "times that rise")),
        (['frame = "hand"', "points = [[0.2, 0.1, 0, 0], [1.2, 0.2, 0, 0]]"], ("0.2 to 1.2 s", "duration of 1 s")),
        (
            ['frame = "hand"', "points = [[0.5, 0.9, 0, 0], [1, 0.9, 0, 0.1]]"],
            ("the path of hand at", "out of reach by 0.2"),
        ),
        (['frame = "hnad"', "points = [[0, 0, 0], [1, 1, 1]]"], ("Did you mean 'hand'",)),
        (['joints = ["ellbow"]', "points = [[0.0], [1.0]]"], ("Did you mean 'elbow'",)),
        (['frame = "hand"', "points = [[0, 0, 0], [1, 1, 1]]", "tolerance = -1"], ("tolerance of follow is -1",)),
        (['frame = "hand"', 'file = "none.csv"'], ("none.csv",)),
        (['frame = "hand"', 'file = "path.csv"', "points = [[0, 0, 0]]"], ("a file and points",)),
        (['file = "path.csv"'], ("has no heading t,JOINT",)),
        (['frame = "hand"', 'file = "words.csv"'], ("row 3 of", "no finite number in column 2")),
    ],
    ids=lambda given: str(given)[:60],
)
def test_paths(tmp_path, lines, fragments):
    (tmp_path / "path.csv").write_text("0.2,0.1,0,0\n1,0.2,0,0\n", encoding="utf-8")
    (tmp_path / "words.csv").write_text("t,x,y,z\n0,0.1,0,0\n0.1,none,0,0\n0.2,0,0,0\n", encoding="utf-8")
    refuse(write(tmp_path, "[follow]\n" + "\n".join(lines)), *fragments)


def test_a_path_that_begins_at_once_begins_where_the_start_has_the_frame(tmp_path):
    here = hand(0.5, -1.0)
    lines = f'[follow]\nframe = "hand"\npoints = [[0, {here[0] + 0.1}, 0, {here[1]}], [1, {here[0]}, 0, {here[1]}]]'
    refuse(
        write(tmp_path, lines), "the path of hand begins at t = 0, 0.1 m from", f"{here[0]:.4g}", "a later first time"
    )


def test_what_is_not_for_tasks_or_only_for_them(tmp_path):
    refuse(write(tmp_path, "goal = 1.0"), "goal is 1.0")
    refuse(write(tmp_path, ""), "no key 'goal'", "[[goal]] or [follow]")
    refuse(write(tmp_path, "", goal="[]"), "goal has 0 numbers")
    timed = GOAL + "time = 0.5"
    refuse(
        write(tmp_path, timed, objective='"time"', durations="[0.5, 2.0]"), "objective has time", "times of their own"
    )
    refuse(write(tmp_path, "[weights]\ngoal = 2.0", goal="{ elbow = 1.0 }"), "weights.goal", "[[goal]]")
    refuse(write(tmp_path, GOAL + "[weights]\ngoal = 0.0"), "weights.goal is 0")


def test_a_start_that_is_at_the_goal_already(tmp_path):
    here = hand(0.5, -1.0)
    near = f'[[goal]]\nframe = "hand"\nposition = [{here[0] + 0.003}, 0, {here[1]}]\n'
    refuse(write(tmp_path, near), "already within the tolerance of every goal", "position of hand, is 0.003 m away")


def test_the_command_ends_with_two(tmp_path):
    write(tmp_path, goals(at("[0.9, 0.0, 0.0]")))
    refused(run("run", "task.toml", cwd=tmp_path), "goal 1 (hand) is out of reach by 0.2 m")
    assert not (tmp_path / "renders").exists()


def test_a_start_outside_its_range_is_refused_before_a_goal_is_sought_from_there(tmp_path):
    """Angles of a file in degrees by oversight: the knee's range is 2.4 deg, and the goal is out of reach within it."""
    model = (ROOT / "examples" / "tasks" / "biped.xml").read_text().replace('<compiler angle="radian"/>', "")
    (tmp_path / "biped.xml").write_text(model)
    lift = (ROOT / "benchmarks" / "moving" / "biped-lift.toml").read_text()
    (tmp_path / "biped-lift.toml").write_text(lift.replace("../../examples/tasks/", ""))
    with pytest.raises(planner.PlannerError, match=r"the start has left_pitch at -0\.3 rad, expected -0"):
        planner.load_problem(tmp_path / "biped-lift.toml")
