"""suggested_fixes(): a least time that was sought where no duration suffices is a matter of durations or forces."""

import pytest

import planner
from planner.proof.diagnostics import suggested_fixes

SLIDE = """<mujoco><option gravity="0 0 {gravity}"/><worldbody><body><joint name="z" type="slide" axis="0 0 1"/>
  <geom type="box" size=".1 .1 .1" mass="2"/></body></worldbody>
  <actuator><motor joint="z" ctrlrange="{least} {most}"/></actuator></mujoco>"""


def found_for(tmp_path, **slide):
    (tmp_path / "slide.xml").write_text(SLIDE.format(**slide))
    (tmp_path / "problem.toml").write_text('model = "slide.xml"\ngoal = { z = 1.0 }\nduration = 1.0\n')
    problem = planner.load_problem(tmp_path / "problem.toml")
    plan = planner.solve_for(problem, "time", durations=(0.3, 1.0))
    assert not plan.converged
    return problem, suggested_fixes(plan, planner.prove(plan, rollouts=0))


def test_longer_durations_for_a_search_whose_longest_is_too_short(tmp_path):
    """5 N take 2 kg over 1 m in 2 sqrt(2 / 5) s; a smooth motion that leaves a tenth in sqrt(5.774 2 / 4.5) s."""
    problem, (found,) = found_for(tmp_path, gravity=0, least=-5, most=5)
    assert (found.key, found.code) == ("durations", "too_little_force")
    assert found.value == [0.3, pytest.approx((5.774 * 2.0 / 4.5) ** 0.5, abs=0.11)]
    assert found.values["duration"].value == 1.0
    assert found.written == "`--durations {:g},{:g}`".format(*found.value)  # the file names no objective
    plan = planner.solve_for(problem, "time", durations=found.value)
    assert plan.converged
    assert plan.t[-1] == pytest.approx(2.0 * (2.0 / 5.0) ** 0.5, rel=0.01)


def test_no_duration_for_a_search_whose_motor_cannot_lift(tmp_path):
    """19.62 N hold it, and no weight makes 15 N of them."""
    _, (found,) = found_for(tmp_path, gravity=-9.81, least=0, most=15)
    assert (found.code, found.value) == ("force_never_enough", None)
    assert found.values["needed"].value == pytest.approx(19.62, rel=0.01)
