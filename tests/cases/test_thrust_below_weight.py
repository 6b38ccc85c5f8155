"""A machine in the air whose thrusters push less than it weighs falls: refused where that is certain, else said."""

import pytest
from thrusters import QUADROTOR

import planner
from planner import PlannerError
from planner.cases.problem_file import load
from planner.problem.thrust import missing_thrust
from planner.proof.diagnostics import suggested_fixes

WEAK = QUADROTOR.replace('ctrlrange="0 4"', 'ctrlrange="0 1.4"')  # 4 of 1.4 N; it weighs 0.6 kg 9.81 m/s^2 = 5.886 N
AIR = WEAK.replace('integrator="RK4"', 'integrator="RK4" density="1.2" viscosity="1.8e-5"')


def problem_of(tmp_path, model, keys=""):
    (tmp_path / "drone.xml").write_text(model)
    text = 'model = "drone.xml"\nduration = 1.0\ngoal = { base = [0.2, 0, 0.7, 1, 0, 0, 0] }\n'
    (tmp_path / "problem.toml").write_text(text + keys)
    return load(tmp_path / "problem.toml").problem


def test_a_drone_that_is_too_heavy_for_its_rotors_is_refused(tmp_path):
    with pytest.raises(PlannerError, match=r"at most 5\.6 N of the 5\.89 N that the machine weighs"):
        problem_of(tmp_path, WEAK)


@pytest.mark.parametrize(
    "model",
    [
        QUADROTOR,
        WEAK.replace("0 0 1 0 0 0.016", "0 0 1.3 0 0 0.016"),  # two of 1.82 N and two of 1.4 N: 6.44 N
        WEAK.replace('<option timestep="0.005"', '<option gravity="0 0 0" timestep="0.005"'),
        WEAK.replace('diaginertia="3e-3 3e-3 5e-3"/>', 'diaginertia="3e-3 3e-3 5e-3"/>').replace(
            '<body name="frame"', '<body name="frame" gravcomp="0.1"'),
    ],
    ids=["strong", "two stronger", "weightless", "a balloon"],
)  # fmt: skip
def test_what_carries_itself_or_may_is_not_refused(tmp_path, model):
    assert missing_thrust(problem_of(tmp_path, model)) is None


def test_a_goal_that_it_may_fall_through_is_not_refused(tmp_path):
    """What has to be anywhere at any velocity may fall; (1 - 5.6 / 5.886) 9.81 m/s^2 in a second is 0.48 m/s."""
    assert missing_thrust(problem_of(tmp_path, WEAK, "tolerance = { velocity = 1.0 }\n"))


def test_one_that_air_may_carry_is_planned_once_and_said_to_fall(tmp_path):
    problem = problem_of(tmp_path, AIR)
    plan = planner.solve(problem)
    assert not plan.success
    assert "relaxation" not in plan.options  # no duration and no other guess carries it
    (fix,) = suggested_fixes(plan)
    assert (fix.code, fix.value) == ("thrust_below_weight", None)
    assert fix.values["thrust"].value == pytest.approx(5.6)
