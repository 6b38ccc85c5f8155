"""Stages of several RK4 substeps: their ends, derivatives and solves are those of as many single steps."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from engines import assert_same_iterations, both_engines
from gradients import assert_step_derivatives
from machines import FAST_FINGER
from trees import CHAINS, actuated, driven, machines, relative_error

import planner
from planner import Mechanism, RigidBodyDynamics
from planner.base.errors import PlannerError


def in_single_steps(dynamics, xs, us):
    """Ends, A and B of as many stages of one step as a stage has substeps, chained."""
    one = RigidBodyDynamics(dynamics.mechanism, dynamics.dt / dynamics.substeps, prescribed=dynamics.prescribed)
    ndx = dynamics.ndx
    A, B = np.tile(np.eye(ndx), (len(us), 1, 1)), np.zeros((len(us), ndx, dynamics.nu))
    for _ in range(dynamics.substeps):
        a, b = one.linearize(np.concatenate([xs, xs[:1]]), us)
        A, B, xs = a @ A, a @ B + b, one.step(xs, us)
    return xs, A, B


@machines(16, max_dofs=16)
def test_substeps_are_single_steps_under_one_control(text, seed):
    dynamics, xs, us, rng = driven(text, seed, K=6, dt=0.02)
    substeps = int(rng.integers(2, 17))
    dynamics = RigidBodyDynamics(dynamics.mechanism, 0.02, "rk4", dynamics.prescribed, substeps)
    ends, A, B = in_single_steps(dynamics, xs, us)
    found = dynamics.linearize(np.concatenate([xs, xs[:1]]), us)
    assert relative_error(dynamics.step(xs, us), ends) < 1e-12
    for ours, theirs in zip(found, (A, B), strict=True):
        assert relative_error(ours, theirs) < 1e-12


@pytest.mark.parametrize("name", CHAINS)
def test_derivatives_of_substeps_are_those_of_differences(name):
    m, rng = Mechanism.from_mjcf(actuated(CHAINS[name], np.random.default_rng(0))), np.random.default_rng(1)
    dynamics, space = RigidBodyDynamics(m, 0.03, substeps=3), m.space
    x, u = space.integrate(m.home, 0.3 * rng.normal(size=m.space.ndx)), rng.normal(size=m.nu)
    assert_step_derivatives(dynamics, x, u)


def reach(substeps, N=30, dt=0.01):
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(FAST_FINGER), dt, substeps=substeps)
    cost = planner.TrackingCost.joints(dynamics, np.array([0.6, 0.2, 0.0, 0.0]), N, effort=0.1, final_position=100.0)
    return planner.Problem(dynamics, cost, np.zeros(4), us=np.full((N, 2), 0.1))


def test_a_solve_with_substeps_is_the_numpy_engines():
    problem = reach(6)
    assert_same_iterations(both_engines(problem), problem, [True] * 3, within=1e-7)


def test_a_stiff_machine_plans_with_substeps_at_a_stage_that_one_step_does_not_follow():
    plan = planner.solve(reach(6))
    assert plan.success
    assert np.abs(plan.xs).max() < 10.0
    finer = planner.solve(reach(1, N=180, dt=0.01 / 6))  # stable, and its controls may change more often
    assert finer.cost <= plan.cost * (1.0 + 1e-6)
    assert finer.xs[-1, :2] == pytest.approx(plan.xs[-1, :2], abs=0.02)


def test_the_count_is_kept(tmp_path):
    problem = reach(6)
    assert pickle.loads(pickle.dumps(problem.dynamics)).substeps == 6
    plan = planner.solve(problem)
    back = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert back.problem.dynamics.substeps == 6
    assert back.problem.dynamics.with_step(0.005, "rk4").substeps == 3
    assert back.problem.dynamics.with_step(0.0125, "rk4").substeps == 8
    assert back.problem.dynamics.with_step(1e-4, "rk4").substeps == 1
    assert back.problem.dynamics.with_step(0.01, "euler").substeps == 1
    assert "6 substeps" in repr(problem.dynamics)


def test_what_has_no_substeps_says_so():
    m = Mechanism.from_mjcf(FAST_FINGER)
    with pytest.raises(PlannerError, match='expected integrator = "rk4"'):
        RigidBodyDynamics(m, 0.01, "semi-implicit-euler", substeps=2)
    for wrong in (0, 17, 1.5, True):
        with pytest.raises(PlannerError, match="substeps is"):
            RigidBodyDynamics(m, 0.01, substeps=wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(PlannerError, match=r"at most 16: stages of at most 0\.026"):
        RigidBodyDynamics(m, 0.01, substeps=6).with_step(0.03, "rk4")
    with pytest.raises(PlannerError, match="substeps=1"):
        planner.solve(replace(reach(6)), hessian="exact")
