"""Distances of two solids in the compiled solver: against their NumPy twin, and that against differences."""

import numpy as np
import pytest
from machines import gantry
from scipy.spatial.transform import Rotation

from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics.contact_kinematics import SignedDistances, distance_lower_bound
from planner.model.contact.signed_distance import CollisionShape
from planner.problem.costs.least_squares import PenaltyCost
from planner.problem.costs.penalty_terms import Clearance
from planner.solvers.engine import acquire_engine

ARM = """<mujoco><worldbody><body name="a"><joint name="a" axis="0 0 1"/><geom size=".1" mass="1"/>
  <body name="b" pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom size=".1" mass="1"/>
  <body name="c" pos=".3 0 0"><joint name="c" axis="1 0 1"/><geom size=".1" mass="1"/></body></body></body>
  <body name="free" pos="0 .3 0"><freejoint/><geom size=".1" mass="1"/></body></worldbody>
  <actuator><motor joint="a"/></actuator></mujoco>"""
N = 21


def solid(link, seed, half=(0.0, 0.0, 0.0), radius=0.0, plane=False):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = 0.1 * np.random.default_rng(seed).normal(size=3)
    return CollisionShape(f"solid {seed}", 0, link, T, np.array(half), radius, plane)


LINE, BALL, BOX, PLANE = (
    {"half": (0.0, 0.0, 0.2), "radius": 0.05}, {"radius": 0.05}, {"half": (0.1, 0.15, 0.2), "radius": 0.01},
    {"plane": True},
)  # fmt: skip
# On links 2, 1, 0 of the arm, 8 of what is free, -1 of the world. The last ones are in each other, at the same place.
PAIRS = {
    "lines": (solid(2, 1, **LINE), solid(-1, 2, **LINE)), "ball and line": (solid(8, 3, **BALL), solid(2, 4, **LINE)),
    "line and box": (solid(2, 5, **LINE), solid(-1, 6, **BOX)), "two links": (solid(1, 7, **BALL), solid(2, 8, **BOX)),
    "boxes": (solid(2, 9, **BOX), solid(-1, 10, **BOX)), "boxes of trees": (solid(8, 11, **BOX), solid(2, 12, **BOX)),
    "line and plane": (solid(2, 13, **LINE), solid(-1, 14, **PLANE)),
    "box and plane": (solid(8, 15, **BOX), solid(-1, 16, **PLANE)),
    "moving plane": (solid(2, 17, **BOX), solid(0, 18, **PLANE)),
    "world first": (solid(-1, 19, **LINE), solid(1, 20, **BOX)),
    "line in box": (solid(0, 21, **LINE), solid(-1, 22, **BOX)),
    "box in box": (solid(0, 23, **BOX), solid(-1, 24, **BOX)),
    "ball in box": (solid(0, 25, **BALL), solid(-1, 26, **BOX)),
}  # fmt: skip


@pytest.fixture(scope="module")
def machine():
    return Mechanism.from_mjcf(ARM, contacts="off")


def states(machine, rng):
    xs = np.concatenate([rng.uniform(-2.0, 2.0, (N + 1, machine.nq)), rng.normal(size=(N + 1, machine.nv))], axis=1)
    xs[:, 3:6] *= 0.2
    xs[:, 6:10] /= np.linalg.norm(xs[:, 6:10], axis=1, keepdims=True)
    return xs


def test_derivatives_are_differences_of_the_distances(machine):
    xs, h, space = states(machine, np.random.default_rng(0)), 1e-6, machine.space
    clearances = SignedDistances(machine, list(PAIRS.values()))
    values, rows = clearances.derivatives(xs[:, : machine.nq])
    assert (values < -0.1).any(axis=0)[-3:-1].all()  # some lie deep in each other
    for i in range(machine.nv):
        step = np.tile(h * np.eye(space.ndx)[i], (N + 1, 1))
        after, before = (clearances.values(space.integrate(xs, way)[:, : machine.nq]) for way in (step, -step))
        np.testing.assert_allclose(rows[:, :, i], (after - before) / (2.0 * h), rtol=0, atol=1e-7)


def test_terms_are_the_same_compiled_and_in_numpy(machine):
    """Gradients, Hessians and the cost of a rollout; each pair alone, so that none hides another."""
    dynamics, us = RigidBodyDynamics(machine, 0.02, "semi-implicit-euler"), np.zeros((N, 1))
    tracking, xs = TrackingCost.joints(dynamics, machine.home, N, effort=1.0), states(machine, np.random.default_rng(1))
    for name, (a, b) in PAIRS.items():
        term = Clearance(a=a, b=b, lift=0.003, lower=0.3 * np.arange(N + 1) % 1.0, tolerance=0.1)
        penalty = PenaltyCost(dynamics, N, [term])
        problem = Problem(dynamics, tracking + penalty, machine.home)
        engine = acquire_engine(problem)
        cost = engine.start_from_controls(problem.x0, us)
        w = engine._w
        assert cost == pytest.approx(problem.cost.value(w.xs, us), rel=1e-12), name
        w.xs[:], w.l[:] = xs, 0.0
        dynamics.quadratize_nominal(w, engine._memory)
        model, nv = penalty.quadratize(xs, us), machine.nv
        assert np.abs(model.q).max() > 0.01, name
        H = np.triu(w.residuals.hessian[: N + 1, :nv, :nv])
        H = H + np.swapaxes(np.triu(H, 1), 1, 2)
        scale = np.abs(model.Q).max()
        np.testing.assert_allclose(
            w.l[:, w.first : w.first + 2 * nv], model.q, rtol=0, atol=1e-10 * np.abs(model.q).max()
        )
        np.testing.assert_allclose(H, model.Q[:, :nv, :nv], rtol=0, atol=1e-10 * scale, err_msg=name)


def test_distances_do_not_change_faster_than_pairs_move():
    machine, rng = (
        Mechanism.from_mjcf(gantry(tool='type="box" size=".05 .05 .05" euler="10 20 30"')),
        np.random.default_rng(0),
    )
    tool = solid(1, 3, half=(0.05, 0.02, 0.1))
    clearances = SignedDistances(machine, [(tool, solid(-1, 4, **PLANE)), (tool, solid(-1, 5, **BOX))])
    q = np.cumsum(0.05 * rng.normal(size=(40, 2)), axis=0)
    moved = clearances.motion_bound(q[:-1], np.diff(q, axis=0))
    fine = np.array([clearances.values(q[:-1] + s * np.diff(q, axis=0)) for s in np.linspace(0.0, 1.0, 21)]).min(axis=0)
    bound = distance_lower_bound(clearances.values(q), moved)
    assert np.all(bound <= fine + 1e-12)
    assert np.mean(fine - bound) < 0.5 * np.mean(moved)
