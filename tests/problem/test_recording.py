"""Recordings: the same table of times and named columns from a CSV file, a ROS bag and a LeRobot data set."""

import importlib
import json
import sys

import numpy as np
import pytest

from planner.base.errors import FileError, PlannerError
from planner.base.files import confined
from planner.problem.recording import TIME, read_recording
from planner.problem.tasks.goal import recorded_duration, with_points

T = np.array([0.0, 0.011, 0.02, 0.031])  # uneven, as a recorder's
Q = np.stack([np.sin(T), 1.0 + T, -T], axis=1)
NAMES = ("elbow", "shoulder", "wrist")
STAMP = 1_700_000_000  # s since 1970


def write_csv(folder):
    path = folder / "q.csv"
    rows = [",".join(map(repr, map(float, (t, *q)))) for t, q in zip(T, Q, strict=True)]
    path.write_text("\n".join([",".join(("t", *NAMES)), *rows, ""]), encoding="utf-8")
    return path


def write_bag(folder, topics=("/joint_states",), changes=lambda i, names: names):
    """A bag of ROS 2 whose messages name the joints in another order each time."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    types = importlib.import_module("rosbags.typesys")
    store = types.get_typestore(types.Stores.LATEST)
    header, stamp, state = (
        store.types[name]
        for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "sensor_msgs/msg/JointState")
    )
    path = folder / "bag"
    with rosbag2.Writer(path, version=9) as bag:
        for topic in topics:
            connection = bag.add_connection(topic, state.__msgtype__, typestore=store)
            for i, (t, q) in enumerate(zip(T, Q, strict=True)):
                names = list(changes(i, list(np.roll(NAMES, i))))
                nanoseconds = STAMP * 10**9 + round(1e9 * t) + 500_000_000
                message = state(
                    header=header(stamp=stamp(*divmod(nanoseconds, 10**9)), frame_id=""), name=names,
                    position=np.roll(q, i), velocity=np.zeros(0), effort=np.zeros(0),
                )  # fmt: skip
                bag.write(connection, nanoseconds, store.serialize_cdr(message, state.__msgtype__))
    return path


def write_episodes(folder, episodes=(3,), names=None):
    """A file of a LeRobot data set; the number of an episode is added to its positions."""
    pyarrow, parquet = pytest.importorskip("pyarrow"), importlib.import_module("pyarrow.parquet")
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    (folder / "meta").mkdir()
    names = [f"{name}.pos" for name in NAMES] if names is None else names
    info = {"features": {"observation.state": {"dtype": "float32", "shape": [3], "names": names}}}
    (folder / "meta" / "info.json").write_text(json.dumps(info), encoding="utf-8")
    columns = {
        "observation.state": [list(q + k - episodes[0]) for k in episodes for q in Q],
        "timestamp": np.tile(T, len(episodes)), "episode_index": np.repeat(episodes, len(T)),
    }  # fmt: skip
    parquet.write_table(pyarrow.table(columns), path)
    return path


@pytest.mark.parametrize("write", [write_csv, write_bag, write_episodes])
def test_every_kind_of_file_is_the_same_table(write, tmp_path):
    heading, table, _ = read_recording(write(tmp_path), "the recording")
    assert heading == (TIME, *NAMES)
    np.testing.assert_allclose(table, np.column_stack([T, Q]), atol=1e-12)


@pytest.mark.parametrize("write", [write_csv, write_bag, write_episodes])
def test_a_file_outside_of_the_folder_that_inputs_are_confined_to_is_refused(write, tmp_path):
    (tmp_path / "inside").mkdir()
    path = write(tmp_path)
    with confined(tmp_path / "inside"), pytest.raises(FileError, match="is outside of"):
        read_recording(path, "the recording")


@pytest.mark.parametrize("write", [write_csv, write_bag, write_episodes])
def test_a_path_to_follow_is_of_the_joints_that_are_named(write, tmp_path):
    file = write(tmp_path).relative_to(tmp_path).as_posix()
    given = with_points({"file": file, "joints": ["wrist", "elbow"], "degrees": True}, tmp_path, NAMES)
    np.testing.assert_allclose(given.pop("points"), np.column_stack([T, np.radians(Q[:, [2, 0]])]), atol=1e-12)
    assert given == {"joints": ["wrist", "elbow"]}
    assert with_points({"file": file}, tmp_path, NAMES)["joints"] == list(NAMES)


@pytest.mark.parametrize("write", [write_csv, write_bag, write_episodes])
def test_a_recording_says_how_long_it_is(write, tmp_path):
    file = write(tmp_path).relative_to(tmp_path).as_posix()
    assert recorded_duration({"file": file}, tmp_path) == pytest.approx(T[-1])


@pytest.mark.parametrize(
    ("text", "table", "seconds"),
    [
        ("0,1,2,3\n0.5,1,2,3\n", {"frame": "hand"}, 0.5),
        ("x,y,z\n1,2,3\n", {"frame": "hand"}, None),  # without times
        ("0,1,2,3\n0.5,1,2,3\n", {"joints": ["a", "b", "c", "d"]}, None),  # of four joints
        ("", {"points": [[0.0, 1.0], [0.5, 1.0]]}, None),
    ],
)
def test_what_has_no_times_has_no_duration(tmp_path, text, table, seconds):
    (tmp_path / "q.csv").write_text(text, encoding="utf-8")
    assert recorded_duration(({"file": "q.csv"} if text else {}) | table, tmp_path) == seconds


def follow(folder, text, joints=None, actuators=("elbow", "shoulder")):
    """The path of two joints, whose motors may have their names, from a CSV."""
    (folder / "q.csv").write_text(text, encoding="utf-8")
    table = {"file": "q.csv"} | ({"joints": joints} if joints else {})
    found = with_points(table, folder, ["shoulder", "elbow"], actuators)
    return found["joints"], found["points"]


def test_a_path_to_follow_is_of_positions_and_not_of_controls_of_the_same_name(tmp_path):
    both = "time,position of shoulder,position of elbow,shoulder,elbow\n0,1,2,30,40\n1,1,2,30,40\n"
    assert follow(tmp_path, both, ["elbow", "shoulder"]) == (["elbow", "shoulder"], [[0, 2, 1], [1, 2, 1]])
    assert follow(tmp_path, both) == (["shoulder", "elbow"], [[0, 1, 2], [1, 1, 2]])
    positions = "time [s],position of elbow [rad],position of shoulder\n0,1,2\n1,1,2\n"
    assert follow(tmp_path, positions) == (["elbow", "shoulder"], [[0, 1, 2], [1, 1, 2]])
    plain = "t,elbow,shoulder [rad]\n0,1,2\n1,1,2\n"
    assert follow(tmp_path, plain) == (["elbow", "shoulder"], [[0, 1, 2], [1, 1, 2]])
    assert follow(tmp_path, "elbow,shoulder\n1,2\n1,3\n", ["shoulder", "elbow"])[1] == [[2, 1], [3, 1]]
    one = "time,position of shoulder,shoulder,elbow\n0,1,30,40\n1,1,30,40\n"
    with pytest.raises(FileError, match=r"no positions of the joint 'elbow', .*: 'elbow' may be a control"):
        follow(tmp_path, one, ["elbow"])
    assert follow(tmp_path, one, ["elbow"], actuators=("m",))[1] == [[0, 40], [1, 40]]
    with pytest.raises(FileError, match="'elbow' may be a control, since its unit is that of no position"):
        follow(tmp_path, "t,elbow [N m]\n0,1\n1,1\n", ["elbow"], actuators=())


def test_columns_of_something_else_are_asked_about(tmp_path):
    with pytest.raises(FileError, match=r"the column 'gripper', .*: name those to follow, joints = \[\"elbow\"\]\.$"):
        follow(tmp_path, "t,elbow,gripper\n0,1,1\n1,1,1\n")
    with pytest.raises(FileError, match=r"the column 'elbw', .*Did you mean 'elbow'\?$"):
        follow(tmp_path, "t,elbw\n0,1\n1,1\n")
    with pytest.raises(FileError, match=r"of the joint 'elbow', expected .*'position of elbow' .*; without a heading"):
        follow(tmp_path, "t,q1\n0,1\n1,1\n", ["elbow"])  # as many columns as joints, but of which?
    assert follow(tmp_path, "0,1\n1,2\n", ["elbow"])[1] == [[0, 1], [1, 2]]
    with pytest.raises(PlannerError, match=r"a joint of follow is 'wrist', expected one of: shoulder, elbow"):
        follow(tmp_path, "t,elbow,wrist\n0,1,1\n1,1,1\n", ["wrist"])


def test_units_of_a_heading_are_read_in_ours(tmp_path):
    (tmp_path / "q.csv").write_text("t [ms],a [deg],b [mm],c [N m],d [left],e\n1000,180,5,2,3,180\n", encoding="utf-8")
    found = read_recording(tmp_path / "q.csv", "the recording", degrees=True)
    assert found.heading == (TIME, "a", "b", "c", "d [left]", "e")
    assert found.units == ("s", "rad", "m", "N m", "", "")
    np.testing.assert_allclose(found.table, [[1.0, np.pi, 5e-3, 2.0, np.radians(3.0), np.pi]])


def test_one_of_several_topics_or_episodes_is_chosen(tmp_path):
    bag = write_bag(tmp_path, topics=("/left", "/right"))
    with pytest.raises(FileError, match=r"topics of .* /left, /right, expected part to be one of them"):
        read_recording(bag, "the recording")
    assert len(read_recording(bag, "the recording", part="/left").table) == len(T)
    episodes = write_episodes(tmp_path, episodes=(3, 4))
    with pytest.raises(FileError, match=r"episodes 3, 4, expected part to be one of them"):
        read_recording(episodes, "the recording", part=5)
    table = read_recording(episodes, "the recording", part="4").table
    np.testing.assert_allclose(table[:, 1:], Q + 1.0)


def test_what_is_no_recording_is_refused_in_a_sentence(tmp_path):
    (tmp_path / "q.parquet").write_bytes(b"PAR1 and nothing")
    (tmp_path / "q.mcap").write_bytes(b"nothing")
    csv = write_csv(tmp_path)
    with pytest.raises(FileError, match="has no parts"):
        read_recording(csv, "the recording", part="/joint_states")
    pytest.importorskip("pyarrow")
    with pytest.raises(FileError, match=r"is no Parquet file that can be read, expected a data file of a LeRobot"):
        read_recording(tmp_path / "q.parquet", "the recording")
    with pytest.raises(FileError, match=r"info\.json has no names of observation\.state"):
        read_recording(write_episodes(tmp_path, names=17), "the recording")
    pytest.importorskip("rosbags")
    with pytest.raises(FileError, match=r"is no ROS bag that can be read, expected the folder .*metadata\.yaml"):
        read_recording(tmp_path / "q.mcap", "the recording")
    with pytest.raises(FileError, match="positions of different joints"):
        read_recording(write_bag(tmp_path, changes=lambda i, names: names if i else ["else", *names[1:]]), "it")


@pytest.mark.parametrize(
    ("name", "module", "extra"), [("q.parquet", "pyarrow", "lerobot"), ("q.mcap", "rosbags", "ros")]
)
def test_a_package_that_is_missing_is_named(name, module, extra, tmp_path, monkeypatch):
    (tmp_path / name).write_bytes(b"")
    for one in (module, *(one for one in sys.modules if one.startswith(f"{module}."))):
        monkeypatch.setitem(sys.modules, one, None)
    with pytest.raises(PlannerError, match=rf"{module} is not installed.*pip install slq-planner\[{extra}\]\.$"):
        read_recording(tmp_path / name, "the recording")
