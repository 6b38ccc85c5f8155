"""Plans of anybody's: a CSV of controls or of joint positions becomes a plan that a proof can judge."""

import numpy as np
import pytest
from commands import refused, run
from PIL import Image

import planner
from planner import PlannerError, cases
from planner.cases import given_controls
from planner.cases.given_controls import plan_of_controls
from planner.proof.diagnostics import suggested_fixes


@pytest.fixture(scope="module")
def solved():
    return planner.solve(cases.two_link(horizon=100))


@pytest.fixture
def model(solved, tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(solved.problem.dynamics.mechanism.mjcf, encoding="utf-8")
    return path


def write(path, names, rows, dt):
    lines = [",".join(["time", *names])]
    lines += [",".join(repr(float(value)) for value in (i * dt, *row)) for i, row in enumerate(rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_controls_lead_where_the_plan_that_they_are_of_goes(solved, model, tmp_path):
    file = write(tmp_path / "u.csv", ["shoulder", "elbow"], solved.us, solved.dt)
    plan = plan_of_controls(file, model, goal=[np.pi / 2, 0.0])
    np.testing.assert_allclose(plan.xs, solved.xs, atol=1e-9)
    assert not plan.success  # nobody optimized it
    proof = planner.prove(plan, rollouts=0, optimal=False)
    assert proof.passed, proof.reason
    assert "not optimal" in proof.headline
    assert not planner.prove(plan, rollouts=0).passed


def test_a_urdf_is_read_as_everywhere(tmp_path):
    """Its joints have motors, by their names."""
    from urdfs import ARM

    (tmp_path / "arm.urdf").write_text(ARM)
    motors = [name for name in planner.Mechanism.from_urdf(ARM).actuators.names if name]
    file = write(tmp_path / "u.csv", motors, np.zeros((20, len(motors))), 0.01)
    plan = plan_of_controls(file, tmp_path / "arm.urdf")
    proof = planner.prove(plan, rollouts=0, optimal=False)
    assert proof.passed, proof.reason
    assert not plan.K.any()  # controls, as in an export; a file in degrees can only hold positions
    assert plan_of_controls(file, tmp_path / "arm.urdf", degrees=True).K.any()


def test_columns_may_come_in_any_order(solved, model, tmp_path):
    file = write(tmp_path / "u.csv", ["elbow", "shoulder"], solved.us[:, ::-1], solved.dt)
    np.testing.assert_allclose(plan_of_controls(file, model).us, solved.us)


def test_controls_that_miss_the_goal_fail(solved, model, tmp_path):
    file = write(tmp_path / "u.csv", ["shoulder", "elbow"], 0.9 * solved.us, solved.dt)
    proof = planner.prove(plan_of_controls(file, model, goal=[np.pi / 2, 0.0]), rollouts=0, optimal=False)
    assert not proof.passed
    assert "angle miss" in proof.reason


def test_controls_named_as_joints_are_no_motion(tmp_path):
    """Torques of thousands of newton metres under the joints' names are positions that jump."""
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="a"/><geom size="0.1" mass="1"/></body></worldbody>'
        '<actuator><motor name="m" joint="a"/></actuator></mujoco>'
    )
    jumps = 1e160 * np.random.default_rng(0).normal(size=(20, 1))  # no LQ problem in floating point holds them
    with pytest.raises(PlannerError, match="jump"):
        plan_of_controls(write(tmp_path / "q.csv", ["a"], jumps, 0.01), tmp_path / "arm.xml")


def test_positions_are_followed(solved, model, tmp_path):
    names = ["position of shoulder", "position of elbow"]
    plan = plan_of_controls(write(tmp_path / "q.csv", names, solved.xs[:, :2], solved.dt), model)
    # A held control has no jerk within a stage, a spline has: they differ by the square of the stage.
    np.testing.assert_allclose(plan.xs[:, :2], solved.xs[:, :2], atol=0.02)
    assert np.any(plan.K)
    proof = planner.prove(plan, rollouts=0, optimal=False)
    assert proof.passed, proof.reason
    by_unit = write(tmp_path / "u.csv", ["shoulder [rad]", "elbow [rad]"], solved.xs[:, :2], solved.dt)
    np.testing.assert_array_equal(plan_of_controls(by_unit, model).us, plan.us)  # no torque has this unit
    assert "no goal was asked for" not in proof.headline  # the last row is
    assert proof.goal.passed
    with pytest.raises(PlannerError, match="leave --start out"):
        plan_of_controls(tmp_path / "q.csv", model, start=[1.0, 0.0])


FAST = """<mujoco><worldbody><body><joint name="wrist" axis="0 1 0" damping="0.2"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.01" mass="0.1"/></body></worldbody>
  <actuator><motor name="motor" joint="wrist"/></actuator></mujoco>"""


def of_wrist(folder, what, damping, hertz, seconds=1.0):
    """A plan of rows at a rate, and how many steps it takes from one to the next."""
    (folder / "wrist.xml").write_text(FAST.replace("0.2", f"{damping:g}"))
    s = np.linspace(0.0, 1.0, round(hertz * seconds) + 1)
    rows = s**3 * (10 - 15 * s + 6 * s**2) if what != "motor" else 0.2 * np.sin(9.0 * s)
    file = write(folder / "wrist.csv", [what], rows[:, None], 1.0 / hertz)
    plan = plan_of_controls(file, folder / "wrist.xml")
    return plan, rows, plan.options["steps_per_row"]


@pytest.mark.parametrize("what", ["position of wrist", "motor"])
@pytest.mark.parametrize(
    ("damping", "hertz", "seconds", "steps"),
    [(0.2, 100, 1.0, 2), (0.2, 20, 1.0, 8), pytest.param(0.5, 20, 3.5, 16, marks=pytest.mark.slow)],
)
def test_a_machine_may_be_faster_than_its_recording(what, damping, hertz, seconds, steps, tmp_path):
    """A wrist of 7.5e-4 kg m^2 with 0.2 N m s forgets its velocity in 4 ms; RK4 is not stable from 10 ms on.

    At 20 Hz one, two and four steps from row to row are 50 to 12 ms long, and their errors do not fall. With 0.5 N m s
    one step of 50 ms multiplies velocities by 5e4: over 70 of them no gains and no states are finite.
    """
    plan, rows, taken = of_wrist(tmp_path, what, damping, hertz, seconds)
    assert taken == steps
    proof = planner.prove(plan, rollouts=0, optimal=False)
    assert proof.passed, proof.reason
    if what != "motor":
        np.testing.assert_allclose(plan.xs[::steps, 0], rows, atol=2e-3)


def test_no_number_of_steps_is_tried_twice(monkeypatch, tmp_path):
    """Where stages are as many as can be, all more of them are as many."""
    tried = []
    tracked = given_controls._tracked
    monkeypatch.setattr(given_controls, "LONGEST_HORIZON", 50)  # of 20 rows, twice
    monkeypatch.setattr(given_controls, "_tracked", lambda *given: tried.append(given[1]) or tracked(*given))
    of_wrist(tmp_path, "position of wrist", 0.2, 20)
    assert tried == [20, 40]


@pytest.mark.parametrize(
    ("what", "hertz", "steps"),
    [("position of wrist", 20, 4), pytest.param("motor", 100, 1, marks=pytest.mark.slow), ("motor", 25, 4)],
)
def test_a_recording_is_told_a_rate_at_which_as_many_steps_pass(what, hertz, steps, tmp_path, monkeypatch):
    monkeypatch.setattr(given_controls, "_PARTS", (steps,))
    plan, *_ = of_wrist(tmp_path, what, 0.2, hertz)
    proof = planner.prove(plan, rollouts=0, optimal=False)
    (only,) = suggested_fixes(plan, proof)
    assert (only.code, only.value) == ("rows_too_sparse", None)
    assert only.values["dt"].value == pytest.approx(1.0 / (hertz * steps))
    rate = only.values["rate"].value
    assert hertz < rate <= 5.0 * hertz
    assert str(only).startswith(f"Record, or export by `--rate`, at {rate:.0f} Hz or more: at steps of ")
    assert planner.prove(of_wrist(tmp_path, what, 0.2, rate)[0], rollouts=0, optimal=False).passed


def test_a_recording_is_told_no_weights(solved, model, tmp_path):
    file = write(tmp_path / "u.csv", ["shoulder", "elbow"], 0.9 * solved.us, solved.dt)
    plan = plan_of_controls(file, model, goal=[np.pi / 2, 0.0])
    (only,) = suggested_fixes(plan, planner.prove(plan, rollouts=0, optimal=False))
    assert only.code == "unknown_of_recording"


@pytest.mark.parametrize(
    ("actuator", "positions"),
    [
        ('motor name="a" joint="a" gear="50"', ("a [deg]", "a [rad]")),  # the control's unit is unknown
        ('motor name="a" joint="a"', ("a [deg]", "a [rad]")), ('position name="a" joint="a" kp="9"', ()),
    ],
)  # fmt: skip
def test_a_unit_tells_positions_from_controls_of_the_same_name(actuator, positions, tmp_path):
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/></body></worldbody>'
        f"<actuator><{actuator}/></actuator></mujoco>"
    )
    for heading in ("a", "a [deg]", "a [rad]"):
        file = write(tmp_path / "u.csv", [heading], np.full((20, 1), 0.1), 0.01)
        assert plan_of_controls(file, tmp_path / "arm.xml").K.any() == (heading in positions)  # followed by gains


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a header"),
        ("shoulder,elbow\n1,1\n1,1\n", "expected a header"),
        ("time,shoulder,elbow\n0,1,1\n", "expected 2 to"),
        ("time,shoulder,elbow\n0,1,1\n1,1,x\n", "row 3 of"),
        ("time,shoulder,elbow\n0,1,1\n1,1\n", "2 columns, expected 3 as in the heading"),
        ("time;shoulder;elbow\n0;1;1\n1;1;1\n", "semicolons between its columns, expected commas"),
        ("1,2,3\n1,2\n", "expected 2 as in the last row"),
        ("time,shoulder,elbow\n0,nan,1\n1,1,1\n", "no finite number in column 2"),
        ("time,shoulder,elbow\n0,1,1\n1,1,1\n3,1,1\n", "expected rows at equal times"),
        ("time,shoulder,elbow\n0,1,1\n0,1,1\n", "expected rows at equal times"),
        ("time,shoulder,wrist\n0,1,1\n1,1,1\n", "shoulder, elbow"),
        ("time,shoulder,shoulder\n0,1,1\n1,1,1\n", "each once"),
        ("time,shoulder,elbow\n0,1e300,1\n1,1,1\n", "read as controls, since actuators have these names"),
        ("time,shoulder,mass\n0,1,1\n1,1,1\n", "'position of JOINT' where an actuator"),
    ],
)
def test_a_wrong_file_is_refused(text, words, model, tmp_path):
    file = tmp_path / "u.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(PlannerError, match=r"u\.csv") as caught:
        plan_of_controls(file, model)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.pictures
def test_positions_at_uneven_times_are_followed_and_compared_with_the_replay(solved, model, tmp_path):
    """A recorder's times jitter by a third of their spacing: the path stays that of the plan that was recorded."""
    t = solved.t + solved.dt * np.random.default_rng(0).uniform(-0.3, 0.3, len(solved.t))
    t[[0, -1]] = solved.t[[0, -1]]
    q = np.stack([np.interp(t, solved.t, column) for column in solved.xs[:, :2].T], axis=1)
    lines = ["t,position of shoulder,position of elbow"]
    lines += [",".join(repr(float(value)) for value in (at, *row)) for at, row in zip(t, np.degrees(q), strict=True)]
    file = tmp_path / "q.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    done = run(
        "prove",
        "--controls",
        file,
        "--model",
        model,
        "--degrees",
        "--save",
        "plan.npz",
        "--plot",
        "both.png",
        cwd=tmp_path,
    )
    with Image.open(tmp_path / "both.png") as picture:
        assert picture.width > 1000  # its curves are those of tests/view/test_plots_report.py
    assert "farthest from the recording" in done.stdout
    rows = [line.split() for line in done.stdout.splitlines() if line.startswith(("shoulder ", "elbow "))]
    assert len(rows) == 2
    for name, error, unit, *_ in rows:
        assert float(error) < 0.02, name  # as above
        assert unit == "rad"
    np.testing.assert_allclose(planner.load_plan(tmp_path / "plan.npz").xs[:, :2], solved.xs[:, :2], atol=0.02)
    (tmp_path / "back.csv").write_text("t,shoulder,elbow\n" + "0,1,1\n" * 8, encoding="utf-8")
    refused(run("prove", "--controls", tmp_path / "back.csv", "--model", model, cwd=tmp_path), "expected rows at equal")
    refused(run("prove", "plan.npz", "--part", "3", cwd=tmp_path), "--part is given without --controls")
