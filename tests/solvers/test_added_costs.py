"""A user's own cost beside compiled terms: the numbers of the slow engine, in little more than the compiled's time."""

import time

import numpy as np
import pytest
from arms import mechanism
from engines import assert_same_iterations, both_engines
from hypothesis import strategies as st
from trees import drawn, machines

import planner
from planner import Constraint, FrameCost, Limits, Problem
from planner.costs import Quadratic
from planner.kernels.integrators import INTEGRATORS
from planner.solvers.engine import ConstrainedEngine, HybridEngine, NumpyEngine, acquire_engine
from planner.solvers.options import LINE_SEARCHES


class Own:
    """A convex quadratic of states and controls, mixed terms among them."""

    def __init__(self, rng, N, ndx, nu, space):
        L = rng.normal(size=(N + 1, ndx + nu, ndx + nu)) / (ndx + nu)
        self.H, self.h = L @ np.swapaxes(L, 1, 2), rng.normal(size=(N + 1, ndx + nu))
        self.H[-1, ndx:], self.H[-1, :, ndx:], self.h[-1, ndx:] = 0.0, 0.0, 0.0
        self.space, self.ndx, self.asked = space, ndx, 0

    def z(self, xs, us):
        origin = np.zeros((len(xs), self.space.nx))
        for i, _ in self.space.quaternions:
            origin[:, i] = 1.0
        e = self.space.difference(xs, origin)
        return e, np.concatenate([e, np.vstack([us, 0.0 * us[:1]])], axis=1)

    def value(self, xs, us):
        _, z = self.z(xs, us)
        return float(0.5 * np.einsum("ni,nij,nj->", z, self.H, z) + np.sum(self.h * z))

    def quadratize(self, xs, us):
        self.asked += 1
        e, z = self.z(xs, us)
        n, H = self.ndx, self.H.copy()
        g = np.einsum("nij,nj->ni", H, z) + self.h
        E = np.linalg.inv(self.space.difference_jacobian(e)) if self.space.quaternions else np.eye(n)
        q = np.einsum("...ji,...j->...i", np.broadcast_to(E, (len(e), n, n)), g[:, :n])
        E = np.broadcast_to(E, (len(e), n, n))
        Q = np.swapaxes(E, 1, 2) @ H[:, :n, :n] @ E
        return Quadratic(Q, q, H[:-1, n:, n:], g[:-1, n:], H[:-1, n:, :n] @ E[:-1])


@machines(16, max_dofs=12, max_bodies=4, integrator=st.sampled_from(INTEGRATORS), full=st.booleans())
def test_both_engines_do_the_same(text, seed, integrator, full):
    task, rng = drawn(text, seed, integrator, full), np.random.default_rng(seed)
    dynamics = task.dynamics
    own = Own(rng, task.N, dynamics.space.ndx, dynamics.nu, dynamics.space)
    limits = Limits(control=2.0) if rng.random() < 0.3 else None
    kept = [Constraint(lambda xs: xs[:, -1], lower=-1.0, when=(task.dynamics.dt, 1e9))] if rng.random() < 0.3 else ()
    task = Problem(dynamics, task.cost + own, task.x0, task.first_guess, limits=limits, constraints=kept)
    engines = both_engines(task, ConstrainedEngine if kept else HybridEngine)
    assert_same_iterations(engines, task, [True, False], within=1e-7)


def arm(own):
    """A reach of the hand of the arm, with a cost of one's own beside it or without."""
    machine, N = mechanism(), 50
    dynamics = planner.RigidBodyDynamics(machine, 0.02)
    x0 = np.array([0.5, -1.0, 0.0, 0.0])
    reach = FrameCost(machine, "hand", position=(0.3, 0.0, -0.2), final_position_weight=1e3, dt=0.02)
    cost = planner.TrackingCost.joints(dynamics, x0, N, effort=1e-2, velocity=0.1) + reach
    return Problem(dynamics, cost + own if own is not None else cost, x0, horizon=N)


class Elbow:
    """The elbow near a right angle on the way."""

    def value(self, xs, us):
        return float(np.sum((xs[:-1, 1] + 1.5) ** 2))

    def quadratize(self, xs, us):
        Q, q = np.zeros((len(xs), 4, 4)), np.zeros((len(xs), 4))
        Q[:-1, 1, 1], q[:-1, 1] = 2.0, 2.0 * (xs[:-1, 1] + 1.5)
        return Quadratic(Q, q, np.zeros((len(us), 2, 2)), np.zeros((len(us), 2)))


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("line_search", ["armijo", "exact", "goldstein", "wolfe"])
def test_a_solve_ends_where_that_in_numpy_ends(hessian, line_search, monkeypatch):
    task = arm(Elbow())
    wolfe = LINE_SEARCHES.index("wolfe")  # it needs slopes, and a user's cost has none at a candidate
    assert isinstance(acquire_engine(task, wolfe), NumpyEngine)
    ours = planner.solve(task, hessian=hessian, line_search=line_search)
    monkeypatch.setattr("planner.solvers.slq.acquire_engine", lambda problem, rule: NumpyEngine(problem))
    twin = planner.solve(arm(Elbow()), hessian=hessian, line_search=line_search)
    assert ours.converged
    assert twin.converged
    assert ours.cost == pytest.approx(twin.cost, rel=1e-9)
    assert ours.nit == pytest.approx(twin.nit, abs=2)  # the last iterations gain rounding


def test_an_iteration_takes_little_more_than_without_it():
    """1.3 times on a 7-joint arm; in NumPy it was 17 times."""
    least = {}
    for own in (None, Elbow()):
        task, spent = arm(own), []
        planner.solve(task)
        for _ in range(5):
            began = time.process_time()
            plan = planner.solve(task, max_iterations=15)
            spent.append((time.process_time() - began) / plan.nit)
        least[own is not None] = min(spent)
    assert least[True] < 5.0 * least[False]  # neighbours on the machine: 1.5 is usual


def test_a_wrong_shape_is_refused():
    class Wrong(Elbow):
        def quadratize(self, xs, us):
            return super().quadratize(xs, us)._replace(q=np.zeros((len(xs), 3)))

    with pytest.raises(planner.PlannerError, match=r"the cost's quadratize gives q of shape \(51, 3\), expected"):
        planner.solve(arm(Wrong()))
