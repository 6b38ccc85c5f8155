"""The compiled first guess of a controller's next plan is what NumPy makes of the plan before, rotations included."""

import numpy as np
import pytest

import planner
from planner.solvers.engine import acquire_engine
from planner.solvers.engine.protocol import TrackedTrajectory

FREE = """<mujoco><worldbody><body name="base"><freejoint/><inertial pos="0.1 0 0" mass="1" diaginertia="1 2 2.5"/>
<body pos="0 0 0.2"><joint name="arm" axis="0 1 0"/><inertial pos="0 0 0.2" mass="0.5" diaginertia="0.1 0.1 0.02"/>
</body></body></worldbody><actuator><motor joint="arm"/></actuator></mujoco>"""
N = 6


@pytest.fixture(scope="module")
def engine():
    mechanism = planner.Mechanism.from_mjcf(FREE)
    x0 = np.zeros(15)
    x0[3], x0[12] = 1.0, 0.5
    cost = planner.TrackingCost(np.eye(14) * np.ones((N + 1, 1, 1)), np.ones((N, 1, 1)), x0, 0.0, space=mechanism.space)
    problem = planner.Problem(planner.RigidBodyDynamics(mechanism, 0.02), cost, x0, 0.3 * np.ones((N, 1)))
    engine = acquire_engine(problem)
    cost = engine.start_from_controls(problem.x0, problem.first_guess)
    engine.iterate(True, 0, 0.0, True, cost, 0.0, -1.0)
    return engine


@pytest.mark.parametrize("stages", [0, 1, 2, N, 3 * N])
def test_moved_by_whole_stages(engine, stages):
    w, space = engine._w, engine._space
    rng = np.random.default_rng(stages)
    plan = TrackedTrajectory(w, space)
    xs = space.integrate(w.xs, 0.3 * rng.standard_normal((N + 1, 14)))
    plan.take((xs, rng.standard_normal((N, 1)), rng.standard_normal((N, 1, 14))))
    x0 = space.integrate(xs[min(stages, N)], 0.2 * rng.standard_normal(14))
    found = []
    for begin in (lambda: plan.begin(w, x0, float(stages)), lambda: plan._between(w, x0, float(stages))):
        w.xs[:], w.us[:], w.k[:], plan._rows[N:] = 0.0, 0.0, 1.0, 0.0
        begin()
        rows = plan._rows[min(stages, N) : min(stages, N) + N]
        found.append([w.xs.copy(), w.us.copy(), w.k.copy(), rows.copy()])
    for compiled, plain in zip(*found, strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found[0][0][0], x0)
    assert not found[0][2].any()


def test_a_plan_that_ran_away_is_not_read(engine):
    assert engine.read(1e-9) is None
    before = [part.copy() for part in engine.trajectory()]
    xs, us, _ = engine.read(1e9)
    np.testing.assert_array_equal(xs, before[0])
    np.testing.assert_array_equal(us, before[1])
