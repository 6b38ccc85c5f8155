"""What a robot does to its loop, a test each: bad measurements, clocks, goals. No call raises."""

from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

import planner
from planner.control.controller_states import BLIND, ControllerStatus, EventCode, Fault
from planner.control.window_parts import goal_fault, goal_states, reach
from planner.dynamics.kinematics import frame_pose

MOST = 14.0  # N m, about the plan's largest control of conftest.py's problem
TRACKING, LATE, HOLDING, STOPPED = ControllerStatus
HAND = """
<mujoco><option gravity="0 0 0"/><worldbody><body name="upper"><joint name="a" axis="0 0 1" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/><body name="lower" pos="0.4 0 0">
  <joint name="b" axis="0 0 1" damping="0.1"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
  <site name="hand" pos="0.3 0 0"/></body></body></worldbody>
  <actuator><motor joint="a" ctrlrange="-5 5"/><motor joint="b" ctrlrange="-5 5"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def bounded(problem):
    return planner.Controller(replace(problem, limits=planner.Limits(control=MOST)), patience=4)


@pytest.fixture
def begun(bounded):
    """A controller in the middle of its task, the time and the state of the next call."""
    bounded.goal = [np.pi / 2, 0.0]
    bounded.reset()
    bounded.simulated = True  # a busy computer's wall time is no event here
    return bounded, *stages(bounded, 0.0, bounded.problem.x0, 5)


def stages(c, t, x, number, seen=lambda x: x):
    """Call a controller of the plan's own dynamics for some stages; the next time and state."""
    dynamics = c.problem.dynamics
    for _ in range(number):
        u = checked(c, t, seen(x))
        x, t = dynamics.step(x[None], u[None])[0], t + dynamics.dt
    return t, x


def checked(c, t, x):
    u = c(t, x)
    assert u.shape == (2,)
    assert np.isfinite(u).all()
    assert np.abs(u).max() <= MOST
    return u


BAD = {
    Fault.STATE: lambda x: np.where([0, 1, 0, 0], np.nan, x), Fault.LENGTH: lambda x: x[:3],
    Fault.SIZE: lambda x: np.where([0, 0, 1, 0], 1e6, x),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_bad_measurements_lead_from_tracking_to_stopped(begun, fault):
    c, t, x = begun
    assert c.status is TRACKING
    reached = []
    for k in range(1, BLIND * c.patience + 1):
        u = checked(c, t, BAD[fault](x))
        reached.append(c.status)
        if k == 1:
            n = round((t - c._tracked.made) / c._dt)
            np.testing.assert_allclose(u, np.clip(c._tracked.us[n], -MOST, MOST))  # the plan without feedback
        t += c.problem.dynamics.dt
    assert reached == (c.patience - 1) * [LATE] + (BLIND - 1) * c.patience * [HOLDING] + [STOPPED]
    assert [(e.code, e.status) for e in c.events] == [
        (EventCode.UNUSABLE, LATE), (EventCode.HOLDS, HOLDING), (EventCode.STOPS, STOPPED),
    ]  # fmt: skip
    assert c.events[0].values == {"fault": fault.name}
    assert str(fault) in str(c.events[0])
    assert c.faults == BLIND * c.patience
    plans = c.plans
    checked(c, t, x)
    assert (c.status, c.plans) == (STOPPED, plans)  # a good measurement does not begin again by itself
    c.reset()
    c.simulated = True
    checked(c, 0.0, c.problem.x0)
    assert c.status is TRACKING


@pytest.mark.parametrize(
    "bad", ["text", [1.0, "b", 3.0, 4.0], None, [[1.0, 2.0, 3.0, 4.0]], np.ones(4) * 1j, [[1], []]]
)
def test_what_is_no_state_is_a_fault(begun, bad):
    c, t, _ = begun
    checked(c, t, bad)
    assert (c.status, c.events[-1].values) == (LATE, {"fault": "LENGTH"})
    if bad is not None:  # then the state is predicted
        assert not c.prepare(t, bad)
        assert (c.faults, c.failures) == (2, 0)


def test_a_good_measurement_after_some_that_were_not_tracks_again(begun):
    c, t, x = begun
    for k in range(c.patience + 2):
        checked(c, t + k * c.problem.dynamics.dt, x * np.nan)
    assert c.status is HOLDING
    checked(c, t + (c.patience + 2) * c.problem.dynamics.dt, x)
    assert c.status is TRACKING
    assert c.events[-1].code is EventCode.RECOVERED
    assert c.events[-1].values == {"unusable": c.patience + 2}


def test_a_bad_first_measurement_gets_the_first_control_of_the_plan(bounded):
    bounded.reset()
    bounded.simulated = True
    u = checked(bounded, 0.0, np.full(4, np.nan))
    np.testing.assert_allclose(u, bounded.plan.us[0])
    stages(bounded, 0.05, bounded.problem.x0, 2)
    assert bounded.status is TRACKING


@pytest.mark.parametrize("t", [np.nan, np.inf, -np.inf, 1e300, "now", None])
def test_a_time_that_is_none_is_a_fault(begun, t):
    c, now, x = begun
    checked(c, t, x)
    assert (c.status, c.events[-1].values) == (LATE, {"fault": "CLOCK"})
    assert not c.prepare(t)
    assert (c.faults, c.failures) == (2, 0)
    stages(c, now, x, 1)
    assert c.status is TRACKING


def test_a_clock_that_goes_back_is_a_fault_until_it_has_caught_up(begun):
    c, t, x = begun
    plans = c.plans
    for k in range(3):
        checked(c, 0.0 + k * 0.05, x)
    assert (c.plans, c.status) == (plans, LATE)
    assert [e.values for e in c.events] == [{"fault": "CLOCK_BACK"}]
    for k in range(30):
        checked(c, 1e-3 * k, x)
    assert c.status is HOLDING
    stages(c, t, x, 1)
    assert c.status is TRACKING


def test_a_repeated_measurement_gets_the_same_control_and_no_plan(begun):
    c, t, x = begun
    first, plans = checked(c, t, x).copy(), c.plans
    np.testing.assert_allclose(checked(c, t, x), first, atol=1e-12)
    assert (c.plans, c.status, c.events) == (plans, TRACKING, [])


def test_a_measurement_out_of_order_is_left_out(begun):
    c, t, x = begun
    dt = c.problem.dynamics.dt
    checked(c, t, x)
    checked(c, t - 0.5 * dt, c.problem.x0)
    assert c.events[-1].values == {"fault": "CLOCK_BACK"}
    stages(c, t + dt, x, 1)
    assert c.status is TRACKING


def test_missed_seconds_are_an_event_and_planned_from(begun):
    c, t, x = begun
    t += 7.0
    t, x = stages(c, t, x, 60)
    assert c.events[0].code is EventCode.GAP
    assert c.events[0].values["seconds"] == pytest.approx(7.05)
    assert c.status is TRACKING
    assert np.abs(x - [np.pi / 2, 0, 0, 0]).max() < 0.05


def test_a_jump_is_planned_from(begun):
    c, t, x = begun
    t, x = stages(c, t, x + np.array([0.4, -0.4, 1.0, -1.0]), 80)
    assert c.status is TRACKING
    assert np.abs(x - [np.pi / 2, 0, 0, 0]).max() < 0.05


def test_quantised_positions_are_followed(begun):
    c, t, x = begun
    step = 2 * np.pi / 2**12  # an encoder of 12 bits
    t, x = stages(c, t, x, 80, seen=lambda x: np.concatenate([step * np.round(x[:2] / step), x[2:]]))
    assert c.status is TRACKING
    assert np.abs(x[:2] - [np.pi / 2, 0]).max() < 0.05


@pytest.mark.parametrize("goal", [[1e300, 0.0], [0.0, 0.0, 1e12, 0.0]])
def test_a_goal_beyond_all_numbers_holds_until_another(begun, goal):
    c, t, x = begun
    before = c.goal
    c.goal = goal
    assert c.status is HOLDING
    assert [(e.code, e.status) for e in c.events] == [(EventCode.GOAL, HOLDING)]
    assert c.events[0].values == {"fault": "GOAL_SIZE"}
    plans = c.plans
    t, x = stages(c, t, x, 40)
    assert c.plans == plans
    assert np.abs(x[2:]).max() < 0.1  # rad/s: damped
    c.goal = goal  # the same again is no event
    assert len(c.events) == 1
    c.goal = before
    t, x = stages(c, t, x, 80)
    assert c.status is TRACKING
    assert np.abs(x - [np.pi / 2, 0, 0, 0]).max() < 0.05


def test_a_goal_beyond_a_range_holds(problem):
    c = planner.Controller(replace(problem, limits=planner.Limits(position={"elbow": (-2.0, 2.0)})))
    c.simulated = True
    c(0.0, problem.x0)
    c.goal = [1.0, 1.9]
    assert c.status is TRACKING
    c.goal = [1.0, 2.1]
    assert (c.status, c.events[0].values) == (HOLDING, {"fault": "GOAL_RANGE"})


def hand_problem(**more):
    arm = planner.Mechanism.from_mjcf(HAND, **more)
    goal = planner.Goal(frame="hand", position=[0.5, 0.3, 0.0])
    return planner.task(arm, start=arm.home, goals=goal, duration=1.0)


def test_a_place_out_of_reach_holds_the_arm():
    problem = hand_problem()
    c = planner.Controller(problem)
    c.simulated = True
    x, t, dt = problem.x0, 0.0, problem.dynamics.dt
    for place, status in (([0.0, 0.69, 0.0], TRACKING), ([0.0, 0.72, 0.0], HOLDING), ([0.3, 0.3, 0.0], TRACKING)):
        c.goal = {"hand": place}
        for _ in range(round(2.0 / dt)):
            x, t = problem.dynamics.step(x[None], c(t, x)[None])[0], t + dt
        assert c.status is status
        assert np.abs(x[2:]).max() < 0.05  # rad/s: it spun at 21 rad/s for a place out of reach
    assert np.linalg.norm(frame_pose(problem.dynamics.mechanism, x[:2], "hand")[:3, 3] - place) < 0.01
    assert [e.values.get("fault") for e in c.events if e.code is EventCode.GOAL] == ["GOAL_REACH"]


def test_a_position_of_other_than_three_numbers_is_refused_as_one():
    """It was taken for the angle of a joint of that name, which there is not."""
    c = planner.Controller(hand_problem())
    for wrong in ([0.4, 0.0], [0.4, 0.0, 0.0, 0.0], [[0.4, 0.0]]):
        with pytest.raises(planner.PlannerError, match=r"the goal of hand .* expected .*3"):
            c.goal = {"hand": wrong}


def test_the_reach_is_that_of_the_stretched_arm_and_never_less_than_a_pose():
    arm = planner.Mechanism.from_mjcf(HAND)
    center, most = reach(arm, "hand")
    assert most == pytest.approx(0.7)
    puma = planner.cases.build("puma").dynamics.mechanism
    frame = puma.body_names[-1]
    center, most = reach(puma, frame)
    qs = np.random.default_rng(0).uniform(-np.pi, np.pi, (500, puma.nq))
    away = np.linalg.norm(frame_pose(puma, qs, frame)[:, :3, 3] - center, axis=1)
    assert 0.5 * most < away.max() <= most + 1e-9  # one of 500 random poses is that far


def test_a_goal_inside_an_obstacle_is_refused_and_one_beside_it_is_not():
    problem = planner.load_problem(ROOT / "examples" / "tasks" / "around_a_post.toml")
    goal = goal_states(problem, "right", problem.N)
    assert goal_fault(problem, goal) is None
    goal[0] = 0.0  # the base joint, with which the arm is in the post
    assert goal_fault(problem, goal) is Fault.GOAL_COLLIDES


def test_stop_is_for_good_until_the_reset(begun):
    c, t, x = begun
    c.stop()
    t, x = stages(c, t, x, 40)
    assert c.status is STOPPED
    assert np.abs(x[2:]).max() < 0.1  # rad/s
    assert not c.prepare(t)
