"""An explicit Runge-Kutta method is a row of KNOWN_INTEGRATORS: Heun's, added here, needs nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gradients import assert_step_derivatives, second_order_differences
from machines import HAND_ARM
from trees import CHAINS, actuated

import planner
from planner import Mechanism, RigidBodyDynamics
from planner.kernels.integrators import KNOWN_INTEGRATORS, Integrator

HEUN = Integrator(2, evaluations=2, lengths=(1.0,))
TWO_STAGES = Integrator(2, evaluations=3, lengths=(0.5, 1.0), middle=4.0, turned=(1.0 / 8.0, 1.0 / 12.0))
"""Of second order for every weight of the middle: (m / 2 + 1) / (m + 2) = 1 / 2."""


@pytest.fixture(autouse=True)
def rows(monkeypatch):
    monkeypatch.setitem(KNOWN_INTEGRATORS, "heun", HEUN)
    monkeypatch.setitem(KNOWN_INTEGRATORS, "two stages", TWO_STAGES)


def at_random(name, integrator, dt=0.02):
    m, rng = Mechanism.from_mjcf(actuated(CHAINS[name], np.random.default_rng(0))), np.random.default_rng(1)
    x = m.space.integrate(m.home, 0.3 * rng.normal(size=m.space.ndx))
    return RigidBodyDynamics(m, dt, integrator), x, rng.normal(size=m.nu)


def test_weights_are_those_of_the_textbooks():
    np.testing.assert_allclose(KNOWN_INTEGRATORS["rk4"].weights, [1 / 6, 1 / 3, 1 / 3, 1 / 6], rtol=1e-15)
    assert HEUN.weights == (0.5, 0.5)


@pytest.mark.parametrize("integrator", ["heun", "two stages"])
@pytest.mark.parametrize("name", CHAINS)
def test_it_is_of_its_order_and_its_derivatives_are_those_of_differences(name, integrator):
    dynamics, x, u = at_random(name, integrator)
    space = dynamics.space
    ends = []
    for parts in (2, 4, 8):
        finer, end = dynamics.with_step(0.02 / parts, integrator), x[None]
        for _ in range(parts):
            end = finer.step(end, u[None])
        ends.append(end[0])
    changes = [np.abs(space.difference(a, b)).max() for a, b in zip(ends[1:], ends[:-1], strict=True)]
    assert abs(np.log2(changes[0] / changes[1]) - 2.0) < 0.2  # the next term of the error is a few percent here

    assert_step_derivatives(dynamics, x, u)


def test_its_second_derivatives_are_differences_of_first_ones():
    dynamics, x, u = at_random("arm", "heun", dt=0.1)
    at = np.stack([x, x]), u[None], np.random.default_rng(2).normal(size=(2, dynamics.ndx))
    T = second_order_differences(dynamics, *at)
    assert np.abs(dynamics.second_order(*at) - T).max() < 1e-7 * np.abs(T).max()


def test_a_plan_with_it_is_repeated_to_rounding_shows_its_order_and_is_stored(tmp_path):
    arm = Mechanism.from_mjcf(HAND_ARM)
    goals = planner.Goal(joints={arm.joint_names[0]: 0.5})
    problem = planner.task(arm, start=arm.home, goals=goals, duration=0.5)
    dynamics = problem.dynamics.with_step(problem.dynamics.dt, "heun")
    plan = planner.solve(replace(problem, dynamics=dynamics))
    proof = planner.prove(plan, rollouts=0)
    assert plan.success
    assert proof.same_step.passed  # 1e-10 of a stage
    assert proof.same_step.measured
    assert abs(proof.convergence.observed - 2.0) < 0.2  # what a proof judges it by, ORDER_BOUND
    again = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert again.problem.dynamics.integrator == "heun"
