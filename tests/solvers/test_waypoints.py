"""Via points without times: in order, passed when it fits best, against a closed form and a spline's own optimum."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import planner
from planner import Goal
from planner.cases.problem_file import load

CART = """<mujoco><option gravity="0 0 0"/><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
  <geom type="sphere" size="0.1" mass="1"/></body></worldbody>
  <actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
ONE = [Goal(joints={"x": 1.0}, through=True), Goal(joints={"x": 0.5})]
N = 60


def there_and_half_back(**keys):
    """From 0 by way of 1 m to 0.5 m, from rest to rest, 1 kg and 1 N."""
    cart = planner.Mechanism.from_mjcf(CART)
    return planner.task(cart, start={"x": 0.0}, goals=ONE, duration=4.0, dt=4.0 / N, **keys)


def share(plan):
    return plan.parameters["goal"][0]["share"]


def test_the_first_times_are_in_proportion_to_the_way():
    problem = there_and_half_back()
    assert share(problem) == round(N * 1.0 / 1.5) / N
    assert "at 2.67 s, in proportion" in problem.parameters["resolved"]["reasons"]["goal"]
    assert planner.solve(problem).success


def test_least_time_is_that_of_two_bang_bang_legs():
    """2 s to 1 m, where it turns, and 2 sqrt(0.5) s to 0.5 m. A tolerance of 5 mm saves a hundredth of a second."""
    plan = planner.solve_for(there_and_half_back(), "time", durations=(1.0, 8.0))
    least = 2.0 + 2.0 * np.sqrt(0.5)
    assert plan.success
    assert least - 0.02 < plan.t[-1] < 1.01 * least
    assert share(plan) == pytest.approx(2.0 / least, abs=2.0 / N)
    assert planner.prove(plan, rollouts=0).passed


def test_a_search_of_times_that_is_interrupted_returns_its_best_plan():
    """The second search of the duration is of other times of the via point."""
    searches = []

    def callback(line):
        searches.append(line)
        if sum(line.number == 0 for line in searches) == 2:
            raise KeyboardInterrupt

    plan = planner.solve_for(there_and_half_back(), "time", durations=(1.0, 8.0), callback=callback)
    assert plan.status is planner.Status.INTERRUPTED
    assert share(plan) == round(N * 1.0 / 1.5) / N  # the first one, which the next had not beaten
    assert plan.t[-1] < 4.0


def test_least_effort_is_that_of_the_best_spline():
    """The least 1/2 int u^2 through a point at a time is that of a cubic spline; the best time is found by Brent."""
    from scipy.interpolate import CubicSpline

    def effort(t):
        spline = CubicSpline([0.0, t, 4.0], [0.0, 1.0, 0.5], bc_type="clamped")
        a, m, b = spline([0.0, t, 4.0], 2)  # linear between
        return (t * (a * a + a * m + m * m) + (4.0 - t) * (m * m + m * b + b * b)) / 6.0

    best = minimize_scalar(effort, bounds=(0.5, 3.5), method="bounded")
    plan = planner.solve_for(there_and_half_back(limits="off"), "effort")
    assert plan.success
    assert share(plan) == pytest.approx(best.x / 4.0, abs=1.5 / N)
    assert 0.5 * plan.dt * np.sum(plan.us**2) == pytest.approx(best.fun, rel=0.02)


def test_a_stored_plan_keeps_its_times(tmp_path):
    plan = planner.solve(there_and_half_back())
    again = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert again.problem is not None
    assert share(again) == share(plan)
    assert [one.times for one in again.problem.goal_specs] == [one.times for one in plan.problem.goal_specs]


HEAD = 'model = "cart.xml"\nstart = {}\nduration = 4.0\ndt = 0.1\n'
VIA = "[[goal]]\njoints = { x = 1.0 }\nthrough = true\n"
END = "[[goal]]\njoints = { x = 0.5 }\n"


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        (HEAD + VIA + "time = 1.0\nshare = 0.5\n" + END, ("a time and a share", "expected one of the two")),
        (HEAD + VIA + "share = 1.5\n" + END, ("share of a goal is 1.5",)),
        (HEAD + VIA + VIA + "time = 2.0\n" + END, ("goal 1 is passed without a time", "goal 2 has one")),
        (HEAD.replace("0.1", "1.0") + VIA + VIA + END, ("4 stages for 2 via points", "at least 6")),
    ],
)
def test_what_cannot_be_meant(tmp_path, text, fragments):
    (tmp_path / "cart.xml").write_text(CART)
    (tmp_path / "task.toml").write_text(text)
    with pytest.raises(planner.PlannerError) as raised:
        load(tmp_path / "task.toml")
    for fragment in fragments:
        assert fragment in str(raised.value)


def test_two_that_end_passing_are_at_the_end_as_before():
    cart = planner.Mechanism.from_mjcf(CART)
    goals = [Goal(joints={"x": 1.0}, through=True), Goal(joints={"x": 1.0}, through=True)]
    problem = planner.task(cart, start={"x": 0.0}, goals=goals, duration=2.0, dt=0.1)
    assert all("share" not in goal for goal in problem.parameters["goal"])
