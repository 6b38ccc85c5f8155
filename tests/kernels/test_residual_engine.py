"""Residuals of frames and of the centre of mass, compiled: the NumPy twin's numbers, and plans by both engines."""

from dataclasses import replace

import numpy as np
import pytest
from engines import assert_same_iterations, begun, both_engines
from gradients import assert_gradients
from hypothesis import strategies as st
from machines import HAND_ARM
from solves import assert_consistent, assert_stationary, numpy_twin
from trees import drawn, machines

import planner
from planner import Limits, Mechanism, PlannerError, Problem, RigidBodyDynamics, Status, TrackingCost
from planner.costs import CenterOfMassCost, FrameCost, Height, PenaltyCost, Point
from planner.dynamics import INTEGRATORS, center_of_mass
from planner.kernels.lq import line_search
from planner.kernels.tree.residuals.kinds import KINDS as COMPILED
from planner.model.contact.laws import Contact, ContactLaw, Plane
from planner.model.space import log_jacobian
from planner.problem.costs.frame import SlipCost
from planner.problem.costs.least_squares import ResidualCost
from planner.problem.costs.residual_functions import RESIDUALS
from planner.problem.rediscretize import finer
from planner.solvers.engine import CompiledEngine, HybridEngine, acquire_engine

BALL = """
<mujoco>
  <option gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="ball" type="ball"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.2 0.25"/>
      <site name="hand" pos="0.1 0.4 -0.2"/>
    </body>
  </worldbody>
  <actuator><motor joint="ball" gear="1 0 0"/></actuator>
</mujoco>
"""
KINDS = ("position", "orientation", "pose", "pointing", "velocity", "angular_velocity", "centre", "slip")


def test_each_kind_has_a_number_of_its_own_and_a_twin():
    assert sorted(COMPILED) == list(range(len(COMPILED)))  # two kinds of one number leave a hole
    assert set(COMPILED) == set(RESIDUALS)


def some_target(rng, kind, N):
    """A target for a kind, once or per stage."""
    rows = (N + 1,) if rng.random() < 0.5 else ()
    size = {"orientation": 4, "pose": 7}.get(kind, 3)
    target = rng.normal(size=(*rows, size))
    return (rng.normal(size=3), target) if kind == "pointing" else target


def some_cost(rng, dynamics, N, kind):
    """A cost with one residual of a frame, or of the centre of mass; on and off, weighed per row and stage."""
    size = 6 if kind == "pose" else 3
    weight = rng.random((N + 1, size)) * (rng.random((N + 1, 1)) < 0.7)
    final = rng.random(size) + 0.1
    target = some_target(rng, kind, N)
    m = dynamics.mechanism
    if kind == "centre":
        return CenterOfMassCost(dynamics, target, position_weight=weight, final_position_weight=final)
    if kind == "slip":  # of a sphere on some link, over a plane, under it or within the clearance
        plane = Plane(rng.normal(size=3), rng.normal())
        link = rng.choice([links.stop - 1 for links in m.joint_links])  # of a body, not within a joint of several
        sphere = Contact(int(link), 0.1 * rng.normal(size=3), 0.05, plane, ContactLaw(1.0))
        return SlipCost(dynamics, 1.0 + rng.random(), [sphere], clearance=1.0)
    frame = rng.choice([*m.sites, *m.body_names])
    return FrameCost(dynamics, str(frame), **{kind: target, f"{kind}_weight": weight, f"final_{kind}_weight": final})


def task_with(text, seed, integrator, full=False, tracking=True, limits=None):
    """A random problem with residuals of all kinds in its cost, and a height."""
    task = drawn(text, seed, integrator, full)
    rng, N = np.random.default_rng(seed + 1), task.N
    cost = task.cost if tracking else None
    for kind in KINDS:
        term = some_cost(rng, task.dynamics, N, kind)
        cost = term if cost is None else cost + term
    height = Height(Point(world=(0.0, 0.0, 1.0)), lower=0.5, tolerance=0.1)
    cost = cost + PenaltyCost(task.dynamics, N, [height])
    return Problem(task.dynamics, cost, task.x0, task.first_guess, limits=limits)


@machines(12, max_dofs=14, max_bodies=5, integrator=st.sampled_from(INTEGRATORS))
def test_both_engines_do_the_same(text, seed, integrator):
    task = task_with(text, seed, integrator)
    assert_same_iterations(both_engines(task), task, [True])


@machines(12, max_dofs=14, max_bodies=5)
def test_the_kernels_model_is_the_twins(text, seed):
    """Gradients and Hessians of the stages themselves, of each kind, to rounding."""
    task = drawn(text, seed, "rk4", False)
    rng = np.random.default_rng(seed + 2)
    for kind in KINDS:
        term = some_cost(rng, task.dynamics, task.N, kind)
        one = Problem(task.dynamics, task.cost + term, task.x0, task.first_guess)
        ours, _ = both_engines(one)
        ours.start_from_controls(one.x0, one.first_guess)
        ours.sweep(0.0, True)
        w = ours._w
        xs, us = ours.trajectory()
        model, tracking = term.quadratize(xs, us), task.cost.quadratize(xs, us)
        theirs = w.l[:, w.first : w.first + task.dynamics.ndx] - tracking.q
        assert np.abs(theirs - model.q).max() < 1e-11 * max(1.0, np.abs(w.l).max()), kind
        columns = w.residuals.columns
        mine = w.residuals.hessian[:, :, :columns]
        assert np.abs(np.triu(mine - model.Q[:, :columns, :columns])).max() < 1e-11 * max(1.0, np.abs(mine).max()), kind
        assert not model.Q[:, columns:].any(), kind


@machines(10, max_dofs=8, max_bodies=4, kind=st.sampled_from(KINDS))
def test_gradients_are_differences_of_the_value(text, seed, kind):
    task = drawn(text, seed, "rk4", False)
    rng = np.random.default_rng(seed)
    xs, us = task.x0 + np.zeros((task.N + 1, 1)), np.zeros((task.N, task.dynamics.nu))
    space = task.dynamics.space
    xs = space.integrate(xs, 0.5 * rng.normal(size=(task.N + 1, space.ndx)))
    assert_gradients(some_cost(rng, task.dynamics, task.N, kind), space, xs, us)


# ------------------------------------------------------------------------------------------------------- solves

N = 40


@pytest.fixture(scope="module")
def arm():
    return RigidBodyDynamics(Mechanism.from_mjcf(HAND_ARM), 0.025)


def held(dynamics, effort=0.01):
    return TrackingCost.joints(dynamics, np.zeros(4), N, effort=effort, velocity=0.01)


def reach(dynamics, **more):
    """The tip goes to a place within reach, at rest."""
    place = FrameCost(
        dynamics, "tip", position=(0.9, 0.0, -1.2), final_position_weight=[1e3, 0.0, 1e3], velocity=np.zeros(3),
        final_velocity_weight=10.0,
    )  # fmt: skip
    return Problem(dynamics, held(dynamics) + place, np.zeros(4), horizon=N, **more)


def test_whole_solves_agree_with_the_twins(arm):
    task = reach(arm)
    assert isinstance(acquire_engine(task), CompiledEngine)
    plan, twin = planner.solve(task), planner.solve(numpy_twin(task))
    assert plan.status is Status.CONVERGED
    assert_consistent(task, plan)
    assert_stationary(task, plan)
    assert len(twin.history) == len(plan.history)
    assert twin.cost == pytest.approx(plan.cost, rel=1e-9)
    tip = planner.dynamics.frame_pose(arm.mechanism, plan.xs[-1, :2], "tip")[:3, 3]
    np.testing.assert_allclose(tip, [0.9, 0.0, -1.2], atol=5e-3)  # the weights' own compromise with the effort
    assert planner.prove(plan, rollouts=0).passed


def test_an_arm_points_its_forearm(arm):
    down = FrameCost(arm, "tip", pointing=([0, 0, -2], [3, 0, 0]), final_pointing_weight=100.0)
    plan = planner.solve(Problem(arm, held(arm) + down, np.zeros(4), horizon=N))
    assert plan.success
    (asked,) = down.goal_specs(())
    assert (asked.name, asked.unit) == ("direction of tip", "rad")
    axis = planner.dynamics.frame_pose(arm.mechanism, plan.xs[-1, :2], "tip")[:3, :3] @ [0.0, 0.0, -1.0]
    angle = np.arccos(axis[0])
    assert angle < 0.05
    assert asked.error(plan.xs[-1:])[0] == pytest.approx(2.0 * np.sin(0.5 * angle), rel=1e-6)


def test_costs_without_tracking_are_compiled(arm):
    """Nothing weighs the controls but what they do: the sweep regularizes, as for any cost without effort."""
    still = {"velocity": np.zeros(3), "velocity_weight": 1.0}
    path = FrameCost(arm, "tip", position=(0.2, 0.0, -1.9), position_weight=1.0, **still)
    task = Problem(arm, path, np.zeros(4), horizon=N)
    engines = both_engines(task)
    cost, _ = begun(engines, task)
    a, b = (engine.sweep(1e-3, True) for engine in engines)
    assert a.gradient_norm == pytest.approx(b.gradient_norm, rel=1e-9)
    assert planner.solve(task, max_iterations=20).cost < cost


def test_a_users_own_term_is_added_in_numpy(arm):
    class Own:
        def value(self, xs, us):
            return 0.0

        def quadratize(self, xs, us):
            return held(arm).quadratize(0.0 * xs, 0.0 * us)._replace(Q=np.zeros((N + 1, 4, 4)), R=np.zeros((N, 2, 2)))

    task = Problem(arm, reach(arm).cost + Own(), np.zeros(4), horizon=N)
    assert isinstance(acquire_engine(task), HybridEngine)
    assert planner.solve(task).cost == pytest.approx(planner.solve(reach(arm)).cost, rel=1e-8)


def test_bounds_and_weights_may_change_between_iterations(arm):
    """What an augmented Lagrangian does: the engine goes on with other numbers as if it had been made with them."""
    task, other = reach(arm), reach(arm)
    place = other.cost.costs[1].residual_arrays_for(N)
    ours, theirs = (both_engines(one)[0] for one in (task, other))
    for engine, one in ((ours, task), (theirs, other)):
        engine.start_from_controls(one.x0, one.first_guess)
        engine.sweep(0.0, True)
    table = ours.residuals
    np.testing.assert_array_equal(table.weight, place.weight)
    np.testing.assert_array_equal(table.bound, place.bound)
    table.bound[0], table.weight[:3, 20], table.weight[3:] = 0.5, 7.0, 0.0
    table.changed()
    weight = np.zeros((N + 1, 3))
    weight[20] = 7.0 / 0.025  # of a stage
    moved = FrameCost(
        arm, "tip", position=[[0.5, 0.0, -1.2]] * (N + 1), position_weight=weight,
        final_position_weight=[1e3, 0.0, 1e3],
    )  # fmt: skip
    fresh = both_engines(Problem(arm, held(arm) + moved, np.zeros(4), horizon=N))[0]
    costs = begun((ours, fresh), task)
    a, b = (engine.iterate(True, line_search.ARMIJO, 0.0, True, costs[0], 0.0, -1.0) for engine in (ours, fresh))
    assert a.cost == pytest.approx(b.cost, rel=1e-12)
    np.testing.assert_allclose(ours.gradient(), fresh.gradient(), rtol=0, atol=1e-12 * np.abs(fresh.gradient()).max())


def test_rows_may_be_one_sided_and_without_a_ramp(arm):
    """Rows of an inequality cost nothing within it; without a ramp they are the squares of an augmented Lagrangian."""
    task = reach(arm)
    arrays = task.cost.costs[1].residual_arrays_for(N)
    side = np.array(arrays.side)
    side[0], side[2] = 1.0, -1.0  # x at most 0.9, z at least -1.2
    arrays = replace(arrays, side=side)
    engine = CompiledEngine(task, arm, task.cost.costs[0], arrays)
    start = engine.start_from_controls(task.x0, task.first_guess)  # hanging down: x = 0, z = -2
    assert start == pytest.approx(0.5 * 1e3 * 0.8**2, rel=1e-12)
    twin = ResidualCost(arm.mechanism, arrays, N)
    assert twin.value(*engine.trajectory()) == pytest.approx(start, rel=1e-12)


def test_bounds_of_controls_hold_beside_residuals(arm):
    plan = planner.solve(reach(arm, limits=Limits(control={"b": 3.0})))
    free = planner.solve(reach(arm))
    assert np.abs(free.us[:, 1]).max() > 3.5
    assert plan.success
    assert np.abs(plan.us[:, 1]).max() <= 3.0


def test_the_same_problem_at_half_the_stage(arm):
    fine = finer(reach(arm))
    assert isinstance(acquire_engine(fine), CompiledEngine)
    assert planner.solve(fine).cost == pytest.approx(planner.solve(reach(arm)).cost, rel=0.02)


# ------------------------------------------------------------------------------------------------- the residuals


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.19, 0.21, 1.0, 3.1, np.pi - 1e-6])
def test_logarithms_at_every_angle(angle):
    """A ball turned about an axis by an angle: the rotation vector itself, near zero, near pi, where a series ends."""
    ball = Mechanism.from_mjcf(BALL)
    dynamics = RigidBodyDynamics(ball, 0.1, "semi-implicit-euler")
    axis = np.array([0.48, -0.6, 0.64])  # of length one
    q, place = np.r_[np.cos(0.5 * angle), np.sin(0.5 * angle) * axis], np.array([0.3, -0.2, 0.5])
    x0 = np.r_[q, np.zeros(3)]
    goals = {"orientation": [1, 0, 0, 0], "pose": [*place, 1, 0, 0, 0]}
    for kind, target in goals.items():
        term = FrameCost(dynamics, "hand", **{kind: target, f"final_{kind}_weight": 1.0})
        engine = both_engines(Problem(dynamics, term, x0, horizon=1))[0]
        phi = angle * axis
        hand = planner.dynamics.frame_pose(ball, q, "hand")[:3, 3]
        # SE(3): exp of (rho, phi) has the translation V rho with V = Jl(phi), so that rho = Jl^-1 (hand - place)
        rho = log_jacobian(-phi) @ (hand - place) if kind == "pose" else np.zeros(3)
        xs = np.tile(x0, (2, 1))
        expected = 0.5 * (phi @ phi + rho @ rho)
        assert term.final_cost(x0) == pytest.approx(expected, rel=1e-11, abs=1e-15)
        engine.start_from_controls(x0, np.zeros((1, dynamics.nu)))
        engine.sweep(1.0, True)
        xs, us = engine.trajectory()
        model, w = term.quadratize(xs, us), engine._w
        mine = w.l[-1, w.first : w.first + 3]
        # at the cut of the logarithm, at pi, both fall on one side or the other
        np.testing.assert_allclose(mine, model.q[-1, :3], rtol=0, atol=1e-12)
        assert term.value(xs, us) == pytest.approx(engine.start_from_controls(x0, us), rel=1e-12, abs=1e-15)


def test_the_centre_of_mass_is_that_of_the_dynamics(arm):
    m = arm.mechanism
    target = center_of_mass(m, [0.7, -0.4]) + np.array([0.1, 0.0, 0.2])
    cost = CenterOfMassCost(arm, target, position_weight=2.0)
    x = np.array([[0.7, -0.4, 0.0, 0.0]])
    assert cost.value(x, np.zeros((0, 2))) == pytest.approx(0.5 * 0.025 * 2.0 * 0.05, rel=1e-12)


def test_a_cost_that_is_wrong_is_refused_in_one_sentence(arm):
    for make, expected in (
        (lambda: FrameCost(arm, "tip", pointing=[0, 0, 1]), "pointing is [0, 0, 1], expected the frame's own axis and"),
        (lambda: FrameCost(arm, "tip", pointing=([0, 0, 0], [0, 0, 1])), "the axis of pointing has length zero"),
        (lambda: FrameCost(arm, "tip", pose=np.zeros(7), pose_weight=1.0), "pose's quaternion has length zero"),
        (lambda: FrameCost(arm, "tip", velocity=np.zeros(3)), "velocity has no weight"),
        (lambda: CenterOfMassCost(arm, None, position_weight=1.0), "position_weight has no target"),
        (lambda: CenterOfMassCost(arm, np.zeros(2), position_weight=1.0), "position has shape (2,)"),
    ):
        with pytest.raises(PlannerError) as error:
            make()
        assert str(error.value).startswith(expected)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("change", ["friction", "coupling", "stops"])
def test_what_acts_on_the_joints_leaves_the_frames_where_they_are(change):
    """But for RK4 the rollout's residuals take the links as the dynamics of the stage have placed them."""
    text = HAND_ARM
    if change == "friction":
        text = text.replace('damping="0.1"', 'damping="0.1" frictionloss="0.5"')
    elif change == "coupling":
        equality = '<equality><joint joint1="b" joint2="a" polycoef="0 -1 0 0 0"/></equality>'
        text = text.replace("<actuator>", f"{equality}<actuator>")
    else:
        text = text.replace('damping="0.1"', 'damping="0.1" limited="true" range="-20 20"')
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text), 0.025, "semi-implicit-euler")
    target = {"pose": [0.5, 0.1, -1.0, 1, 0, 0, 0], "pose_weight": 3.0, "velocity": [1, 0, 0], "velocity_weight": 0.5}
    cost = held(dynamics) + FrameCost(dynamics, "tip", **target)
    cost = cost + CenterOfMassCost(dynamics, np.zeros(3), position_weight=2.0)
    task = Problem(dynamics, cost, np.zeros(4), np.tile([3.0, -1.0], (N, 1)))
    begun(both_engines(task), task)
