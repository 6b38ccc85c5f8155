"""problem.toml: what it says becomes the problem, and a plan holds all of it."""

import runpy

import numpy as np
import pytest
from carts import refuse, write
from machines import FAST_FINGER
from places import ROOT
from plan_files import contents, written
from problem_files import ARM, USUAL

import planner
from planner.cases.problem_file import load, of_table
from planner.cases.problem_file.keys import ATTACH, DEFAULTS, FOLLOW, GOAL, KEYS, PHASE, WEIGHTS
from planner.cases.problem_file.starter_file import write_first_problem
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.step_stability import fastest_mode, substeps_of
from planner.model.mjcf.model_file import open_model_file
from planner.problem.description import describe
from planner.problem.initial_guess import inverse_dynamics_controls
from planner.problem.rediscretize import finer

EXAMPLES = ROOT / "examples"


def test_the_example_converges_passes_and_is_the_same_in_python():
    problem, starts, seed, *_ = load(EXAMPLES / "crane.toml")
    assert (starts, seed) == (1, 0)
    plan = planner.solve(problem)
    assert plan.success
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    np.testing.assert_allclose(proof.replay.xs[-1], [2.0, 0.0, 0.0, 0.0], atol=1e-3)
    crane = planner.Mechanism.from_mjcf(EXAMPLES / "crane.xml", contacts="off")
    dynamics = planner.RigidBodyDynamics(crane, 0.02)
    cost = planner.TrackingCost.joints(
        dynamics, [2.0, 0.0, 0.0, 0.0], 200, effort=1.0, final_position=1e5, final_velocity=1e5
    )
    by_hand = planner.solve(
        planner.Problem(
            dynamics,
            cost,
            crane.home,
            us=problem.first_guess,
            limits=planner.Limits.of_model(),
            expected_reduction_tolerance=problem.expected_reduction_tolerance,
        )
    )
    np.testing.assert_array_equal(by_hand.us, plan.us)


def test_a_plan_needs_neither_file(tmp_path, monkeypatch):
    file = write(tmp_path)
    plan = planner.solve(load(file).problem)
    plan.save(tmp_path / "plan.npz")
    assert f"CONVERGED: {plan.problem.appearance.title}: " in repr(planner.load_plan(tmp_path / "plan.npz"))
    assert "problem-file" not in repr(plan)
    file.unlink()
    (tmp_path / "cart.xml").unlink()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    stored = planner.load_plan("../plan.npz")
    assert stored.problem is not None
    assert stored.problem.parameters == plan.parameters
    assert stored.problem.appearance == plan.problem.appearance
    np.testing.assert_array_equal(stored.problem.first_guess, plan.problem.first_guess)
    proofs = planner.prove(plan, rollouts=0), planner.prove(stored, rollouts=0)
    assert proofs[1].passed
    assert proofs[1].to_dict() == proofs[0].to_dict()


def test_a_damaged_table_is_refused(tmp_path):
    plan = planner.solve(load(write(tmp_path)).problem, max_iterations=2)
    plan.save(tmp_path / "plan.npz")
    arrays, meta = contents(tmp_path / "plan.npz")
    for key, value in (("dt", 0.1), ("goal", [1.0]), ("gaol", 1), ("weights", 3)):
        table = meta["recipe"]["parameters"] | {key: value}
        changed = meta | {"recipe": {"name": "problem-file", "parameters": table}}
        written(tmp_path / "changed.npz", arrays, changed)
        with pytest.raises(planner.base.errors.FileError, match=r"changed\.npz is damaged"):
            planner.load_plan(tmp_path / "changed.npz")


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
def test_states_are_given_by_joint(tmp_path, value, expected):
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
    assert load(path)[1:3] == (3, 5)
    problem, starts, seed, *_ = load(path, starts=2, seed=0)
    assert (starts, seed) == (2, 0)
    assert (problem.parameters["starts"], problem.parameters["seed"]) == (2, 0)


def test_the_goal_is_judged_where_a_final_weight_acts(tmp_path):
    free = "[weights]\nfinal_position = { slider = 1e4 }\nfinal_velocity = 0.0\n"
    heavy = planner.prove(planner.solve(load(write(tmp_path, free, goal="[1.0, 2.0]")).problem), rollouts=0)
    assert heavy.goal.passed  # the pole may be anywhere
    assert abs(heavy.replay.xs[-1, 1] - 2.0) > 0.5
    light = planner.prove(
        planner.solve(load(write(tmp_path, "[weights]\nfinal_position = 0.01\n")).problem), rollouts=0
    )
    assert light.verdict == "FAIL"
    assert "goal" in light.reason
    none = planner.prove(planner.solve(load(write(tmp_path, free.replace("1e4", "0.0"))).problem), rollouts=0)
    assert none.goal.not_applicable == "no goal was asked for"


def test_hold_holds():
    """A pose that the actuators can hold does not move; what they cannot reach is left alone."""
    arm = planner.cases.two_link().dynamics
    x = np.array([0.7, -0.4, 0.0, 0.0])
    np.testing.assert_allclose(arm.rates(x[None], quasi_static_controls(arm.mechanism, x)[None]), 0.0, atol=1e-12)
    crane = planner.Mechanism.from_mjcf(EXAMPLES / "crane.xml", contacts="off")
    assert quasi_static_controls(crane, np.array([0.0, 0.5, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-12)


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
    np.testing.assert_allclose(dynamics.rates(x, quasi_static_controls(servos, x[0])[None]), 0.0, atol=1e-11)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 20, 2))
    us = inverse_dynamics_controls(servos, q, qd, qdd)
    np.testing.assert_allclose(dynamics.rates(np.hstack([q, qd]), us)[:, 2:], qdd, atol=1e-9)


def test_hold_leaves_integrators_and_fills_filters():
    actuators = '<intvelocity joint="a" kp="50"/><general joint="b" dyntype="filter" dynprm="0.1" gainprm="4"/>'
    servos = planner.Mechanism.from_mjcf(SERVOS.format(actuators=actuators))
    x = np.zeros(6)
    u = quasi_static_controls(servos, x)
    assert u[0] == 0.0
    x[5] = u[1]  # once the filter has filled
    held = planner.dynamics.bias(servos, x[:2], x[2:4])[1]
    assert 4.0 * x[5] == pytest.approx(held)
    with pytest.raises(planner.PlannerError, match="fully actuated"):
        inverse_dynamics_controls(servos, *np.zeros((3, 5, 2)))


HINGE = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="arm"><joint name="hinge" axis="0 1 0" range="{range}" limited="true"/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02"/></body>{more}
  </worldbody><actuator><motor joint="hinge"/></actuator>{keyframes}</mujoco>"""
TWO_POSES = '<keyframe><key name="folded" qpos="1"/><key name="home" qpos="{}"/></keyframe>'
IN_THE_WAY = '<body name="ball" pos=".3 0 0"><joint name="other" axis="0 0 1"/><geom size=".1"/></body>'


@pytest.mark.parametrize(
    ("range", "more", "keyframes", "start"),
    [
        ("-2 2", "", TWO_POSES.format(0.5), 0.5),
        ("-2 2", "", TWO_POSES.format(3.0), 1.0),
        ("-2 2", "", "", 0.0),
        ("0.2 2", "", "", None),
        ("-2 2", IN_THE_WAY, "", None),
    ],
    ids=["home", "home is out of range, the first is not", "as it is drawn", "drawn out of range", "drawn overlapping"],
)
def test_a_start_that_nobody_names_is_the_models_and_said(tmp_path, range, more, keyframes, start):
    model, path = tmp_path / "hinge.xml", tmp_path / "hinge.toml"
    model.write_text(HINGE.format(range=range, more=more, keyframes=keyframes), encoding="utf-8")
    path.write_text('model = "hinge.xml"\ngoal = { hinge = 1.5 }\nduration = 1.0\n', encoding="utf-8")
    if start is None:
        why = "overlap by" if more else "as drawn, joint 'hinge' is at 0, outside of its range 0.2 to 2"
        refuse(path, "no key 'start'", why, 'exclude = [["ball", "arm"]]' if more else "has a start")
        return
    found = load(path)
    assert found.problem.x0[0] == start
    assert any(note.startswith("start is ") for note in found.notes)
    file = open_model_file(model)
    assert load(write_first_problem(tmp_path / "first.toml", model, file, describe(file))).problem.x0[0] == start


def test_every_key_is_described_and_documented():
    page = "".join((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("problem-file.md", "tasks.md"))
    assert set(DEFAULTS) < set(KEYS)
    for key in (*KEYS, *WEIGHTS, *GOAL, *FOLLOW, *ATTACH, *PHASE):
        assert f"`{key}`" in page or f"`[{key}]`" in page, key


def test_the_python_example_runs(tmp_path, monkeypatch, capsys):
    """Without the rollouts that it asks for, which take most of its time."""
    script = EXAMPLES / "own_mjcf.py"
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 45
    prove = planner.prove
    monkeypatch.setattr(planner, "prove", lambda plan, rollouts: prove(plan, rollouts=0))
    monkeypatch.setattr("sys.argv", [str(script), "--no-video"])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert "PASS" in printed
    assert "without: contacts" in printed
    assert (tmp_path / "crane.npz").is_file()


def stiff(folder, **keys):
    """The problem of a file whose machine needs several substeps."""
    (folder / "fast.xml").write_text(FAST_FINGER, encoding="utf-8")
    stages = {"duration": 0.4, "dt": 0.02} | keys
    lines = [f"{key} = {value}" for key, value in stages.items()]
    text = "\n".join(['model = "fast.xml"', "start = [0.0, 0.0]", "goal = [0.5, 0.2]", *lines])
    (folder / "fast.toml").write_text(text, encoding="utf-8")
    return load(folder / "fast.toml").problem


def test_stages_have_the_substeps_that_the_machine_needs(tmp_path):
    problem = stiff(tmp_path)
    mechanism, states = problem.dynamics.mechanism, [problem.x0, problem.cost.x_ref[-1]]
    found = fastest_mode(mechanism, states)
    assert problem.dynamics.substeps == substeps_of(found, 0.02) > 4
    assert finer(problem).dynamics.substeps == substeps_of(found, 0.01) < problem.dynamics.substeps
    back = planner.load_plan(planner.solve(problem).save(tmp_path / "plan.npz"))
    assert back.problem.dynamics.substeps == problem.dynamics.substeps
    assert stiff(tmp_path, integrator='"semi-implicit-euler"').dynamics.substeps == 1
    assert stiff(tmp_path, substeps=3).dynamics.substeps == 3
    with pytest.raises(planner.PlannerError, match=r"finger has a rate of .* expected dt = "):
        stiff(tmp_path, duration=4.0, dt=0.2, integrator='"rk4"')
    with pytest.raises(planner.PlannerError, match=r"substeps is 'fast', expected a whole number .*, or 'auto'"):
        stiff(tmp_path, substeps='"fast"')


def test_plans_of_before_there_were_substeps_have_none(tmp_path):
    problem = stiff(tmp_path)
    table = {name: value for name, value in problem.parameters.items() if name != "substeps"}
    assert of_table(table, problem.twin).dynamics.substeps == 1
    assert of_table(problem.parameters, problem.twin).dynamics.substeps == problem.dynamics.substeps


def test_an_angle_of_more_than_a_turn_may_be_meant_in_degrees(tmp_path):
    """180 on a hinge without a range is 28.6 turns: it is planned as written, and said."""
    (tmp_path / "arm.xml").write_text(ARM.format(**USUAL))
    for start, said in (("{ shoulder = 180 }", True), ("{ shoulder = 3.14 }", False)):
        (tmp_path / "p.toml").write_text(
            f'model = "arm.xml"\nstart = {start}\ngoal = {{ elbow = 0.5 }}\nduration = 1.0\n'
        )
        notes = " ".join(load(tmp_path / "p.toml").notes)
        assert ("28.6 turns; 180 degrees are 3.14159" in notes) == said
    (tmp_path / "p.toml").write_text(
        'model = "arm.xml"\nstart = {}\nduration = 1.0\n[[goal]]\njoints = { elbow = 90 }\n'
    )
    assert "goal 1 has joint 'elbow' at 90 rad" in " ".join(load(tmp_path / "p.toml").notes)
