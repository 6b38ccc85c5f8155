"""suggested_fixes(): what a FAIL says to write is computed, and with it the plan passes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from problem_files import ARM, POLE, USUAL, arm, cured, file, tried, without_limits

import planner
from planner import SolverOptions
from planner.proof.diagnostics import SuggestedFix, longer, suggested_fixes
from planner.proof.diagnostics.solving import clamped_between, not_a_minimum, rounded_step
from planner.proof.diagnostics.suggested_fix import rounded_up


def passes_with(problem, *keys):
    """That a plan passes with cures of these keys, one after the other; returns the first."""
    given = []
    for key in keys:
        plan, proof = tried(problem)
        assert proof is None or not proof.passed
        found = suggested_fixes(plan, proof)
        assert found, proof and proof.reason
        assert found[0].key == key, (found[0].sentence, proof and proof.reason)
        assert found[0].written.startswith("`")
        given.append(found[0])
        problem = cured(problem, found[0])
    plan, proof = tried(problem)
    assert proof is not None
    assert proof.passed, (given[-1].sentence, proof.reason)
    assert suggested_fixes(plan, proof) == ()
    return given[0]


def test_a_goal_that_is_asked_for_too_little(tmp_path):
    first = passes_with(arm(tmp_path, weights={"final_position": 20}), "weights.final_position")
    assert first.value > 20.0
    assert first.code == "goal_missed"
    assert first.values["miss"].unit == "rad"
    assert first.written == f"`weights.final_position = {first.value}`"


def test_position_and_velocity_that_are_missed_are_one_fix(tmp_path):
    """A larger weight of one of them alone is met by missing the other by more."""
    first = passes_with(arm(tmp_path, weights={"final_position": 20, "final_velocity": 2}), "weights")
    assert set(first.value) == {"final_position", "final_velocity"}
    assert first.value["final_position"] > 20.0
    assert first.value["final_velocity"] > 2.0


def test_a_weight_by_joint_stays_one_by_joint(tmp_path):
    problem = arm(tmp_path, weights={"final_position": "{ shoulder = 20.0, elbow = 1e4 }"})
    first = passes_with(problem, "weights.final_position")
    assert first.value["elbow"] == 1e4
    assert first.value["shoulder"] > 20.0


def test_a_stage_that_is_too_long(tmp_path):
    first = passes_with(arm(tmp_path, goal="[-2.0, 2.5]", dt="0.2"), "dt")
    assert first.value < 0.2
    assert (first.code, first.values["dt"]) == ("stage_too_long", (0.2, "s"))


def test_an_integrator_of_first_order(tmp_path):
    first = passes_with(arm(tmp_path, integrator='"euler"'), "integrator")
    assert first.value == "rk4"


def test_a_range_that_the_plan_does_not_know(tmp_path):
    # the cart goes back before it goes forward, or the pole falls
    model = POLE.format(slider='limited="true" range="-0.02 1"')
    weights = {"final_position": 1e5, "final_velocity": 1e5}
    problem = file(tmp_path, model, {"goal": "[0.5, 0.0]", "duration": "2.0"}, weights)
    first = passes_with(without_limits(problem), "limits.position")
    assert first.value == "model"
    assert (first.code, first.values["limit"].value) == ("range_unknown", -0.02)


def test_a_clamp_that_the_plan_does_not_know(tmp_path):
    problem = arm(tmp_path, model={"gravity": 0, "motor": 'ctrllimited="true" ctrlrange="-0.6 0.6"'})
    first = passes_with(without_limits(problem), "limits.control")
    assert first.value == "model"
    assert (first.code, first.values["lower"], first.values["upper"]) == ("clamp_unknown", -0.6, 0.6)


TIGHT, WEAK = (
    {"control": '"model"', "velocity": 0.82},
    {"gravity": 0, "motor": 'ctrllimited="true" ctrlrange="-1 1"', "elbow": 'armature="0.2"'},
)


def test_too_little_time_for_a_motor(tmp_path):
    problem = arm(
        tmp_path,
        limits={"control": '"model"'},
        model={"gravity": 0, "motor": 'ctrllimited="true" ctrlrange="-0.4 0.4"'},
    )
    first = passes_with(problem, "duration")
    # without gravity the forces fall with the square of the duration
    assert 1.0 < first.value < 3.0
    assert (first.code, first.values["actuator"]) == ("too_little_force", "actuator 'at shoulder'")


def test_too_little_time_for_a_speed(tmp_path):
    """The motors leave no time to speed up. A limit below the mean speed of 0.8 rad in 1 s would be refused."""
    problem = arm(tmp_path, limits=TIGHT, model=WEAK)
    first = passes_with(problem, "duration")
    # 15/8 of the mean speed, and 0.9 of 0.82 rad/s
    assert first.value == pytest.approx(15.0 / 8.0 * 0.8 / 0.738, rel=0.1)
    assert first.code == "too_little_speed"


def test_an_infeasible_plan_without_a_duration_that_passes_gets_one(tmp_path):
    """Where longer durations were tried in vain (up to 2.1 times), it is that of a smooth motion."""
    plan = planner.solve(arm(tmp_path, limits=TIGHT, model=WEAK), SolverOptions(homotopy=False))
    vain = replace(plan, status=planner.Status.INFEASIBLE, options=plan.options | {"relaxation": {"factor": 2.0}})
    (found,) = [one for one in suggested_fixes(vain) if one.key == "duration"]
    assert found.code == "too_little_speed"
    known = replace(vain, options=plan.options | {"relaxation": {"factor": 2.0, "duration": 1.7}})
    (found,) = [one for one in suggested_fixes(known) if one.key == "duration"]
    assert (found.code, found.value) == ("infeasible", 1.7)


def test_no_time_helps_a_motor_that_cannot_hold_the_goal(tmp_path):
    problem = arm(
        tmp_path, limits={"control": '"model"'}, model={"motor": 'ctrllimited="true" ctrlrange="-1 1"'}
    )  # fmt: skip
    plan = planner.solve(problem, SolverOptions(homotopy=False))  # of the file's duration alone
    found = suggested_fixes(plan, planner.prove(plan, rollouts=0))[0]
    assert found.value is None
    assert (found.code, found.values["duration"]) == ("force_never_enough", (10.0, "s"))


@pytest.mark.parametrize("most", [10, pytest.param(150, marks=pytest.mark.slow)])
def test_no_time_helps_a_hip_that_cannot_carry_the_machine_on_one_foot(tmp_path, most):
    """A standing hip of the biped carries some 30 kg that are 0.09 m beside it: 20 N m or more."""
    model, range_ = (ROOT / "examples" / "tasks" / "biped.xml").read_text(), 'joint="left_roll" ctrlrange="{} {}"'
    assert range_.format(-150, 150) in model
    (tmp_path / "biped.xml").write_text(model.replace(range_.format(-150, 150), range_.format(-most, most)))
    lift = (ROOT / "benchmarks" / "moving" / "biped-lift.toml").read_text()
    (tmp_path / "lift.toml").write_text('guess = "hold"\n' + lift.replace("../../examples/tasks/", ""))
    problem = planner.load_problem(tmp_path / "lift.toml")
    plan = planner.solve(problem, SolverOptions(homotopy=False, max_iterations=2))
    fixes = suggested_fixes(replace(plan, status=planner.Status.OUTSIDE_LIMITS))
    if most > 10:
        assert "pose_never_held" not in [one.code for one in fixes]
        return
    found = fixes[0]
    assert (found.code, found.value) == ("pose_never_held", None)
    assert 15.0 < abs(found.values["needed"].value) < 60.0
    assert abs(found.values["limit"].value) == 10.0


def test_a_servo_whose_gear_ends_its_range_before_the_goal_is_named(tmp_path):
    """Classes pass a motor's gear on to servos: a ctrlrange of 3.14 is 0.2 rad of the joint then."""
    motor, servo = '<motor name="at elbow" joint="elbow" {motor}/>', '<position name="at elbow" joint="elbow" kp="60"'
    model = ARM.replace(motor, f'{servo} dampratio="1" gear="15" ctrllimited="true" ctrlrange="-3.14 3.14"/>')
    keys = {"goal": "[-0.5, 0.8]"}
    problem = file(tmp_path, model.format(**USUAL | {"gravity": 0}), keys, limits={"control": '"model"'})
    plan = planner.solve(problem, SolverOptions(homotopy=False))
    found = suggested_fixes(replace(plan, status=planner.Status.OUTSIDE_LIMITS))[0]
    assert (found.code, found.values["actuator"]) == ("servo_ends", "actuator 'at elbow'")
    assert found.values["limit"].value == pytest.approx(60.0 * (3.14 - 15.0 * 0.8), rel=1e-3)  # towards its range


def test_a_goal_in_a_wall_and_a_way_through_it(tmp_path):
    # least effort swings the arm beyond its goal
    wall = '<geom name="wall" type="box" size="0.05 0.5 0.5" pos="-0.06 0 0.75"/>'
    model = {"gravity": 0, "world": wall, "collides": ""}
    problem = arm(tmp_path, goal="[-1.5707963, 0.0]", contacts='"off"', model=model)
    first = suggested_fixes(*tried(problem))[0]
    assert (first.code, first.value) == ("goal_collides_anyhow", None)
    assert first.values == {"pair": "geom 'wall' and geom 'upper'", "depth": (pytest.approx(0.02), "m")}
    free = arm(tmp_path, goal="[-1.45, 0.0]", contacts='"off"', model=model)
    passes_with(free, "avoid")


def test_a_solve_that_was_stopped_early(tmp_path):
    problem = arm(tmp_path, goal="[-2.0, 2.5]")
    plan, proof = tried(problem, max_iterations=2)
    assert not proof.passed
    first = suggested_fixes(plan, proof)[0]
    assert first.key == "max_iterations"
    assert first.applied(problem.parameters) == problem.parameters  # a flag, no key of the file
    assert tried(problem, max_iterations=first.value)[1].passed


def test_a_plan_that_passes_needs_no_cure(tmp_path):
    assert suggested_fixes(*tried(arm(tmp_path))) == ()


def test_a_stage_that_is_too_long_for_a_fast_rate():
    # x' = 1000 x: four terms of e^100 are 4e6 in each of a hundred stages; gains hold it, and costates overflow
    fast = planner.FunctionDynamics(lambda x, u: 1000.0 * x + u, 1, 1, 0.1)
    problem = planner.Problem(fast, planner.TrackingCost.reach([0.0], 100, final=1.0, effort=1.0), [1.0])
    plan = planner.solve(problem)
    assert plan.status is planner.Status.NOT_FINITE
    first = suggested_fixes(plan)[0]
    assert (first.key, first.value) == ("dt", 0.001)
    assert (first.code, first.written) == ("rate_too_fast", "`FunctionDynamics(..., dt=0.001)`")


def test_a_margin_grows_by_what_a_joint_was_beyond_it(tmp_path):
    # knots of 0.25 s keep the range, the motion between them does not
    model = POLE.format(slider='limited="true" range="-0.02 1"')
    weights = {"final_position": 1e5, "final_velocity": 1e5}
    keys = {"goal": "[0.5, 0.0]", "duration": "2.0", "dt": "0.25", "substeps": "1"}
    problem = file(tmp_path, model, keys, weights, {"position": '"model"', "margin": 0.0})
    plan, proof = tried(problem, options=SolverOptions(max_tightenings=0))  # else the solver sees to it
    stage, margin = suggested_fixes(plan, proof)
    assert (stage.key, margin.key) == ("dt", "limits.margin")
    beyond = -0.02 - plan.between_knots(20)[:, 0].min()
    assert 1.4 * beyond < margin.value < 10.0 * beyond
    assert tried(cured(problem, stage))[1].passed
    _, proof = tried(cured(problem, margin))
    assert proof.your_file.measured[1].passed


def test_what_was_ignored_and_matters(tmp_path):
    loss = 'frictionloss="3"'
    problem = arm(tmp_path, ignore='["frictionloss"]', model={"shoulder": loss, "elbow": loss})
    first = suggested_fixes(*tried(problem))[0]
    assert (first.key, first.value) == ("ignore", [])
    assert first.values["ignored"] == "frictionloss"


def test_a_floor_that_was_taken_away(tmp_path):
    text = """
    <mujoco>
      <worldbody>
        <geom name="floor" type="plane" size="1 1 0.1"/>
        <body pos="0 0 0.35">
          <joint name="height" type="slide" axis="0 0 1"/>
          <geom type="sphere" size="0.1"/>
          <body pos="0 0 -0.1">
            <joint name="leg" type="slide" axis="0 0 1"/>
            <geom name="foot" type="sphere" size="0.05" pos="0 0 -0.15"/>
          </body>
        </body>
      </worldbody>
      <actuator><motor name="push" joint="leg"/></actuator>
    </mujoco>
    """
    problem = file(tmp_path, text, {"goal": "[0.0, -0.05]", "contacts": '"off"', "duration": "0.5"})
    first = suggested_fixes(*tried(problem))[0]
    assert (first.key, first.value) == ("contacts", "ground")
    assert first.values["pair"] == "geom 'floor' and geom 'foot'"


def test_the_table_of_a_file_is_copied_and_given_what_is_missing():
    table = {"weights": {"effort": 1.0}, "dt": 0.01}
    cured = SuggestedFix("", key="limits.margin", value=0.02).applied(table)
    assert cured == table | {"limits": {"margin": 0.02}}
    assert SuggestedFix("", key="weights.effort", value=2.0).applied(table)["weights"] == {"effort": 2.0}
    assert table == {"weights": {"effort": 1.0}, "dt": 0.01}
    assert SuggestedFix("", key="goal").applied(table) == table


def test_steps_are_those_that_people_write():
    assert [rounded_step(2.0, most) for most in (0.013, 0.0049, 0.3, 2e-4)] == [0.01, 0.004, 0.25, 2e-4]
    # 0.7 s holds no whole number of 0.2 or of 0.25
    assert rounded_step(0.7, 0.3) == 0.1
    assert rounded_step(1.0 / 3.0, 0.1) == pytest.approx(1.0 / 12.0)


def test_numbers_are_rounded_up():
    assert [rounded_up(value) for value in (0.0123, 20.0, 961.0, 0.0)] == [0.02, 20.0, 1000.0, 0.0]


@pytest.mark.slow
def test_a_swing_up_that_hangs_on_its_motor_needs_time_and_no_weight(tmp_path):
    model = POLE.format(slider='limited="true" range="-1 1"').replace(
        'joint="slider"', 'joint="slider" ctrlrange="-4 4"'
    )
    keys = {"start": "[0.0, 3.14159]", "goal": "[0.0, 0.0]", "duration": "0.8"}
    weights = {"effort": 0.06, "final_position": 1e4, "final_velocity": 1e3}
    problem = file(tmp_path, model, keys, weights, {"control": '"model"', "position": '"model"'})
    found = suggested_fixes(*tried(problem))
    assert [one.key for one in found][:2] == ["duration", "weights"]
    assert found[0].code == "infeasible"  # it passes from swings in a longer duration
    value = found[0].value
    assert longer(problem, found[0]).value > 1.4 * value


def test_a_motor_that_cannot_lift_straight_may_swing(tmp_path):
    model = """
    <mujoco><worldbody><body>
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="sphere" size="0.05" pos="0 0 0.5" mass="1" contype="0" conaffinity="0"/>
    </body></worldbody><actuator><motor name="weak" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>
    """
    keys = {"start": "[3.14159]", "goal": "[0.0]", "duration": "1.0"}
    problem = file(tmp_path, model, keys, {"effort": 1.0}, {"control": '"model"'})
    first = suggested_fixes(*tried(problem))[0]
    assert first.key == "duration"  # and no sentence that no duration helps
    assert first.code == "at_bounds"


@pytest.mark.slow
def test_a_way_that_is_not_free_goes_around(tmp_path):
    post = '<geom name="post" type="box" size="0.05 0.5 0.05" pos="0.45 0 0.45"/>'
    model = {"gravity": 0, "world": post, "collides": ""}
    keys = {"contacts": '"avoid"', "goal": "[-1.4, 0.0]"}
    problem = arm(
        tmp_path, weights={"velocity": 1.0, "final_position": 1e5, "final_velocity": 1e4}, model=model, **keys
    )
    first = passes_with(problem, "avoid")
    assert first.value == {}
    assert (first.code, first.written) == ("path_collides", "`avoid = {}`")


def test_every_fail_says_something(tmp_path, monkeypatch):
    """Also one of which no cause is found, and one that is no minimum though its solve ended."""
    plan, proof = tried(arm(tmp_path, goal="[-2.0, 2.5]"), max_iterations=2)
    monkeypatch.setattr("planner.proof.diagnostics._CAUSES", ())
    (only,) = suggested_fixes(plan, proof)
    assert (only.code, only.value) == ("unknown", None)
    assert f"give the motion more than {plan.problem.duration:g} s" in only.sentence  # a next step in any case
    assert not_a_minimum(plan, plan.problem, proof) == []  # it was cut
    (left,) = not_a_minimum(replace(plan, status=planner.Status.CONVERGED), plan.problem, proof)
    assert (left.code, left.value) == ("not_a_minimum", None)


@pytest.mark.parametrize(
    ("goal", "more", "asked"),
    [
        ("goal = { root = [0.4, 0, 0.326, 1, 0, 0, 0] }", "", ["trot"]),
        ("goal = { root = [0.4, 0, 0.326, 1, 0, 0, 0] }", 'gait = "trot"', []),
        pytest.param(
            'goal = [{ frame = "trunk", position = [0, 0, 0.5], share = 0.5, through = true }, { joints = "stand" }]',
            "",
            [],
            marks=pytest.mark.slow,
        ),
    ],
    ids=["elsewhere", "by a gait", "a jump"],
)
def test_a_quadruped_that_is_to_be_elsewhere_is_offered_a_gait(tmp_path, goal, more, asked):
    scene = (ROOT / "mjcf" / "quadruped" / "scene.xml").as_posix()
    (tmp_path / "p.toml").write_text(f'model = "{scene}"\nstart = "stand"\nduration = 1.5\n{goal}\n{more}\n')
    problem = planner.load_problem(tmp_path / "p.toml")
    x = problem.x0.copy()
    x[0] += 0.4  # as if the solve had brought it there, and failed in another way
    plan = planner.solve(problem, max_iterations=1, options=SolverOptions(homotopy=False))
    plan = replace(plan, xs=np.concatenate([plan.xs[:-1], x[None]]))
    found = [one.value for one in suggested_fixes(plan) if one.key == "gait"]
    assert found == asked


def test_forces_that_only_the_stage_adds_need_a_shorter_one(tmp_path):
    """The replay with gains is right, and in the file an actuator is clamped within a stage: half of it is tried."""
    problem = arm(tmp_path)
    right = SimpleNamespace(passed=True)
    failures = [SimpleNamespace(name="clamped_actuators")]
    proof = SimpleNamespace(
        refined_feedback=right, plan=right, goal=right, your_file=SimpleNamespace(failures=failures)
    )  # fmt: skip
    (found,) = clamped_between(None, problem, proof)
    assert (found.key, found.value) == ("dt", pytest.approx(0.5 * problem.dynamics.dt))
    proof.your_file.failures = [*failures, SimpleNamespace(name="unknown_stops")]
    assert clamped_between(None, problem, proof) == []
