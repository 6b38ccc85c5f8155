"""plan.npz: what is written is read back, and everything else is refused in one sentence."""

import contextlib
import json
import zipfile

import numpy as np
import pytest

import planner
from planner.base.errors import FileError
from planner.cases.plan_file import load_plan
from planner.model.space import StateSpace
from planner.problem import archive
from planner.problem.archive import FORMAT_VERSION
from planner.problem.plan import Iteration, Plan, Start, Status


@pytest.fixture(scope="module")
def plan():
    return planner.solve(planner.cases.hopper(height=7.5, horizon=40, smoothing=0.2))


@pytest.fixture
def saved(plan, tmp_path):
    return plan.save(tmp_path / "plan.npz")


def rewritten(path, **changes):
    """The same file with some arrays or meta entries replaced."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    meta = json.loads(str(arrays["meta"]))
    for name, value in changes.items():
        if name in arrays:
            arrays[name] = value
        else:
            meta[name] = value
    if "meta" not in changes:
        arrays["meta"] = np.array(json.dumps(meta))
    with open(path, "wb") as file:
        np.savez(file, **arrays)
    return path


def test_round_trip_is_exact(plan, saved):
    back = planner.load_plan(saved)
    for name in ("t", "xs", "us", "K"):
        np.testing.assert_array_equal(getattr(back, name), getattr(plan, name))
    assert back.history == plan.history
    assert (back.cost, back.gradient_norm, back.status) == (plan.cost, plan.gradient_norm, plan.status)
    assert back.twin.mjcf == plan.twin.mjcf
    np.testing.assert_array_equal(back.twin.to_sim, plan.twin.to_sim)
    assert back.problem.parameters == plan.problem.parameters


def test_file_reads_with_numpy_alone(plan, saved):
    with np.load(saved, allow_pickle=False) as file:
        meta = json.loads(str(file["meta"]))
        assert file["xs"].shape == (41, 3)
        assert file["us"].shape == (40, 1)
        assert file["K"].shape == (40, 1, 3)
        np.testing.assert_allclose(file["t"], np.linspace(0.0, 1.0, 41), rtol=0, atol=1e-15)
    assert meta["recipe"]["parameters"]["height"] == 7.5
    # every argument of the case by name, defaults included
    assert set(meta["recipe"]["parameters"]) == {
        "height", "duration", "horizon", "integrator", "smoothing", "stiffness", "gravity", "final_weight",
        "speed_weight", "piston_weight", "flow_weight",
    }  # fmt: skip
    assert meta["recipe"]["name"] == "hopper"
    assert meta["status"] == "CONVERGED"
    assert meta["iterations"] == plan.nit
    assert meta["format_version"] == FORMAT_VERSION
    assert meta["mjcf"].startswith("<mujoco")
    assert "<include" not in meta["mjcf"]
    assert {"planner", "mujoco", "numpy", "numba"} <= set(meta["versions"])


def test_same_plan_same_bytes(plan, tmp_path):
    one, two = plan.save(tmp_path / "one.npz"), plan.save(tmp_path / "two.npz")
    assert one.read_bytes() == two.read_bytes()


def test_control_is_affine_in_the_state(plan):
    """u = us[n] + K[n] (x - xs[n]): feedback from a disturbed start must end nearer to the goal than none."""
    dynamics, goal = plan.problem.dynamics, 7.5
    ends = {}
    for gain in (0.0, 1.0):
        x = plan.xs[0] + np.array([0.05, 0.0, 0.0])
        for n in range(plan.N):
            u = plan.us[n] + gain * plan.K[n] @ (x - plan.xs[n])
            x = dynamics.step(x[None], u[None])[0]
        ends[gain] = abs(x[0] - goal)
    assert ends[1.0] < 0.5 * ends[0.0]


def test_unfinished_plans_are_saved_too(tmp_path):
    problem = planner.cases.hopper(horizon=20)
    short = planner.solve(problem, max_iterations=1)
    assert short.status is planner.Status.MAX_ITERATIONS
    assert planner.load_plan(short.save(tmp_path / "short.npz")).status is short.status

    wild = planner.Problem(problem.dynamics, problem.cost, [0.0, 1e307, 0.0], us=np.zeros((20, 1)))
    wild = planner.solve(wild)
    assert wild.status is planner.Status.NOT_FINITE
    with pytest.warns(UserWarning, match="has the plan without its problem"):
        back = planner.load_plan(wild.save(tmp_path / "wild.npz"))
    assert np.isnan(back.cost)
    assert back.status is planner.Status.NOT_FINITE


def test_users_own_problem_comes_back_without_problem(tmp_path):
    dynamics = planner.FunctionDynamics(lambda x, u: u, 1, 1, 0.1, "euler")
    cost = planner.TrackingCost.reach([1.0], 5, final=1.0, effort=1.0)
    plan = planner.solve(planner.Problem(dynamics, cost, [0.0]))
    words = r"cannot hold its dynamics \(FunctionDynamics\)\. load_plan\(path, problem=problem\) puts"
    with pytest.warns(UserWarning, match=words):
        back = planner.load_plan(plan.save(tmp_path / "own.npz"))
    assert back.problem is None
    assert back.case is None
    with pytest.raises(planner.PlannerError, match="comes without its problem"):
        planner.prove(back, rollouts=0)


def turning(path, **changes):
    """The file of a plan whose states are (a number, a quaternion, four numbers), ndx = 8, made by nobody."""
    rng = np.random.default_rng(0)
    xs = rng.normal(size=(3, 9))
    xs[:, 1:5] /= np.linalg.norm(xs[:, 1:5], axis=1, keepdims=True)
    plan = Plan(
        np.arange(3.0), xs, rng.normal(size=(2, 2)), rng.normal(size=(2, 2, 8)), 1.0, 0.0, Status.CONVERGED, (),
        stored_space=StateSpace(9, 8, ((1, 1),)),
        starts=(Start(0, Status.NOT_FINITE, np.inf, 0, np.inf), Start(1, Status.CONVERGED, 1.0, 7, 1.0)),
    )  # fmt: skip
    plan.save(path)
    return plan, rewritten(path, **changes) if changes else path


def test_states_on_groups_and_starts_come_back(tmp_path):
    plan, path = turning(tmp_path / "turning.npz")
    back = load_plan(path)
    assert back.space == plan.space == StateSpace(9, 8, ((1, 1),))
    np.testing.assert_array_equal(back.K, plan.K)
    assert np.isnan(back.starts[0].cost)  # JSON has no infinity
    assert back.starts[0][:2] == (0, Status.NOT_FINITE)
    assert back.starts[1] == plan.starts[1]
    assert back.start == 1
    assert load_plan(back.save(tmp_path / "again.npz")).space == plan.space


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({}, "'space'"),
        ([], "'space'"),
        ({"ndx": 9, "quaternions": []}, "expected float64"),  # K has 8 columns
        ({"ndx": 8, "quaternions": []}, "'space'"),
        ({"ndx": 8.0, "quaternions": [[1, 1]]}, "'space'"),
        ({"ndx": 9, "quaternions": [[1, 1]]}, "'space'"),
        ({"ndx": 8, "quaternions": [[6, 6]]}, "'space'"),  # beyond the end
        ({"ndx": 8, "quaternions": [[1, 2]]}, "'space'"),
        ({"ndx": 8, "quaternions": [[-1, -1]]}, "'space'"),
        ({"ndx": 7, "quaternions": [[0, 0], [2, 1]]}, "'space'"),  # one in the other
        ({"ndx": 8, "quaternions": [1]}, "'space'"),
        ({"ndx": 8, "quaternions": [[1, "a"]]}, "'space'"),
        ({"ndx": 8, "quaternions": 3}, "'space'"),
    ],
)
def test_damaged_spaces_say_what_is_wrong(tmp_path, space, words):
    _, path = turning(tmp_path / "turning.npz", space=space)
    with pytest.raises(FileError, match=words):
        load_plan(path)


@pytest.mark.parametrize("starts", [3, {}, [[0]], [[0, "GOOD", 1.0, 1]], [[0, "CONVERGED", "cheap", 1]]])
def test_damaged_starts_are_refused(saved, starts):
    with pytest.raises(FileError, match="damaged"):
        load_plan(rewritten(saved, starts=starts))


@pytest.mark.parametrize(
    "content",
    [b"", b"not a zip", b"PK\x03\x04 broken", b"\x93NUMPY\x01\x00"],
    ids=["empty", "text", "broken zip", "npy header"],
)
def test_foreign_bytes_are_refused(tmp_path, content):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(FileError, match="is not a plan"):
        planner.load_plan(path)


def test_truncated_anywhere_is_refused(saved):
    whole = saved.read_bytes()
    for size in np.linspace(1, len(whole) - 1, 25).astype(int):
        saved.write_bytes(whole[:size])
        with pytest.raises(FileError):
            planner.load_plan(saved)


def test_flipped_bytes_never_escape_as_other_errors(saved):
    whole = bytearray(saved.read_bytes())
    rng = np.random.default_rng(0)
    for at in rng.integers(0, len(whole), 60):
        damaged = whole.copy()
        damaged[at] ^= 0xFF
        saved.write_bytes(bytes(damaged))
        with contextlib.suppress(FileError):  # a flip in a comment field may go unnoticed
            planner.load_plan(saved)


def test_pickled_arrays_are_refused(saved):
    with zipfile.ZipFile(saved) as file:
        names = file.namelist()
    assert "xs.npy" in names
    np.savez(saved, t=np.array([object()]), xs=1, us=1, K=1, history=1, meta="{}")
    with pytest.raises(FileError, match="is not a plan"):
        planner.load_plan(saved)


def test_newer_format_names_its_version(saved):
    rewritten(saved, format_version=FORMAT_VERSION + 1, versions={"planner": "9.9"})
    with pytest.raises(FileError, match=r"written by planner 9\.9"):
        planner.load_plan(saved)


def test_an_older_format_says_what_to_do(saved):
    rewritten(saved, format_version=4, versions={"planner": "0.3.0"})
    with pytest.raises(FileError) as caught:
        planner.load_plan(saved)
    assert str(caught.value) == (
        f"{saved} has format 4, written by planner 0.3.0; this planner reads format {FORMAT_VERSION}: "
        "make the plan again with this one."
    )


def test_a_file_that_unpacks_to_too_much_is_not_unpacked(saved, monkeypatch):
    with zipfile.ZipFile(saved) as file:
        size = sum(entry.file_size for entry in file.infolist())
    monkeypatch.setattr(archive, "_MAX_BYTES", size)
    assert planner.load_plan(saved).nit > 0
    monkeypatch.setattr(archive, "_MAX_BYTES", size - 1)
    monkeypatch.setattr(np.lib.npyio.NpzFile, "__getitem__", lambda *_: pytest.fail("an array was unpacked"))
    with pytest.raises(FileError, match=f"unpacks to {size} bytes, expected a plan of at most {size - 1}"):
        planner.load_plan(saved)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"us": np.zeros((3, 1))}, "damaged"),
        ({"xs": np.zeros((41, 3), dtype=np.float32)}, "float32"),
        ({"recipe": {"name": "tower", "parameters": {}}}, "expected one of: .*hopper"),
        ({"recipe": {"name": "hopper", "parameters": {"height": -1.0}}}, "height is -1.0"),
        ({"recipe": {"name": "hopper", "parameters": {"hight": 1.0}}}, "no parameter 'hight'"),
        ({"status": "PERFECT"}, "PERFECT"),
        ({"cost": "cheap"}, "'cost'"),
        ({"cost": True}, "'cost'"),
        ({"cost": 10**400}, "damaged"),
        ({"us": np.float64(1.0)}, "not tables"),
        ({"xs": np.zeros(3)}, "not tables"),
        ({"t": np.zeros(41)}, "does not rise"),
        ({"t": np.full(41, np.nan)}, "does not rise"),
        ({"history": np.zeros(())}, "history"),
        ({"history": np.full((2, 7), np.nan)}, "count its iterations"),
        ({"recipe": {"name": "hopper", "parameters": {}}}, "not complete"),
        ({"recipe": {"name": "hopper", "parameters": {"height": 10**400}}}, "damaged"),
        ({"twin": {}}, "exactly these maps"),
        ({"twin": {"to_x": [[1]], "to_x_offset": 3, "to_sim": "a", "to_sim_offset": []}}, "Twin"),
        ({"mjcf": None}, "MJCF text"),
        ({"format_version": -1}, "is not a plan"),
        ({"format_version": 1.5}, "is not a plan"),
        ({"recipe": {"name": "hopper"}}, "no usable 'recipe'"),
        ({"files": {"cube.stl": "0" * 32}}, r"no file 'cube\.stl'"),
        ({"versions": [], "format_version": 9}, "a newer version"),
        ({"format_version": 4}, "make the plan again"),
        ({"meta": np.array("[" * 100_000)}, "is not a plan"),
        ({"meta": np.array("[]")}, "is not a plan"),
    ],
)
def test_damaged_files_say_what_is_wrong(saved, changes, words):
    with pytest.raises(FileError, match=words):
        planner.load_plan(rewritten(saved, **changes))


def test_missing_file_and_wrong_suffix(plan, tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        planner.load_plan(tmp_path / "nowhere.npz")
    with pytest.raises(FileError, match=r"ending in \.npz"):
        plan.save(tmp_path / "plan.txt")


def test_scipy_names(plan):
    assert plan.success
    assert plan.message == plan.status.value
    assert plan.nit == len(plan.history) - 1
    assert isinstance(plan.history[0], Iteration)


def test_the_users_own_text_stays_with_a_plan_that_left_something_out(tmp_path):
    text = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 1"><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1"/></body></worldbody>
      <actuator><motor joint="hinge"/></actuator></mujoco>"""
    arm = planner.Mechanism.from_mjcf(text, contacts="off")
    assert 'type="plane"' in arm.original
    dynamics = planner.RigidBodyDynamics(arm, 0.05)
    cost = planner.TrackingCost.joints(dynamics, [0.1, 0.0], 5, effort=1.0, final_position=1.0)
    plan = planner.solve(planner.Problem(dynamics, cost, arm.home))
    stored = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert stored.twin.original == plan.twin.original == arm.original
    assert planner.Mechanism.from_mjcf(arm.original, contacts="off").mjcf == arm.mjcf
