"""Files for other programs: each is read back by another reader and compared with the plan."""

import csv
import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import yaml
from rolled_out_plans import problem_of, rolled_out

import planner
from planner.base.errors import FileError
from planner.cases.given_controls import plan_of_controls
from planner.model.mechanism import Mechanism
from planner.problem.export import left_out
from planner.problem.tasks.goal import with_points

FLYING = """
<mujoco model="flying">
  <worldbody><body name="trunk" pos="0 0 1">
    <freejoint name="base"/><geom size="0.1" mass="2"/>
    <body pos="0.2 0 0"><joint name="hip" type="ball"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
      <body pos="0.3 0 0"><joint name="knee" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0.1 0" size="0.02" mass="0.5"/></body></body>
  </body></worldbody>
  <actuator><motor name="knee" joint="knee"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def arm():
    return planner.solve(planner.cases.two_link())


@pytest.fixture(scope="module")
def flying():
    mechanism = Mechanism.from_mjcf(FLYING)
    x0 = mechanism.home.copy()
    x0[mechanism.nq :] = np.linspace(-2.0, 3.0, mechanism.nv)  # everything turns
    return rolled_out(problem_of(mechanism, 0.02, 20, x0=x0, us=np.sin(np.arange(20.0))[:, None]))


def read_csv(path):
    with open(path, newline="") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, dtype=float)


def test_a_csv_gives_every_bit_back(arm, tmp_path):
    header, table = read_csv(arm.to_csv(tmp_path / "plan.csv"))
    assert header == [
        "time [s]", "position of shoulder [rad]", "position of elbow [rad]", "velocity of shoulder [rad/s]",
        "velocity of elbow [rad/s]", "shoulder [N m]", "elbow [N m]",
    ]  # fmt: skip
    assert np.array_equal(table[:, 0], arm.t)
    assert np.array_equal(table[:, 1:5], arm.xs)
    assert np.array_equal(table[:-1, 5:], arm.us)
    assert np.array_equal(table[-1, 5:], arm.us[-1])


def test_a_csv_of_controls_is_a_plan_again(arm, tmp_path):
    model = tmp_path / "arm.xml"
    model.write_text(arm.twin.mjcf)
    path = arm.to_csv(tmp_path / "controls.csv", only="controls")
    again = plan_of_controls(path, model, start=arm.xs[0].tolist())
    assert np.array_equal(again.us, arm.us)
    assert np.abs(again.xs - arm.xs).max() < 1e-9


def test_a_csv_is_a_path_to_follow_again(arm, tmp_path):
    """Positions, where actuators have the names of joints; of all joints in the file's order, or of those named."""
    arm.to_csv(tmp_path / "plan.csv")
    names = ("shoulder", "elbow")
    follow = with_points({"file": "plan.csv", "joints": ["elbow", "shoulder"]}, tmp_path, names, names)
    assert np.array_equal(follow["points"], np.column_stack([arm.t, arm.xs[:, [1, 0]]]))
    follow = with_points({"file": "plan.csv"}, tmp_path, names, names)
    assert follow["joints"] == ["shoulder", "elbow"]
    assert np.array_equal(follow["points"], np.column_stack([arm.t, arm.xs[:, :2]]))
    arm.to_csv(tmp_path / "torques.csv", only="controls")
    with pytest.raises(FileError, match=r"no positions of the joint 'elbow', expected a column 'position of elbow'"):
        with_points({"file": "torques.csv", "joints": ["elbow"]}, tmp_path, names, names)


def test_an_exported_plan_is_proved_by_its_controls_from_its_start(arm, tmp_path):
    (tmp_path / "arm.xml").write_text(arm.problem.dynamics.mechanism.mjcf, encoding="utf-8")
    again = plan_of_controls(arm.to_csv(tmp_path / "plan.csv"), tmp_path / "arm.xml")
    assert np.array_equal(again.us, arm.us)
    assert np.abs(again.xs - arm.xs).max() < 1e-9
    states = plan_of_controls(arm.to_csv(tmp_path / "states.csv", only="states"), tmp_path / "arm.xml")
    assert states.K.any()  # they are followed


def test_an_exported_plan_of_a_floating_machine_is_one_too(flying, tmp_path):
    (tmp_path / "it.xml").write_text(flying.problem.dynamics.mechanism.mjcf, encoding="utf-8")
    again = plan_of_controls(flying.to_csv(tmp_path / "plan.csv"), tmp_path / "it.xml")
    assert np.array_equal(again.us, flying.us)
    assert np.array_equal(again.xs[0], flying.xs[0])


def test_names_of_quaternions_and_of_what_has_the_name_of_an_actuator(flying, tmp_path):
    header, table = read_csv(flying.to_csv(tmp_path / "plan.csv"))
    assert header[1:13] == [
        "base x [m]", "base y [m]", "base z [m]", *(f"base quaternion {axis}" for axis in "wxyz"),
        *(f"hip quaternion {axis}" for axis in "wxyz"), "position of knee [rad]",
    ]  # fmt: skip
    assert len(set(header)) == len(header)
    assert np.array_equal(table[:, 1 : 1 + flying.xs.shape[1]], flying.xs)


def test_states_between_knots_are_the_plans_integrator_and_controls_are_held(flying):
    fine = flying.sampled(150.0)  # three a stage
    assert np.array_equal(fine.xs[::3], flying.xs)
    assert np.abs(fine.xs - flying.between_knots(3)).max() < 1e-12
    assert np.array_equal(fine.us[:-1], np.repeat(flying.us, 3, axis=0))
    for i, _ in flying.space.quaternions:
        assert np.allclose(np.linalg.norm(fine.xs[:, i : i + 4], axis=1), 1.0, atol=1e-12)


def test_without_a_problem_states_go_straight_on_the_group(flying):
    known, alone = flying.sampled(150.0), replace(flying, problem=None, stored_space=flying.space).sampled(150.0)
    assert np.array_equal(alone.xs[::3], flying.xs)
    positions = slice(flying.problem.dynamics.mechanism.nv)  # velocities jump more: everything spins
    apart = np.abs(flying.space.difference(alone.xs, known.xs)[:, positions]).max()
    assert 0.0 < apart < 0.05  # a stage of 0.02 s, straight or by RK4
    for i, _ in flying.space.quaternions:
        assert np.allclose(np.linalg.norm(alone.xs[:, i : i + 4], axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("rate", [7.0, 100.0, 333.0, 1000.0])
def test_the_end_is_the_last_sample_at_any_rate(arm, rate):
    samples = arm.sampled(rate)
    assert samples.t[-1] == arm.t[-1]
    assert np.array_equal(samples.xs[-1], arm.xs[-1])
    assert np.allclose(np.diff(samples.t)[:-1], 1.0 / rate, atol=1e-12)
    assert 0.0 < np.diff(samples.t)[-1] < 1.0 / rate * (1.0 + 1e-6)
    assert np.all(np.diff(samples.stages) >= 0)
    assert samples.stages[-1] == arm.N - 1


def test_a_frame_of_pandas_has_the_table_and_units(arm):
    frame = arm.to_pandas(50)
    assert np.array_equal(frame.index, arm.sampled(50).t)
    assert np.array_equal(frame["velocity of elbow"], arm.sampled(50).xs[:, 3])
    assert frame.attrs["units"]["velocity of elbow"] == "rad/s"


@pytest.mark.parametrize(("name", "read"), [("a.json", json.loads), ("a.yaml", yaml.safe_load)])
def test_a_joint_trajectory_is_read_back(flying, arm, tmp_path, name, read):
    for plan, joints, columns in ((arm, ["shoulder", "elbow"], [0, 1]), (flying, ["knee"], [11])):
        message = plan.to_joint_trajectory(tmp_path / name, 30)
        assert read((tmp_path / name).read_text()) == message
        assert message["joint_names"] == joints
        samples, nq = plan.sampled(30), plan.problem.dynamics.mechanism.nq
        assert np.array_equal([point["positions"] for point in message["points"]], samples.xs[:, columns])
        times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
        assert np.allclose(times, samples.t, atol=1e-9)
        last = samples.xs[:, nq : nq + 2] if plan is arm else samples.xs[:, -1:]
        assert np.array_equal([point["velocities"] for point in message["points"]], last)
    assert left_out(flying) == ("base", "hip")


def test_small_numbers_stay_numbers_in_yaml(arm, tmp_path):
    xs = arm.xs.copy()
    xs[:3, 0] = 1e-05, -3e-12, 1e22
    small = replace(arm, xs=xs)
    message = small.to_joint_trajectory(tmp_path / "a.yaml")
    assert yaml.safe_load((tmp_path / "a.yaml").read_text()) == message


def test_a_model_includes_the_keyframes(flying, tmp_path):
    flying.to_keyframes(tmp_path / "plan.keys.xml", 25)
    text = flying.twin.mjcf.replace("</mujoco>", '<include file="plan.keys.xml"/></mujoco>')
    (tmp_path / "model.xml").write_text(text)
    model, samples = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")), flying.sampled(25)
    assert model.nkey == len(samples.t)
    assert np.allclose(model.key_time, samples.t, atol=0)
    assert np.abs(model.key_qpos - samples.xs[:, : model.nq]).max() < 1e-15
    assert np.array_equal(model.key_qvel, samples.xs[:, model.nq :])
    assert np.array_equal(model.key_ctrl, samples.us)
    assert model.key(1).name == "plan_1"


def test_the_hopper_has_a_table_and_keyframes_but_no_joint_trajectory(tmp_path):
    plan = planner.solve(planner.cases.hopper(), max_iterations=1)
    header, _ = read_csv(plan.to_csv(tmp_path / "a.csv", 100))
    assert header[-1] == "u[0]"
    plan.to_keyframes(tmp_path / "a.xml", 20)
    with pytest.raises(planner.PlannerError, match=r"no Mechanism; write a CSV"):
        plan.to_joint_trajectory()


def test_wrong_arguments_are_said_and_leave_no_file(arm, tmp_path):
    broken = replace(arm, xs=np.full_like(arm.xs, np.nan))
    for call, words in (
        (lambda: arm.to_csv(tmp_path / "a.csv", 0.0), "rate is 0.0, expected a finite number greater than 0"),
        (lambda: arm.to_csv(tmp_path / "a.csv", 1e9), "samples are more than 1000000"),
        (lambda: arm.to_csv(tmp_path / "a.csv", only="control"), "Did you mean 'controls'"),
        (lambda: arm.to_joint_trajectory(tmp_path / "a.xml"), "expected a name in .yaml, .yml or .json"),
        (lambda: arm.to_keyframes(tmp_path / "a.xml", 1e5), "lower the rate"),
        (lambda: broken.to_csv(tmp_path / "a.csv"), "not finite"),
        (lambda: arm.to_csv(5), "cannot write to 5: expected the path of a file"),
        (lambda: arm.to_joint_trajectory(arm), "expected the path of a file"),
        (lambda: arm.to_csv(tmp_path / "no" / "a.csv"), "does not exist; create it"),
        (lambda: arm.to_csv(tmp_path / "a.csv", "100"), "rate is '100'"),
        (lambda: replace(arm, twin=None).to_keyframes(tmp_path / "a.xml"), "write a CSV"),
    ):
        with pytest.raises(planner.PlannerError) as error:
            call()
        assert words in str(error.value)
    assert list(tmp_path.iterdir()) == []
