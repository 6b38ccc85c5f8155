"""Second derivatives of distances in the compiled solver, against differences of its gradients."""

from typing import Any

import numpy as np
import pytest
from test_solid_terms import ARM, BALL, LINE, PAIRS, N, solid, states

from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.problem.costs.least_squares import PenaltyCost
from planner.problem.costs.penalty_terms import Clearance
from planner.solvers.engine import acquire_engine

STEP = 1e-5  # of the central differences, rad or m
ROUNDING = 1e-7  # of the largest entry: STEP^2 third derivatives of up to 100 / m^2, and 1e-16 / STEP of rounding
NEARBY = PAIRS | {"lines of trees": (solid(8, 27, **LINE), solid(2, 28, **LINE)),
                  "balls": (solid(8, 29, **BALL), solid(2, 30, **BALL))}  # fmt: skip


def symmetric(upper):
    upper = np.triu(upper)
    return upper + np.swapaxes(np.triu(upper, 1), 1, 2)


@pytest.mark.parametrize("name", NEARBY)
def test_curvature_is_what_gauss_newton_leaves_out(name):
    machine = Mechanism.from_mjcf(ARM, contacts="off")
    dynamics, us, nv = RigidBodyDynamics(machine, 0.02, "semi-implicit-euler"), np.zeros((N, 1)), machine.nv
    a, b = NEARBY[name]
    penalty = PenaltyCost(dynamics, N, [Clearance(a=a, b=b, lift=0.003, lower=5.0, tolerance=0.1)])
    tracking = TrackingCost.joints(dynamics, machine.home, N, effort=1.0)
    problem, xs = Problem(dynamics, tracking + penalty, machine.home), states(machine, np.random.default_rng(3))
    engine: Any = acquire_engine(problem)
    engine.residuals.bend(slice(0, 1))
    engine.start_from_controls(problem.x0, us)
    w = engine._w

    def gradient(at):
        w.xs[:], w.l[:] = at, 0.0
        dynamics.quadratize_nominal(w, engine._memory)
        return w.l[:, w.first : w.first + nv].copy()

    differences = np.empty((N + 1, nv, nv))
    for j in range(nv):
        step = np.tile(STEP * np.eye(machine.space.ndx)[j], (N + 1, 1))
        after, before = (gradient(machine.space.integrate(xs, way)) for way in (step, -step))
        differences[:, :, j] = (after - before) / (2.0 * STEP)
    differences = 0.5 * (differences + np.swapaxes(differences, 1, 2))  # of the exponential map, where axes turn
    gradient(xs)
    gauss_newton, bends = (symmetric(part[: N + 1, :nv, :nv]) for part in (w.residuals.hessian, w.residuals.bends))
    scale = np.abs(differences).max(axis=(1, 2))
    error = np.abs(gauss_newton + bends - differences).max(axis=(1, 2)) / scale
    assert np.sort(error)[-3] < ROUNDING  # two states may be so near a kink that the differences step across it
    assert np.median(np.abs(bends).max(axis=(1, 2)) / scale) > 0.1
