"""Residuals of frames and of the centre of mass, compiled: the NumPy twin's numbers, and whole plans by both engines."""

import numpy as np
import pytest
from gradients import assert_gradients
from hands import ARM
from hypothesis import strategies as st
from solves import assert_consistent, assert_stationary, numpy_twin
from trees import drawn, machines, relative_error

import planner
from planner import Limits, Mechanism, Problem, RigidBodyDynamics, Status, TrackingCost
from planner.costs import CenterOfMassCost, FrameCost, Height, PenaltyCost, Point
from planner.dynamics import center_of_mass, forward_kinematics
from planner.dynamics.protocol import INTEGRATORS
from planner.kernels.lq import search
from planner.problem.costs.residuals.cost import ResidualCost
from planner.solvers.engine import CompiledEngine, NumpyEngine, borrow, compiled_costs

KINDS = ("position", "orientation", "pose", "pointing", "velocity", "angular_velocity", "centre")


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
    height = Height(Point(world=(0.0, 0.0, 1.0)), least=0.5, tolerance=0.1)
    cost = cost + PenaltyCost(task.dynamics, N, [height])
    return Problem(task.dynamics, cost, task.x0, task.first_guess, limits=limits)


def engines(task):
    costs = compiled_costs(task)
    assert costs is not None
    return CompiledEngine(task, task.dynamics, *costs), NumpyEngine(task)


@machines(24, max_dofs=14, max_bodies=5, integrator=st.sampled_from(INTEGRATORS))
def test_both_engines_do_the_same(text, seed, integrator):
    task = task_with(text, seed, integrator)
    ours, twin = engines(task)
    costs = [engine.start(task.x0, task.first_guess) for engine in (ours, twin)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-11)
    a, b = (engine.sweep(0.0, True) for engine in (ours, twin))
    assert a.gradient_norm == pytest.approx(b.gradient_norm, rel=1e-9)
    assert relative_error(ours.gradient(), twin.gradient()) < 1e-10
    a, b = (
        engine.iterate(True, search.ARMIJO, 0.0, False, cost, 0.0, -1.0)
        for engine, cost in zip((ours, twin), costs, strict=True)
    )
    assert (a.kind, a.step) == (b.kind, b.step)
    assert a.cost == pytest.approx(b.cost, rel=1e-9)


@machines(24, max_dofs=14, max_bodies=5)
def test_the_kernels_model_is_the_twins(text, seed):
    """Gradients and Hessians of the stages themselves, of each kind, to rounding."""
    task = drawn(text, seed, "rk4", False)
    rng = np.random.default_rng(seed + 2)
    for kind in KINDS:
        term = some_cost(rng, task.dynamics, task.N, kind)
        one = Problem(task.dynamics, task.cost + term, task.x0, task.first_guess)
        ours, _ = engines(one)
        ours.start(one.x0, one.first_guess)
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


@machines(12, max_dofs=10, max_bodies=4, kind=st.sampled_from(KINDS))
def test_gradients_are_differences_of_the_value(text, seed, kind):
    task = drawn(text, seed, "rk4", False)
    rng = np.random.default_rng(seed)
    xs, us = task.x0 + np.zeros((task.N + 1, 1)), np.zeros((task.N, task.dynamics.nu))
    space = task.dynamics.space
    xs = space.integrate(xs, 0.5 * rng.normal(size=(task.N + 1, space.ndx)))
    assert_gradients(some_cost(rng, task.dynamics, task.N, kind), space, xs, us)
