"""The work of motors by kernels beside NumPy: value, gradient, Hessian and engines; one smoothing for every solve."""

from dataclasses import replace

import numpy as np
import pytest
from carts import cart
from engines import assert_same_iterations, both_engines
from trees import CHAINS, driven, random_state

import planner
from planner import Limits, PlannerError
from planner.costs import EnergyCost, Quadratic, TrackingCost, with_objective
from planner.dynamics.joint_forces import force_derivatives_at, forces_at
from planner.problem.costs.terms import Term
from planner.problem.objective import base_problem, solver_problem
from planner.problem.problem import Problem
from planner.solvers.engine import NumpyEngine


class InNumpy(Term):
    """The same cost in NumPy, by the actuators' forces and their derivatives at both ends of each stage."""

    def __init__(self, cost):
        self.cost, self.m, self.space, self.ndx, self.nu = cost, cost.mechanism, cost.space, cost.ndx, cost.nu

    def _parts(self, xs, us):
        move = self.space.difference(xs[1:], xs[:-1])
        both = np.concatenate([xs[:-1], xs[1:]]), np.concatenate([us, us])
        force = 0.5 * forces_at(self.m, *both).reshape(2, *us.shape).sum(axis=0)
        return force, move[:, : self.m.nv] @ self.m.actuators.moment.T, move, force_derivatives_at(self.m, *both)

    def powers(self, xs, us):
        force, way, *_ = self._parts(xs, us)
        return force * way / self.cost.dt

    def value(self, xs, us):
        p, s = self.powers(xs, us), self.cost.smoothing
        return self.cost.weight * self.cost.dt * np.sum(np.sqrt(p * p + s * s) - s)

    def quadratize(self, xs, us):
        N, (force, way, move, (of_x, of_u)) = len(us), self._parts(xs, us)
        along = np.pad(self.m.actuators.moment, ((0, 0), (0, self.ndx - self.m.nv)))
        by_end = force[:, :, None] * (along @ self.space.difference_jacobian(move)) + 0.5 * way[:, :, None] * of_x[N:]
        by_x = -force[:, :, None] * (along @ self.space.difference_jacobian(-move)) + 0.5 * way[:, :, None] * of_x[:N]
        by_x, by_end = by_x / self.cost.dt, by_end / self.cost.dt
        by_u = 0.5 * (way * (of_u[:N] + of_u[N:]))[:, :, None] * np.eye(self.nu) / self.cost.dt
        p = force * way / self.cost.dt
        curvature = self.cost.weight * self.cost.dt / np.sqrt(p * p + self.cost.smoothing**2)
        q, Q = np.zeros((N + 1, self.ndx)), np.zeros((N + 1, self.ndx, self.ndx))
        q[:N] = np.einsum("nji,nj->ni", by_x, curvature * p)
        q[1:] += np.einsum("nji,nj->ni", by_end, curvature * p)
        r = np.einsum("njk,nj->nk", by_u, curvature * p)
        A, B = self.cost.dynamics.linearize(xs, us)
        by_x, by_u = by_x + by_end @ A, by_u + by_end @ B
        Q[:N] = by_x.mT @ (curvature[:, :, None] * by_x)
        return Quadratic(Q, q, by_u.mT @ (curvature[:, :, None] * by_u), r, by_u.mT @ (curvature[:, :, None] * by_x))


def trajectory(name, integrator, N):
    """A machine of CHAINS, states (N+1, nx) each some way from the last, and controls (N, nu)."""
    dynamics, _, us, rng = driven(CHAINS[name], 3, N, integrator, prescribe=False)
    xs = [random_state(dynamics.space, rng, unnormalized=False)]
    for _ in range(N):
        xs.append(dynamics.space.integrate(xs[-1], 0.3 * rng.normal(size=dynamics.ndx)))
    return dynamics, np.array(xs), us


@pytest.mark.parametrize("name", CHAINS)
@pytest.mark.parametrize("integrator", ["rk4", "semi-implicit-euler", "rosenbrock"])
def test_kernels_do_what_numpy_does(name, integrator):
    """Five stages: four lanes and a rest."""
    dynamics, xs, us = trajectory(name, integrator, 5)
    cost = EnergyCost(dynamics, 2.0, 0.5)
    twin = InNumpy(cost)
    np.testing.assert_allclose(cost.power(xs, us), twin.powers(xs, us), rtol=1e-10, atol=1e-12)
    assert cost.value(xs, us) == pytest.approx(twin.value(xs, us), rel=1e-12)
    for found, wanted in zip(cost.quadratize(xs, us), twin.quadratize(xs, us), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["arm", "body in space"])
def test_the_hessian_is_that_of_the_parabola_above_along_the_dynamics(name):
    """e'(p)/p dp dp', with dp by central differences of a stage that the dynamics end."""
    dynamics, xs, us = trajectory(name, "semi-implicit-euler", 1)
    cost, h, n = EnergyCost(dynamics, 2.0, 0.5), 1e-6, dynamics.ndx
    xs[1] = dynamics.step(xs[:1], us)[0]

    def powers(z):
        x = dynamics.space.integrate(xs[0], z[:n])[None]
        return cost.power(np.concatenate([x, dynamics.step(x, us + z[n:])]), us + z[n:])[0]

    dp = np.stack([(powers(z) - powers(-z)) / (2.0 * h) for z in h * np.eye(n + dynamics.nu)], axis=1)
    size = cost.weight * dynamics.dt / np.sqrt(cost.power(xs, us)[0] ** 2 + cost.smoothing**2)
    wanted, model = dp.T @ (size[:, None] * dp), cost.quadratize(xs, us)
    found = np.block([[model.Q[0], model.S[0].T], [model.S[0], model.R[0]]])
    np.testing.assert_allclose(found, wanted, atol=1e-6 * np.abs(wanted).max())


def smooth_problem(name, integrator, weights, limits):
    dynamics, xs, us, _ = driven(CHAINS[name], 7, 9, integrator, prescribe=False)
    cost = TrackingCost.joints(dynamics, xs[0], 8, effort=1e-2, velocity=0.1, final_position=1.0)
    given = Problem(dynamics, cost, xs[1], us[:8], limits=limits)
    return solver_problem(with_objective(given, {"effort": 1.0, "smoothing": 0.1} | weights))


@pytest.mark.parametrize("limits", [None, Limits(control=0.5)])
@pytest.mark.parametrize(("name", "integrator", "weights"), [
    ("arm", "semi-implicit-euler", {"energy": 0.5}), ("balls", "semi-implicit-euler", {"energy": 0.5}),
    ("body in space", "rk4", {"energy": 0.5}), ("arm", "rosenbrock", {"energy": 0.5}),
    ("arm", "semi-implicit-euler", {"energy": 0.5, "jerk": 1e-4}), ("balls", "rk4", {"energy": 0.5, "jerk": 1e-4}),
])  # fmt: skip
def test_least_energy_is_compiled_and_does_what_numpy_does(name, integrator, weights, limits):
    """Sweeps, rollouts and line searches, the other engine with the cost in NumPy."""
    problem = smooth_problem(name, integrator, weights, limits)
    ours, twin = both_engines(problem)
    if "jerk" not in weights:  # whose states have more, see problem.costs.jerk
        tracking, energy = problem.cost.costs
        twin = NumpyEngine(replace(problem, cost=tracking + InNumpy(energy)))
    twin.start_from_controls(problem.x0, problem.first_guess)
    ours.largest_control_weight = twin.largest_control_weight  # the unit of what is added to R: nothing here
    assert_same_iterations((ours, twin), problem, [True, False, True], within=1e-7)


def test_every_solve_of_energy_has_the_smoothing_of_the_motion_of_least_effort():
    """Whatever the size of the machine's power: that of a cart with forces and mass the size is the size."""
    problem = with_objective(cart(), "energy")
    usual = planner.solve(base_problem(problem))
    mean = np.abs(EnergyCost(problem.dynamics).power(usual.xs, usual.us)).mean()
    plans = [planner.solve(problem), planner.solve_for(cart(), "energy"), planner.solve(problem, warm_start=usual)]
    for plan in plans:
        assert plan.success
        assert plan.problem.objective.smoothing == pytest.approx(0.02 * mean, rel=1e-2)
    assert np.array_equal(plans[0].us, plans[1].us)
    again = planner.solve(plans[0].problem, warm_start=plans[0])
    assert again.problem.objective.smoothing == plans[0].problem.objective.smoothing


def test_without_smoothing_it_is_a_measure():
    dynamics, xs, us = trajectory("arm", "rk4", 3)
    measure = EnergyCost(dynamics, 2.0)
    assert measure.value(xs, us) == pytest.approx(2.0 * measure.work(xs, us), rel=1e-12)
    at_rest = np.tile(xs[:1], (4, 1))
    assert measure.value(at_rest, us) == 0.0
    assert measure.smoothing_along(at_rest, us) == 1.0  # W: no power tells another
    with pytest.raises(PlannerError, match="the energy has no smoothing, expected one in W"):
        measure.quadratize(xs, us)
