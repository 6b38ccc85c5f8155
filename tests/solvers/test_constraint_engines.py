"""Constraints in both engines: the same numbers, and derivatives that are differences of the values."""

import numpy as np
import pytest
from engines import assert_same_iterations, both_engines
from hypothesis import strategies as st
from trees import drawn, machines

from planner import Constraint, Limits, Mechanism, Problem, RigidBodyDynamics
from planner.constraints import CenterOfMass, FrameAxisAngle, FrameOrientation, FramePosition, Power
from planner.costs import Distance, Height, Point, Segment, Velocity
from planner.kernels.integrators import INTEGRATORS
from planner.problem.constraints.constraint import residual_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.solvers.engine import ConstrainedEngine

TOLERANCE = {"tolerance": 1e-3}


def of_all_kinds(rng, dynamics):
    """A constraint of each kind, with bounds on both sides of what a random motion does."""
    m = dynamics.mechanism
    frames = [str(one) for one in rng.choice([*m.sites, *filter(None, m.body_names)], 6)]
    a, b, c = (Point(frame, offset=rng.normal(size=3)) for frame in frames[:3])
    names = [name for name in m.actuators.names if name]

    def smooth(xs):
        return np.sin(xs[:, -dynamics.mechanism.nv :]).sum(axis=1)

    def mixed(xs, us):
        return np.stack([us[:, 0] * xs[:, -1], us[:, -1] ** 2], axis=1)

    kinds = [
        Constraint(Height(a, lower=0.3, **TOLERANCE)),
        Constraint(Height(b, target=0.1, **TOLERANCE)),
        Constraint(Distance(a, Segment(b, c, radius=0.1), lower=1.0, **TOLERANCE)),
        Constraint(Velocity(c, rng.normal(size=3), upper=0.2, **TOLERANCE)),
        Constraint(FramePosition(frames[3]), lower=-rng.random(3), upper=rng.random(3)),
        Constraint(FramePosition(frames[4]), equal=np.zeros(3), when="end"),
        Constraint(FrameOrientation(frames[5], rng.normal(size=4)), equal=0.0, when="end"),
        Constraint(FrameAxisAngle(frames[0], rng.normal(size=3), rng.normal(size=3)), upper=0.7),
        Constraint(CenterOfMass(), lower=[np.nan, -0.2, 0.0]),
        Constraint(smooth, lower=-0.1, upper=0.1),
        Constraint(mixed, upper=[0.1, 0.2]),
        *(Constraint(Power(name), lower=-0.1, upper=0.1) for name in names[:2]),
    ]
    return [kinds[i] for i in sorted(rng.choice(len(kinds), 5, replace=False))]


def later(constraints, task):
    """The same from the second knot on: a random start breaks some."""
    dt, N = task.dynamics.dt, task.N
    return [one if one.when == "end" else Constraint(**(vars(one) | {"when": (dt, N * dt)})) for one in constraints]


def hinged(rng, kept):
    """Hinges as multipliers make them: shifted bounds and weights."""
    lower, upper = kept.lower - 0.1 * rng.random(kept.lower.shape), kept.upper + 0.1 * rng.random(kept.lower.shape)
    exact = kept.lower == kept.upper
    weight = rng.random(lower.shape) * (np.isfinite(lower) | np.isfinite(upper))
    return BoundPenalties(np.where(exact, upper, lower), upper, weight)


@machines(16, max_dofs=12, max_bodies=4, integrator=st.sampled_from(INTEGRATORS), full=st.booleans())
def test_both_engines_do_the_same(text, seed, integrator, full):
    task, rng = drawn(text, seed, integrator, full), np.random.default_rng(seed)
    limits = Limits(control=2.0) if rng.random() < 0.3 else None
    constraints = later(of_all_kinds(rng, task.dynamics), task)
    task = Problem(task.dynamics, task.cost, task.x0, task.first_guess, limits=limits, constraints=constraints)
    engines = both_engines(task, ConstrainedEngine)
    hinges = hinged(rng, task.trajectory_constraints)
    assert_same_iterations(engines, task, [True], penalties=hinges, within=1e-7)


@machines(12, max_dofs=10, max_bodies=4)
def test_derivatives_are_differences(text, seed):
    task, rng = drawn(text, seed, "rk4", True), np.random.default_rng(seed)
    space, nu, h = task.dynamics.space, task.dynamics.nu, 1e-6
    x = space.integrate(task.x0, 0.5 * rng.normal(size=space.ndx))
    u, n = rng.normal(size=nu), np.zeros(1, dtype=int)
    for constraint in of_all_kinds(rng, task.dynamics):
        measure = residual_of(constraint, task.dynamics, task.N, task.x0, task.first_guess[0])
        by_x, by_u = measure.derivatives(x[None], u[None], n)
        size = 1.0 + np.abs(measure.values(x[None], u[None], n)).max()

        def at(dx, du, measure=measure):
            return measure.values(space.integrate(x, dx)[None], (u + du)[None], n)[0]

        for i, e in enumerate(h * np.eye(space.ndx)):
            slope = (at(e, 0.0) - at(-e, 0.0)) / (2.0 * h)
            # rounding of a difference over h, and what curvature makes of it near kinks
            assert slope == pytest.approx(by_x[0, :, i], rel=1e-5, abs=1e-7 * size / 1e-1), constraint
        for i, e in enumerate(h * np.eye(nu)):
            slope = (at(0.0 * x[: space.ndx], e) - at(0.0 * x[: space.ndx], -e)) / (2.0 * h)
            assert slope == pytest.approx(by_u[0, :, i], rel=1e-5, abs=1e-6 * size), constraint


HINGE = """<mujoco><worldbody><body><joint name="turn" axis="0.6 0 0.8" range="-360 360"/>
  <geom type="capsule" fromto="0 0 0 0 0.4 0" size=".03"/><site name="cup" pos="0 0.4 0"/></body></worldbody>
  <actuator><motor joint="turn"/></actuator></mujoco>"""


@pytest.mark.parametrize("q", [0.3, 1.2, 2.8, -2.0])
def test_the_bend_of_a_tilt_is_its_second_derivative(q):
    """Exactly so where one hinge turns an axis at a right angle to its own: nothing else is curved then."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(HINGE), 0.01)
    measure, n, h = (
        FrameAxisAngle("cup", (0.1, -0.3, 0.5), (0.0, 1.0, 0.0)).residual_function(dynamics, 1),
        np.zeros(1, dtype=int),
        1e-5,
    )

    def slope(at):
        return measure.derivatives(np.array([[at, 0.0]]), np.zeros((1, 1)), n)[0][0, 0, 0]

    second = (slope(q + h) - slope(q - h)) / (2.0 * h)
    both = [measure.second_derivatives(np.array([[q, 0.0]]), n, np.array([[pull]]))[0] for pull in (1.0, -1.0)]
    # what keeps it finite at the kink is 1e-6 of the squared sine
    assert [one[0, 0] for one in both] == pytest.approx([max(second, 0.0), max(-second, 0.0)], rel=1e-4, abs=1e-6)
    assert max(np.abs(one).max() for one in both) > 0.01
    assert not any(one[1].any() or one[:, 1].any() for one in both)
