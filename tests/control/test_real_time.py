"""Time in the loop: late plans, budgets, plans between measurements, and plans in a thread of their own."""

import time

import numpy as np
import pytest

import planner
from planner.control.controller_states import ControllerStatus, EventCode

TRACKING, LATE, HOLDING, STOPPED = ControllerStatus


def slow(c, seconds):
    """Let solves of a controller take so much wall time."""
    replan = c._replanner.replan

    def later(*arguments):
        time.sleep(seconds[0])
        return replan(*arguments)

    c._replanner.replan = later


def test_late_plans_are_events_with_numbers_until_enough_are_in_time(problem):
    c, seconds = planner.Controller(problem, patience=3), [0.06]
    slow(c, seconds)
    x, dt = problem.x0, problem.dynamics.dt
    for n in range(2):
        c(n * dt, x)
    assert (c.status, c.overruns, c.plans) == (LATE, 2, 2)
    (event,) = c.events
    assert event.code is EventCode.OVERRUN
    assert event.values["most"] == pytest.approx(dt)
    assert 0.06 < event.values["seconds"] == pytest.approx(0.06, abs=0.05)
    seconds[0] = 0.0
    for n in range(2, 5):
        c(n * dt, x)
    assert (c.status, c.overruns) == (TRACKING, 2)
    assert (c.events[-1].code, c.events[-1].values) == (EventCode.RECOVERED, {"overruns": 2})


def test_wall_time_has_no_part_in_simulated_time(problem):
    """A busy computer changes no status and no event of a simulation; its calls are counted beside."""
    c = planner.Controller(problem)
    slow(c, [0.06])
    loop = planner.simulate(c, latency=0.0, duration=0.2)
    assert (c.status, c.overruns, loop.events) == (TRACKING, 0, ())
    assert loop.call_seconds.min() > 0.06
    assert 0.0 < loop.call_processor_seconds.max() < 0.06
    c.reset()
    c(0.0, problem.x0)
    assert (c.status, c.processor_seconds) == (LATE, 0.0)


def test_an_iteration_begins_only_if_it_fits_in_the_budget(problem):
    c, x, dt = planner.Controller(problem, budget=1e-9, patience=3), problem.x0, problem.dynamics.dt
    taken = c._replanner.iteration_seconds
    assert taken > 1e-9
    assert not c.prepare(0.0, x)
    assert c.status is LATE
    assert c.events[-1].values["fault"] == "BUDGET"
    assert c.events[-1].values["iteration_seconds"] == taken
    assert not c.prepare(dt, x)
    assert c.prepare(2 * dt, x)  # every third one is made, and timed again
    counted = []
    wide = planner.Controller(problem, budget=0.02)
    wide._replanner._iterate = lambda cost, fresh: counted.append(1) or (2, -1.0, cost)
    wide._replanner.iteration_seconds = 0.021
    assert not wide.prepare(0.0, x)
    assert not counted


CART = """
<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.1" mass="2"/></body>
</worldbody><actuator><motor joint="x"/></actuator></mujoco>"""


def test_prepare_and_feedback_are_a_call_where_the_problem_is_linear():
    """One iteration solves it from any state, so that the gains of a plan for a predicted state are exact."""
    cart = planner.Mechanism.from_mjcf(CART)
    problem = planner.task(cart, start=cart.home, goals=planner.Goal(joints={"x": 1.0}), duration=1.0)
    both, split = planner.Controller(problem), planner.Controller(problem)
    x = problem.x0 + np.array([0.3, -0.4])
    assert split.prepare(0.0)
    before = split.feedback(problem.x0)
    u = split.feedback(x)
    np.testing.assert_allclose(u, both(0.0, x), rtol=1e-6)
    assert abs(u - before)[0] > 0.1  # N, of feedback


def test_a_loop_of_prepare_and_feedback_arrives(problem):
    c, x, dt = planner.Controller(problem), problem.x0, problem.dynamics.dt
    c.simulated = True
    c.prepare(0.0)
    for n in range(80):
        u = c.feedback(x)
        x = problem.dynamics.step(x[None], u[None])[0]
        c.prepare((n + 1) * dt)
    assert np.abs(x - [np.pi / 2, 0, 0, 0]).max() < 0.05
    assert (c.plans, c.status, c.events) == (81, TRACKING, [])


def test_prepare_takes_whole_steps_and_searches_where_the_next_cost_is_not_lower(problem):
    c, x, dt = planner.Controller(problem), problem.x0, problem.dynamics.dt
    c.simulated, searches = True, []
    iterate = c._replanner._iterate
    c._replanner._iterate = lambda *given: searches.append(c.plans) or iterate(*given)
    c.prepare(0.0)
    for n in range(40):
        u = c.feedback(x)
        x = problem.dynamics.step(x[None], u[None])[0]
        if n == 20:
            x = x + np.array([0.0, 0.0, 2.0, -2.0])  # rad/s: the plan after it begins in a state that nobody predicted
            c.prepare((n + 1) * dt, x)
        else:
            c.prepare((n + 1) * dt)
    assert 21 in searches
    assert len(searches) < 8  # of 41 plans
    for n in range(40, 120):
        u = c.feedback(x)
        x = problem.dynamics.step(x[None], u[None])[0]
        c.prepare((n + 1) * dt)
    assert np.abs(x - [np.pi / 2, 0, 0, 0]).max() < 0.05


@pytest.mark.parametrize("status", [STOPPED, HOLDING])
def test_a_plan_that_is_ready_after_a_stop_or_a_refused_goal_starts_nothing(problem, status):
    c = planner.Controller(problem, threaded=True)
    c(0.0, problem.x0)  # begins a plan
    c._pending.result()
    if status is STOPPED:
        c.stop()
    else:
        c.goal = [1e300, 0.0]
    for t in (0.5, 1.0):
        c(t, problem.x0)
        assert c.status is status
        assert c._pending is None
    c.close()


def test_a_thread_plans_while_the_gains_control(problem):
    c, dt = planner.Controller(problem, threaded=True), problem.dynamics.dt
    seconds = [0.03]
    slow(c, seconds)
    x, began, asked = problem.x0, time.perf_counter(), []
    for n in range(160):
        at = time.perf_counter()
        u = c(0.25 * n * dt, x)
        asked.append(time.perf_counter() - at)
        x = problem.dynamics.step(x[None], u[None], np.array([0.25 * dt]))[0]
        time.sleep(max(began + 0.25 * (n + 1) * dt - time.perf_counter(), 0.0))
    assert np.median(asked) < 0.003  # s, of plans that take 0.03
    assert c.plans >= 30
    c.close()
    assert np.abs(x - [np.pi / 2, 0, 0, 0]).max() < 0.3
    with pytest.raises(planner.PlannerError, match="threaded"):
        c.prepare(0.0)
    assert np.isfinite(c(10.0, x)).all()  # closed, it holds the arm
    assert c.status is STOPPED
    c.reset()
    c(0.0, problem.x0)
    assert c.status is TRACKING
    c.close()


@pytest.mark.parametrize(
    ("stages", "late", "threaded"), [(1, 0.0, False), (1, 1.0, False), (2, 0.0, False), (2, 0.5, True), (1, 1.5, True)]
)
def test_late_plans_for_less_than_each_stage_are_made_in_a_thread(problem, stages, late, threaded):
    """Else the control would be constant where the plan's changes, or its gains act."""
    dt, plan = problem.dynamics.dt, planner.solve(problem)
    assert planner.Controller(problem, rate=1.0 / (stages * dt), latency=late * dt, plan=plan).threaded is threaded


def test_a_threaded_loop_in_simulated_time_is_the_same_again_and_better_than_a_held_control(problem):
    """Plans are five stages late. Without a thread the last control is held for so long."""
    late, off = 5 * problem.dynamics.dt, {}
    for threaded in (True, False):
        c = planner.Controller(problem, latency=late, rate=1.0 / late, threaded=threaded)
        loop = planner.simulate(c, latency=late, pushes=[planner.Push("forearm", 5.0, 1.0)])
        off[threaded] = np.abs(loop.xs[loop.t > 3.0] - [np.pi / 2, 0, 0, 0]).max()
        if threaded:
            assert c.plans == 15  # of 16 begun
            np.testing.assert_array_equal(loop.xs, planner.simulate(c, pushes=[planner.Push("forearm", 5.0, 1.0)]).xs)
            with pytest.raises(planner.PlannerError, match=r"threaded controller 0\.25 s"):
                planner.simulate(c, latency=0.01)
    assert off[True] < 0.1 < off[False]
