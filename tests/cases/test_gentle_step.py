"""A gentler robot for the human step: jerk and force as weights, what they change, proof, files, refusals."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from walks import CYCLE, SWING

import planner
from planner.__main__ import main
from planner.cases import human_step
from planner.cases.human_step.case import CHANGE, FORCE, MOMENT, weight
from planner.cases.human_step.measures import CLEAR, measures, robot, robot_wrench
from planner.cases.human_step.walker import PELVIS, Walker

LIMIT = 100  # iterations


@pytest.fixture(scope="module")
def plans():
    """Swing and cycle of the default cost: sparing of accelerations, of jerk, of force."""
    sparing = {"acceleration": {}, "jerk": {"jerk": 1.0}, "force": {"force": 1.0}}
    wanted: list[tuple[Any, str]] = [("swing", name) for name in sparing]
    wanted += [("cycle", "acceleration"), ("cycle", "jerk")]
    return {
        (phase, name): planner.solve(human_step(phase=phase, **sparing[name]), max_iterations=LIMIT)
        for phase, name in wanted
    }


def robot_of(plan):
    return robot(plan.problem.dynamics, plan.xs, plan.us)


def away(plan, phase):
    """deg, RMS over the legs' joints from the normal gait."""
    found = measures({"swing": SWING, "cycle": CYCLE}[phase], plan.xs)
    return np.sqrt(np.mean(np.square(list(found.rms.values()))))


# jerk


@pytest.mark.parametrize("phase", ["swing", "cycle"])
def test_a_weight_of_jerk_makes_a_smoother_robot(plans, phase):
    """Less than half of the jerk, at least a quarter less of the largest force, for a degree of tracking at most."""
    usual, smooth = plans[phase, "acceleration"], plans[phase, "jerk"]
    assert usual.success
    assert smooth.success
    before, after = robot_of(usual), robot_of(smooth)
    assert after.jerk[0] < 0.5 * before.jerk[0]
    assert after.twitch[0] < 0.5 * before.twitch[0]
    assert after.force[1] < 0.75 * before.force[1]
    assert after.moment[1] < 0.75 * before.moment[1]
    assert away(usual, phase) < away(smooth, phase) < away(usual, phase) + 1.0
    found = measures({"swing": SWING, "cycle": CYCLE}[phase], smooth.xs)
    assert min(found.clearance.values()) > CLEAR


def test_jerk_converges_with_the_studys_cost():
    plan = planner.solve(human_step(phase="swing", cost="study", jerk=1.0), max_iterations=LIMIT)
    assert plan.success
    assert plan.nit < 60


def test_more_weight_means_less_jerk(plans):
    jerks = [robot_of(plans["swing", "jerk"]).jerk[0]]
    plan = planner.solve(human_step(phase="swing", jerk=10.0), max_iterations=LIMIT)
    assert plan.success
    jerks.append(robot_of(plan).jerk[0])
    assert jerks[0] > 1.5 * jerks[1]


def test_jerk_and_force_are_weighed_as_documented(plans):
    """J is affine in both weights: jerk those of controls, effort those of accelerations, by their tolerances."""
    plan = plans["swing", "jerk"]
    xs, us, J = plan.xs, plan.us, plan.problem.cost.value(plan.xs, plan.us)

    def more(**given):
        return human_step(phase="swing", **{"jerk": 1.0} | given).cost.value(xs, us) - J  # type: ignore[arg-type]

    tolerances, share = np.repeat([5.0, 40.0], 3), 0.004 / 0.4  # m/s^2 and rad/s^2; dt over the period
    jerk = 0.5 * share * np.sum((us * CHANGE / tolerances) ** 2)
    assert more(jerk=2.0) == pytest.approx(jerk)
    a = xs[:, -6:]
    final = a[-1] - SWING.accelerations[-1]
    effort = 0.5 * share * np.sum((a[:-1] / tolerances) ** 2) + 0.5 * np.sum((final / tolerances) ** 2)
    assert more(effort=2.0) == pytest.approx(effort)


def test_a_gentle_step_starts_on_the_normal_gait():
    """With its accelerations; and the first guess goes on with them."""
    problem = human_step(jerk=1.0)
    np.testing.assert_array_equal(problem.x0[-6:], CYCLE.accelerations[0])
    np.testing.assert_allclose(problem.x0[:-6], CYCLE.states[0])
    led = problem.x0[-6:] + 0.005 * np.cumsum(problem.first_guess, axis=0)
    np.testing.assert_allclose(led, CYCLE.accelerations[1:], atol=1e-9)


def test_the_model_is_that_of_prescribed_accelerations(plans):
    """The robot's wrench, and the legs' accelerations, but for what the robot feels over 1e8 kg."""
    plan, led = plans["cycle", "jerk"], human_step().dynamics
    xs, a = np.ascontiguousarray(plan.xs[:, :-6]), plan.xs[:-1, -6:]
    jerked = plan.problem.dynamics
    mine, theirs = jerked.rates(plan.xs[:-1], plan.us), led.rates(xs[:-1], a)  # type: ignore[attr-defined]
    np.testing.assert_allclose(mine[:, 17:34], theirs[:, 17:], atol=1e-3)
    wrench = robot_wrench(led, xs, a)  # type: ignore[arg-type]
    np.testing.assert_allclose(robot_wrench(jerked, plan.xs, plan.us), wrench, atol=1e-2)  # of 1000 N


@pytest.mark.parametrize("phase", ["swing", pytest.param("cycle", marks=pytest.mark.slow)])
def test_mujoco_repeats_the_gentle_step(plans, phase):
    """PASS, and as near as without a weight of jerk; gains act on the accelerations, too."""
    plan = plans[phase, "jerk"]
    assert plan.K.shape[1:] == (6, len(plan.xs[0]))
    assert np.abs(plan.K[:, :, -6:]).max() > 1.0
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.table()
    for section, bound in ((proof.refined_open_loop, 0.7), (proof.refined_feedback, 0.35)):
        error = next(figure for figure in section.measured if figure.name == "joint_error")
        assert error.value < bound
    force = next(figure for figure in proof.goal.measured if figure.name == "planned_robot_force")
    assert force.value == pytest.approx(robot_of(plan).force[1])


def test_a_plan_of_jerk_is_stored_and_loaded(plans, tmp_path):
    plan = plans["swing", "jerk"]
    plan.save(tmp_path / "plan.npz")
    read = planner.load_plan(tmp_path / "plan.npz")
    assert read.problem is not None
    assert read.problem.parameters["jerk"] == 1.0
    assert read.problem.cost.value(read.xs, read.us) == plan.problem.cost.value(plan.xs, plan.us)
    np.testing.assert_array_equal(read.K, plan.K)


@pytest.mark.slow
def test_a_gait_returns_to_its_accelerations():
    """What must come back is all but the belt, the accelerations among it; a pass answers to them as to the rest."""
    problem = human_step(phase="gait", jerk=1.0)
    assert problem.periodic is not None
    assert np.flatnonzero(~problem.periodic.periodic_mask).tolist() == [0, 17]
    plan = planner.solve_periodic(problem, passes=2)
    closed = problem.periodic.closure_error(plan.space, plan.xs)[-6:]
    first = planner.solve(problem)
    assert np.abs(closed).max() < np.abs(problem.periodic.closure_error(first.space, first.xs)[-6:]).max()


# force


def test_a_weight_of_force_in_motion_mode(plans):
    """Less of what the robot does beyond carrying, RMS and largest, for little tracking."""
    usual, spared = plans["swing", "acceleration"], plans["swing", "force"]
    assert spared.success

    def effort(plan):
        wrench = robot_wrench(plan.problem.dynamics, plan.xs, plan.us)
        wrench[:, 2] -= weight(SWING.walker)
        return np.mean((wrench / np.repeat([FORCE, MOMENT], 3)) ** 2)

    assert effort(spared) < 0.9 * effort(usual)
    assert robot_of(spared).force[1] < robot_of(usual).force[1]
    assert away(spared, "swing") < away(usual, "swing") + 0.5
    extra = human_step(phase="swing", force=2.0).cost.value(usual.xs, usual.us) - usual.cost
    assert extra == pytest.approx(0.5 * 2.0 * 114 * 0.004 / 0.4 * 6.0 * effort(usual))


def test_jerk_is_weighed_alike_with_forces_as_controls(plans):
    """With hardly a weight of accelerations left, the plan of pelvis="force", but for what is held over a stage."""
    free = planner.solve(human_step(phase="swing", pelvis="force"))
    led = planner.solve(human_step(phase="swing", force=1.0, effort=0.01), max_iterations=LIMIT)
    assert led.success
    assert led.cost == pytest.approx(free.cost, rel=0.03)
    step = dataclasses.replace(SWING, walker=Walker(legs=("right",), belt=False, motors=True))
    assert measures(step, free.xs).rms["right_knee"] == pytest.approx(
        measures(SWING, led.xs).rms["right_knee"], abs=0.7
    )


def test_mujoco_follows_a_swing_that_is_sparing_of_force(plans):
    error = np.degrees(planner.replay(plans["swing", "force"], feedback=True).error[:, 6:11])
    assert np.sqrt(np.mean(error**2)) < 0.35


def test_measures_of_a_robot():
    """A pelvis that accelerates steadily: no jerk, and Newton's law for what is carried."""
    dynamics = human_step(phase="swing").dynamics
    us = np.tile([1.0, 0.0, 2.0, 0.0, 0.0, 0.0], (4, 1))
    xs = np.tile(SWING.states[0], (5, 1))
    found = robot(dynamics, xs, us)  # type: ignore[arg-type]
    assert found.jerk == found.twitch == (pytest.approx(0.0, abs=1e-9),) * 2
    assert found.acceleration == (pytest.approx(5.0**0.5),) * 2
    assert found.force[0] == pytest.approx(found.force[1])
    assert len(PELVIS) == us.shape[1]


# what a user may type


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"jerk": -1.0}, "jerk is -1.0, expected a finite number of at least 0 and at most 1000"),
        ({"jerk": 1e-5}, "jerk is 1e-05, expected 0 or at least 0.001"),
        ({"force": float("nan")}, "force is nan"),
        ({"jerk": 1.0, "pelvis": "force"}, "jerk is 1 with pelvis='force', expected 0: effort weighs the forces there"),
        ({"force": 2.0, "pelvis": "force"}, "force is 2 with pelvis='force'"),
        ({"force": 2.0, "jerk": 1.0}, "jerk is 1 and force is 2, expected one of the two to be 0"),
        ({"effort": 0.0}, "effort is 0.0, expected a finite number of at least 0.001"),
    ],
)
def test_bad_input_is_refused(given, said):
    with pytest.raises(planner.PlannerError, match=said):
        human_step(**given)


def test_on_the_command_line(tmp_path, capsys):
    out = tmp_path / "plan.npz"
    assert main(["solve", "human-step", "--phase", "swing", "--jerk", "1", "--out", str(out), "--quiet"]) == 0
    assert planner.load_plan(out).parameters["jerk"] == 1.0
    assert main(["solve", "human-step", "--jerk", "1", "--force", "1", "--out", str(out)]) == 2
    assert "expected one of the two to be 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("objective", "said"),
    [
        ("energy", "the acceleration of pelvis_x, .* is prescribed, expected a machine that its actuators alone move"),
        ("jerk", "the jerk of pelvis_x, .* is the control already, expected it to be weighed as such"),
    ],
)
def test_objectives_of_all_joints_are_refused_where_jerk_drives(objective, said):
    """Motors that move 1e8 kg do no work that is anybody's, and touch-downs are not the robot's jerk."""
    with pytest.raises(planner.PlannerError, match=said):
        planner.costs.with_objective(human_step(phase="swing", jerk=1.0), objective)
