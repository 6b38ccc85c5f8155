"""problem.toml: what it says becomes the problem, a plan holds all of it, and a mistake gets one sentence."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import planner
from planner.guess import follow, hold
from planner.problem_file import DEFAULT_WEIGHTS, DEFAULTS, KEYS, WEIGHTS, load

EXAMPLES = Path(__file__).parents[1] / "examples"

CART = """
<mujoco model="cart">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body>
        <joint name="pole" axis="0 1 0"/>
        <inertial pos="0 0 -0.5" mass="0.2" diaginertia="0.01 0.01 0.01"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
  <keyframe>
    <key name="left" qpos="-1 0.1"/>
    <key name="right" qpos="1 0.2" qvel="0.3 0.4"/>
  </keyframe>
</mujoco>
"""
BASE = {"model": '"cart.xml"', "start": '"left"', "goal": "[1.0, 0.0]", "duration": "1.0", "dt": "0.05"}


def write(folder, weights="", **keys):
    (folder / "cart.xml").write_text(CART, encoding="utf-8")
    lines = [f"{key} = {value}" for key, value in (BASE | keys).items() if value is not None]
    path = folder / "problem.toml"
    path.write_text("\n".join(lines) + "\n" + weights, encoding="utf-8")
    return path


def refuse(path, *fragments):
    with pytest.raises(planner.PlannerError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


def test_the_example_converges_passes_and_is_the_same_in_python():
    problem, starts, seed = load(EXAMPLES / "crane.toml")
    assert (starts, seed) == (1, 0)
    plan = planner.solve(problem)
    assert plan.success
    proof = planner.prove(plan)
    assert proof.passed, proof.reason
    np.testing.assert_allclose(proof.replay.xs[-1], [2.0, 0.0, 0.0, 0.0], atol=1e-3)
    crane = planner.Mechanism.from_mjcf(EXAMPLES / "crane.xml", contacts="off")
    dynamics = planner.RigidBodyDynamics(crane, 0.02)
    cost = planner.TrackingCost.joints(
        dynamics, [2.0, 0.0, 0.0, 0.0], 200, effort=1.0, final_position=1e5, final_velocity=1e5
    )
    by_hand = planner.solve(planner.Problem(dynamics, cost, crane.home))
    np.testing.assert_array_equal(by_hand.us, plan.us)


def test_a_plan_needs_neither_file(tmp_path, monkeypatch):
    for name in ("crane.toml", "crane.xml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    plan = planner.solve(load(tmp_path / "crane.toml").problem)
    plan.save(tmp_path / "plan.npz")
    (tmp_path / "crane.toml").unlink()
    (tmp_path / "crane.xml").unlink()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    stored = planner.Plan.load("../plan.npz")
    assert stored.problem is not None
    assert stored.problem.parameters == plan.parameters
    assert stored.problem.stage == plan.problem.stage
    np.testing.assert_array_equal(stored.problem.first_guess, plan.problem.first_guess)
    proofs = planner.prove(plan), planner.prove(stored)
    assert proofs[1].passed
    assert proofs[1].to_dict() == proofs[0].to_dict()


def test_a_damaged_table_is_refused(tmp_path):
    plan = planner.solve(load(write(tmp_path)).problem, max_iterations=2)
    plan.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz", allow_pickle=False) as file:
        arrays = dict(file)
    meta = json.loads(str(arrays["meta"]))
    for key, value in (("dt", 0.1), ("goal", [1.0]), ("gaol", 1), ("weights", 3)):
        changed = meta | {"parameters": meta["parameters"] | {key: value}}
        np.savez(tmp_path / "changed.npz", **(arrays | {"meta": np.array(json.dumps(changed))}))
        with pytest.raises(planner.FileError, match=r"changed\.npz is damaged"):
            planner.Plan.load(tmp_path / "changed.npz")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ('"left"', [-1.0, 0.1, 0.0, 0.0]),
        ('"right"', [1.0, 0.2, 0.3, 0.4]),
        ("[0.5, -2]", [0.5, -2.0, 0.0, 0.0]),
        ("[0.5, -2, 3, 4.5]", [0.5, -2.0, 3.0, 4.5]),
        ("{ pole = 3 }", [0.0, 3.0, 0.0, 0.0]),
    ],
)
def test_states(tmp_path, value, expected):
    np.testing.assert_array_equal(load(write(tmp_path, start=value)).problem.x0, expected)


def test_a_goal_by_joints_leaves_the_others_where_they_started(tmp_path):
    problem = load(write(tmp_path, start='"right"', goal="{ slider = 3.0 }")).problem
    np.testing.assert_array_equal(problem.cost.x_ref[-1], [3.0, 0.2, 0.0, 0.0])


def test_states_of_ball_and_free_joints(tmp_path):
    (tmp_path / "body.xml").write_text(
        """<mujoco><worldbody><body><joint name="hip" type="ball"/><inertial pos="0 0 -1" mass="1"
        diaginertia="1 1 1"/><body><joint name="knee" axis="0 1 0"/><inertial pos="0 0 -1" mass="1"
        diaginertia="1 1 1"/></body></body></worldbody><actuator><motor joint="knee"/></actuator></mujoco>""",
        encoding="utf-8",
    )
    path = write(
        tmp_path, model='"body.xml"', start="{ hip = [2.0, 0.0, 0.0, 0.0], knee = 0.5 }", goal="{ knee = 1.0 }"
    )
    np.testing.assert_array_equal(load(path).problem.x0, [1.0, 0.0, 0.0, 0.0, 0.5, 0, 0, 0, 0])
    refuse(write(tmp_path, model='"body.xml"', start="{ hip = 1.0 }"), "start of hip", "(4,)")
    refuse(write(tmp_path, model='"body.xml"', start="{ hip = [0, 0, 0, 0] }"), "start", "quaternion of length zero")


def test_weights_reach_the_cost(tmp_path):
    weights = """
    [weights]
    effort = 2.0
    final_position = { slider = 30.0, pole = 40.0 }
    final_velocity = [5.0, 6.0]
    position = 7.0
    velocity = { pole = 8.0 }
    """
    cost = load(write(tmp_path, weights)).problem.cost
    np.testing.assert_allclose(cost.R, np.full((20, 1, 1), 2.0 * 0.05))
    np.testing.assert_allclose(cost.Q[-1], np.diag([30.0, 40.0, 5.0, 6.0]))
    np.testing.assert_allclose(cost.Q[3], 0.05 * np.diag([7.0, 7.0, 0.0, 8.0]))


def test_starts_and_seed_are_the_files_unless_given(tmp_path):
    path = write(tmp_path, starts="3", seed="5")
    assert load(path)[1:] == (3, 5)
    problem, starts, seed = load(path, starts=2, seed=0)
    assert (starts, seed) == (2, 0)
    assert (problem.parameters["starts"], problem.parameters["seed"]) == (2, 0)


def test_the_goal_is_judged_where_a_final_weight_acts(tmp_path):
    free = "[weights]\nfinal_position = { slider = 1e4 }\nfinal_velocity = 0.0\n"
    heavy = planner.prove(planner.solve(load(write(tmp_path, free, goal="[1.0, 2.0]")).problem))
    assert heavy.goal.passed  # the pole may be anywhere
    assert abs(heavy.replay.xs[-1, 1] - 2.0) > 0.5
    light = planner.prove(planner.solve(load(write(tmp_path, "[weights]\nfinal_position = 0.01\n")).problem))
    assert light.verdict == "FAIL"
    assert "goal" in light.reason
    none = planner.prove(planner.solve(load(write(tmp_path, free.replace("1e4", "0.0"))).problem))
    assert none.goal.not_applicable


def test_hold_holds():
    """A pose that the actuators can hold does not move; what they cannot reach is left alone."""
    arm = planner.cases.two_link().dynamics
    x = np.array([0.7, -0.4, 0.0, 0.0])
    np.testing.assert_allclose(arm.rates(x[None], hold(arm.mechanism, x)[None]), 0.0, atol=1e-12)
    crane = planner.Mechanism.from_mjcf(EXAMPLES / "crane.xml", contacts="off")
    assert hold(crane, np.array([0.0, 0.5, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-12)


SERVOS = """
<mujoco>
  <worldbody>
    <body>
      <joint name="a" axis="0 -1 0" stiffness="3" springref="20" damping="1"/>
      <inertial pos="1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body pos="1 0 0">
        <joint name="b" axis="0 -1 0"/>
        <inertial pos="1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""


def test_hold_and_follow_know_servos():
    text = SERVOS.format(actuators='<position joint="a" kp="50" kv="2"/><motor joint="b" gear="3"/>')
    servos = planner.Mechanism.from_mjcf(text)
    dynamics = planner.RigidBodyDynamics(servos, 0.01)
    x = np.array([[0.3, -0.8, 0.0, 0.0]])
    np.testing.assert_allclose(dynamics.rates(x, hold(servos, x[0])[None]), 0.0, atol=1e-11)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 20, 2))
    us = follow(servos, q, qd, qdd)
    np.testing.assert_allclose(dynamics.rates(np.hstack([q, qd]), us)[:, 2:], qdd, atol=1e-9)


def test_hold_leaves_integrators_and_fills_filters():
    actuators = '<intvelocity joint="a" kp="50"/><general joint="b" dyntype="filter" dynprm="0.1" gainprm="4"/>'
    servos = planner.Mechanism.from_mjcf(SERVOS.format(actuators=actuators))
    x = np.zeros(6)
    u = hold(servos, x)
    assert u[0] == 0.0
    x[5] = u[1]  # once the filter has filled
    held = planner.bias(servos, x[:2], x[2:4])[1]
    assert 4.0 * x[5] == pytest.approx(held)
    with pytest.raises(planner.PlannerError, match="fully actuated"):
        follow(servos, *np.zeros((3, 5, 2)))


@pytest.mark.parametrize(
    ("keys", "fragments"),
    [
        ({"gaol": "1"}, ("key 'gaol'", "Did you mean 'goal'", "duration")),
        ({"model": None}, ("no key 'model'",)),
        ({"start": None}, ("no key 'start'", "left, right", "slider, pole")),
        ({"goal": None}, ("no key 'goal'", "2 or 4 numbers")),
        ({"duration": None}, ("no key 'duration'", "seconds")),
        ({"model": '"no.xml"'}, ("no.xml",)),
        ({"model": "3"}, ("model is 3",)),
        ({"start": '"lift"'}, ("start is 'lift'", "left, right", "Did you mean 'left'")),
        ({"start": "[1.0]"}, ("start has 1 numbers", "2 or 4 numbers")),
        ({"start": "[nan, 0.0]"}, ("start[0] is nan", "finite")),
        ({"start": '["a", 0.0]'}, ("start is not an array of numbers",)),
        ({"start": "1.0"}, ("start is 1.0", "table of joints")),
        ({"goal": "{ elbow = 1.0 }"}, ("elbow", "slider, pole")),
        ({"goal": '{ pole = "up" }'}, ("goal of pole",)),
        ({"duration": "-1"}, ("duration is -1",)),
        ({"duration": "1.02"}, ("duration is 1.02", "0.05", "e.g. 1")),
        ({"duration": "1e9"}, ("duration / dt", "100000")),
        ({"dt": "0.0"}, ("dt is 0.0", "greater than 0")),
        ({"dt": '"fast"'}, ("dt is 'fast'",)),
        ({"integrator": '"rk5"'}, ("rk5", "rk4")),
        ({"guess": '"good"'}, ("guess", "hold, zero")),
        ({"contacts": "false"}, ("contacts is False", "on, off")),
        ({"ignore": '"friction"'}, ("ignore is 'friction'", "list")),
        ({"ignore": '["friction"]'}, ("friction", "frictionloss")),
        ({"starts": "0"}, ("starts is 0",)),
        ({"seed": "-1"}, ("seed is -1",)),
        ({"tolerance": "0"}, ("tolerance is 0",)),
        ({"title": "3"}, ("title is 3",)),
    ],
    ids=str,
)
def test_wrong_keys_are_named(tmp_path, keys, fragments):
    refuse(write(tmp_path, **keys), *fragments)


@pytest.mark.parametrize(
    ("weights", "fragments"),
    [
        ("efort = 1.0", ("'efort'", "Did you mean 'effort'")),
        ("effort = 0.0", ("effort", "above 0")),
        ("effort = { pull = 1.0 }", ("pull", "push")),
        ("final_position = { pol = 1.0 }", ("pol", "Did you mean 'pole'")),
        ("final_position = -1.0", ("final_position", "at least 0")),
        ("final_velocity = nan", ("final_velocity", "nan")),
        ('velocity = "some"', ("velocity is 'some'",)),
        ("position = [1.0]", ("position has shape (1,)", "(2,)")),
    ],
)
def test_wrong_weights_are_named(tmp_path, weights, fragments):
    refuse(write(tmp_path, f"[weights]\n{weights}\n"), *fragments)


def test_weights_are_a_table(tmp_path):
    refuse(write(tmp_path, "weights = 3\n"), "weights is 3", "final_position")


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        (CART.replace("<motor", "<!-- <motor").replace('"slider"/></act', '"slider"/> --></act'), ("no actuators",)),
        (CART.replace('mass="0.2"', 'mass="0"').replace('diaginertia="0.01 0.01 0.01"', ""), ("mass",)),
        ('<!DOCTYPE m [<!ENTITY a "aaaa">]>' + CART, ("entities",)),
        (CART.replace("<worldbody>", '<include file="gone.xml"/><worldbody>'), ("gone.xml",)),
        (CART.replace("<worldbody>", '<include file="cart.xml"/><worldbody>'), ("includes itself",)),
        (CART.replace("damping", "frictionloss"), ("frictionloss",)),
        (CART[:200], ("not well-formed",)),
        ("", ("cart.xml",)),
    ],
    ids=["no actuators", "zero mass", "entities", "missing include", "circle", "friction", "cut", "empty"],
)
def test_models_that_cannot_be_used_are_named(tmp_path, content, fragments):
    path = write(tmp_path)
    (tmp_path / "cart.xml").write_text(content, encoding="utf-8")
    refuse(path, *fragments)


def test_files_that_are_no_problem(tmp_path):
    refuse(tmp_path / "nowhere.toml", "nowhere.toml", "No such file")
    (tmp_path / "a.toml").write_text("model = ", encoding="utf-8")
    refuse(tmp_path / "a.toml", "a.toml is not TOML")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    refuse(tmp_path / "b.toml", "b.toml", "not text")
    refuse(tmp_path, "directory")


def test_every_key_is_described_and_documented():
    page = (EXAMPLES.parent / "docs" / "own-machine.md").read_text(encoding="utf-8")
    assert set(DEFAULTS) < set(KEYS)
    assert set(DEFAULT_WEIGHTS) == set(WEIGHTS)
    for key in (*KEYS, *WEIGHTS):
        assert f"`{key}`" in page or f"`[{key}]`" in page, key


def test_the_python_example_runs(tmp_path):
    script = EXAMPLES / "own_mjcf.py"
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 45
    done = subprocess.run(
        [sys.executable, str(script), "--no-video"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "PASS" in done.stdout
    assert "without: contacts" in done.stdout
    assert (tmp_path / "crane.npz").is_file()
