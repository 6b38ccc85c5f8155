"""Clamps of servos as bounds of their controls that depend on the state."""

from dataclasses import replace

import numpy as np
import pytest
from engines import assert_same_iterations, both_engines

import planner
from planner import Limits, Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.problem.control_bounds import unbounded
from planner.proof.reached_limits import clamps_hit
from planner.solvers import lq
from planner.solvers.engine import CompiledEngine, NumpyEngine

ARM = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.5"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="1"/>
      <body pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.3"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.7"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="lift" joint="shoulder" gear="1.5" gainprm="20" biastype="affine" biasprm="0.3 -20 -2"
      ctrlrange="-2 2" forcerange="-6 7"/>
    <motor name="fold" joint="elbow" ctrlrange="-2.5 2.5"/>
  </actuator>
</mujoco>
"""


def arm(integrator="rk4", limits=None, goal=(1.0, 0.8), N=40, text=ARM, dt=0.02):
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text, contacts="off"), dt, integrator)
    cost = TrackingCost.joints(
        dynamics, [*goal, 0.0, 0.0], N, effort=0.01, final_position=1e3, final_velocity=1e2, velocity=0.01
    )
    return Problem(dynamics, cost, [-0.5, 0.2, 0.0, 0.0], limits=limits or Limits(control="model"))


def forces(problem, xs, us):
    """The force of the servo at the start and, by its velocity, at the end of a stage."""
    q, v, dt = 1.5 * xs[:-1, 0], 1.5 * xs[:-1, 2], problem.dynamics.dt
    return np.array([20 * us[:, 0] + 0.3 - 20 * (q + late * dt * v) - 2 * v for late in (0.0, 1.0)])


@pytest.fixture(scope="module")
def plan():
    return planner.solve(arm())


def test_the_force_of_a_servo_stays_within_its_range(plan):
    assert plan.converged
    F = forces(plan.problem, plan.xs, plan.us)
    assert F.min() >= -6.0 - 1e-9
    assert F.max() <= 7.0 + 1e-9
    held = np.isclose(F, -6.0, atol=1e-9) | np.isclose(F, 7.0, atol=1e-9)
    assert held.any()
    assert np.array_equal(held.any(axis=0), plan.problem.bounds.at_bound(plan.xs, plan.us)[:, 0])
    assert np.abs(plan.us[:, 1]).max() <= 2.5


def test_a_servo_at_its_bound_holds_its_command(plan):
    """A gain that follows the bound would have the set-point follow the joint: no stiffness would be left."""
    A, B = plan.problem.dynamics.linearize(plan.xs, plan.us)
    model = plan.problem.cost.quadratize(plan.xs, plan.us)
    moves = plan.problem.bounds.step_bounds(plan.xs, plan.us)
    pushes = lq.reduced_gradient(A, B, model, moves)[:, 0]
    held = plan.problem.bounds.at_bound(plan.xs, plan.us)[:, 0] & (np.abs(pushes) > 1e-3 * np.abs(pushes).max())
    assert held.any()
    rows = np.abs(plan.K[held, 0]).max(axis=1)
    assert np.sum(rows > 0.0) <= 1  # the last stage before the bound is left may be free in the sweep
    assert np.all(np.abs(plan.K[~held, 0]).max(axis=1) > 0.0)


def test_commands_beyond_a_servos_force_are_not_clipped_to_the_joint(plan):
    far = plan.us[:, :] + [1.5, 0.0]
    np.testing.assert_array_equal(plan.within_bounds(slice(None), far), np.clip(far, [-2.0, -2.5], [2.0, 2.5]))


def test_clamped_controls_exert_the_clamped_force(plan):
    """clamped() is the actuator's own clamp: as many newton metres as MuJoCo leaves of a command."""
    xs, rng = plan.xs[:-1], np.random.default_rng(3)
    us = plan.us + rng.normal(scale=0.5, size=plan.us.shape)
    clamped = plan.problem.bounds.clamped(slice(None), us, xs)

    def force(u):
        return 20 * u[:, 0] + 0.3 - 20 * 1.5 * xs[:, 0] - 2 * 1.5 * xs[:, 2]

    inside = np.abs(us[:, 0]) <= 2.0  # ctrlrange clamps the others first
    assert (force(us)[inside] > 7.0).any()
    assert (force(us)[inside] < -6.0).any()
    np.testing.assert_allclose(force(clamped)[inside], np.clip(force(us)[inside], -6.0, 7.0), rtol=0, atol=1e-12)


def test_derivatives_of_the_bounds_are_their_differences():
    problem, rng, step = arm(), np.random.default_rng(1), 1e-6
    xs, us = rng.normal(size=(41, 4)), rng.normal(size=(40, 2))
    moves = problem.bounds.step_bounds(xs, us)
    for i in range(4):
        ends = []
        for sign in (1.0, -1.0):
            moved = xs.copy()
            moved[:, i] += sign * step
            ends.append(problem.bounds.step_bounds(moved, us))
        for side, rows in ((0, moves.lower_by_x), (1, moves.upper_by_x)):
            difference = (ends[0][side] - ends[1][side]) / (2 * step)
            np.testing.assert_allclose(difference, rows[:, :, i], atol=1e-7)  # lines: rounding over the step


def test_the_reduced_gradient_is_that_of_a_motion_along_its_bounds():
    """Controls at a bound that their gradient pushes against move with it; by differences of the clipped rollout."""
    problem = arm(N=12)
    engine = NumpyEngine(problem)
    engine.start_from_controls(problem.x0, np.tile([5.0, 0.3], (12, 1)))
    xs, us = engine.trajectory()
    A, B = problem.dynamics.linearize(xs, us)
    moves = problem.bounds.step_bounds(xs, us)
    gradient = lq.reduced_gradient(A, B, problem.cost.quadratize(xs, us), moves)
    assert (moves.upper[:, 0] <= 1e-11).any()
    assert np.abs(gradient - lq.gradient(A, B, problem.cost.quadratize(xs, us))).max() > 1e-3 * np.abs(gradient).max()

    def cost(us):
        x, total, u_clipped = problem.x0, [problem.x0], us.copy()
        for n in range(12):
            if moves.upper[n, 0] <= 1e-11 and gradient[n, 0] < 0.0:
                u_clipped[n, 0] = problem.bounds.at(n, x)[1][0]
            x = problem.dynamics.step(x[None], u_clipped[n : n + 1])[0]
            total.append(x)
        return problem.cost.value(np.array(total), u_clipped)

    step = 1e-5
    for n, a in ((0, 1), (5, 1), (11, 1)):
        ends = []
        for sign in (1.0, -1.0):
            moved = us.copy()
            moved[n, a] += sign * step
            ends.append(cost(moved))
        assert gradient[n, a] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)


def test_the_slope_is_that_of_the_clipped_rollout():
    problem = arm()
    twin, engine = NumpyEngine(problem), CompiledEngine(problem, problem.dynamics, problem.cost)
    cost = twin.start_from_controls(problem.x0, np.tile([1.5, 0.3], (40, 1)))
    (xs, us), step = twin.trajectory(), 1e-7
    slow = twin.iterate(True, 0, 1e-2, True, cost, 0.0, -1.0)
    _, J = twin._rollout(problem.x0, (us + step * twin._sweep.k)[:, None], twin._sweep.K, xs)
    assert (J[0] - cost) / step == pytest.approx(slow.slope, rel=1e-3)
    engine.start_from_controls(problem.x0, np.tile([1.5, 0.3], (40, 1)))
    fast = engine.iterate(True, 0, 1e-2, True, cost, 0.0, -1.0)
    assert fast.kind == slow.kind == 0
    assert fast.slope == pytest.approx(slow.slope, rel=1e-6)


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4"])
@pytest.mark.parametrize("feedback", [True, False])
def test_compiled_and_numpy_engines_take_the_same_steps(integrator, feedback):
    problem = arm(integrator)
    us = np.random.default_rng(1).normal(size=(40, 2)) * 2.0
    assert_same_iterations(both_engines(problem), problem, [feedback] * 5, us=us, mus=[1e-3] * 5, within=1e-6)


def test_a_force_that_ctrlrange_cannot_reach_takes_its_nearest_end():
    bounds = arm().bounds
    far = np.array([4.0, 0.0, 0.0, 0.0])  # 1.5 * 4 rad: even 2 asks for 20 * 2 + 0.3 - 120 = -80 N m
    lower, upper = bounds.at(0, far)
    assert lower[0] == upper[0] == 2.0
    moves = bounds.step_bounds(np.tile(far, (41, 1)), np.zeros((40, 2)))
    assert not moves.lower_by_x.any()
    assert not moves.upper_by_x.any()


def test_lines_that_cross_leave_their_mean():
    """So fast that no held control keeps the force in its range at both ends of a stage."""
    problem = arm()
    fast = np.array([0.0, 0.0, -60.0, 0.0])  # 20 * 1.5 * 0.02 * 60 = 36 N m in a stage, of 13
    servos = problem.bounds.servos
    lower, upper, by_low, by_high = servos.bounds(fast)
    assert lower[0] == upper[0]
    assert np.all(by_low == 0.5)
    assert np.all(by_high == 0.5)
    F = forces(problem, np.tile(fast, (2, 1)), np.tile(lower, (1, 2)))
    assert F.mean() == pytest.approx(0.5)  # the middle of -6 ... 7


def test_a_motor_that_drives_its_joint_alone_has_constant_bounds():
    text = ARM.replace('axis="0 1 0" damping="0.3"', 'axis="0 1 0" damping="0.3" actuatorfrcrange="-1 2"')
    bounds = arm(text=text).bounds
    assert bounds.lower[0, 1] == -1.0
    assert bounds.upper[0, 1] == 2.0
    assert list(bounds.servos.control) == [0]
    joint = ARM.replace('name="shoulder" axis', 'name="shoulder" actuatorfrcrange="-3 9" axis')
    servos = arm(text=joint).bounds.servos  # 1.5 F within -3 ... 9, and F within -6 ... 7
    assert servos.low[0] == pytest.approx((-2.0 - 0.3) / 20.0)
    assert servos.high[0] == pytest.approx((6.0 - 0.3) / 20.0)


def test_clamps_that_bound_no_control_are_named():
    assert unbounded(Mechanism.from_mjcf(ARM, contacts="off")) == ()
    two = '<motor name="second" joint="elbow" ctrlrange="-1 1"/></actuator>'
    text = ARM.replace('damping="0.3"', 'damping="0.3" actuatorfrcrange="-1 2"').replace("</actuator>", two)
    assert unbounded(Mechanism.from_mjcf(text, contacts="off")) == ()  # their sum is a constraint
    text = text.replace(two, '<motor name="jet" site="tip" gear="1"/></actuator>')
    text = text.replace("      </body>\n    </body>", '<site name="tip"/></body></body>')
    named = unbounded(Mechanism.from_mjcf(text, contacts="off"))
    assert len(named) == 1
    assert "actuatorfrcrange of actuator 'fold'" in named[0]
    assert "one acts at a site" in named[0]
    slow = ARM.replace(
        "</actuator>",
        """<general name="slow" joint="elbow" dyntype="filter" dynprm="0.1"
        forcerange="-1 1" ctrlrange="-1 1"/></actuator>""",
    )
    machine = Mechanism.from_mjcf(slow, contacts="off")
    assert ["forcerange of actuator 'slow'" in one for one in unbounded(machine)] == [True]
    lower, upper = Limits(control="model").bounds(RigidBodyDynamics(machine, 0.02), 3).at(0, None)
    assert (lower[2], upper[2]) == (-1.0, 1.0)  # its ctrlrange is kept all the same


def test_a_user_bounds_a_servo_himself():
    bounds = arm(limits=Limits(control={"lift": 1.0})).bounds
    assert bounds.servos is None
    assert bounds.upper[0].tolist() == [1.0, 2.5]  # the other keeps the model's
    assert arm(limits=Limits(control={"lift": "off"})).bounds.upper[0].tolist() == [np.inf, 2.5]
    assert arm(limits=Limits(control="off")).bounds is None


def test_a_plan_at_a_servo_s_limit_is_replayed_without_a_clamp():
    plan = planner.solve(arm(N=160, dt=0.005))
    assert plan.problem.bounds.at_bound(plan.xs, plan.us)[:, 0].any()
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, str(proof)
    found = {one.name: one for one in proof.your_file.measured}
    assert found["clamped_actuators"].value == 0.0, found["clamped_actuators"].note
    free = planner.solve(replace(plan.problem, limits=None))
    assert np.abs(forces(free.problem, free.xs, free.us)).max() > 6.5  # the clamp matters


def test_what_gains_ask_for_beyond_a_clamp_is_judged_where_the_plan_does_not_know_it():
    plan = planner.solve(arm(N=160, dt=0.005))
    run = planner.replay(plan, feedback=True)
    asking = replace(run, ctrl=run.ctrl + np.array([1.0, 3.0]))
    assert clamps_hit(run) == []
    assert clamps_hit(asking) == []
    free = replace(plan, problem=replace(plan.problem, limits=None))
    assert len(clamps_hit(replace(asking, plan=free))) == 3  # lift's ctrlrange and forcerange, fold's ctrlrange
    wild = replace(plan, us=plan.us + np.array([1.0, 3.0]))  # what the plan itself asks for counts
    assert len(clamps_hit(replace(run, plan=wild))) == 3


def test_the_figure_shows_bounds_along_the_plan(plan):
    from planner.view.plots.plan import draw_plan

    figure = draw_plan(plan, None)
    dotted = [line for axes in figure.axes for line in axes.lines if line.get_linestyle() == ":"]
    assert len({line.axes for line in dotted}) == 2  # of servo and motor, but those far away
    assert max(np.ptp(line.get_ydata()) for line in dotted) > 0.1
