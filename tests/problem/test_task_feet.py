"""Feet of a machine at rest that goals of its frames move: what stays, and what carries it."""

import numpy as np
import pytest
from places import ROOT

import planner
from planner.dynamics.contacts import contact_forces
from planner.dynamics.inverse_kinematics import integrate_base
from planner.dynamics.kinematics import center_of_mass, center_of_mass_jacobian
from planner.problem.costs.tracking import tracking_of
from planner.problem.tasks.pose_constraints import BALANCE_SCALE, FOOT_SCALE, feet_of

BIPED = ROOT / "benchmarks" / "moving"


@pytest.fixture(scope="module")
def problem():
    return planner.load_problem(BIPED / "biped-lift.toml")


def differences(f, mechanism, q, h=1e-6):
    """Central differences of f by the velocities, whose error is h^2 / 6 f''' and rounding over h, both below 1e-9."""
    return np.stack(
        [(f(integrate_base(mechanism, q, h * e)) - f(integrate_base(mechanism, q, -h * e))) / (2 * h)
         for e in np.eye(mechanism.nv)], axis=-1,
    )  # fmt: skip


def test_jacobians_are_differences(problem):
    mechanism, q = problem.dynamics.mechanism, problem.x0[: problem.dynamics.mechanism.nq]
    J = center_of_mass_jacobian(mechanism, q)
    np.testing.assert_allclose(J, differences(lambda q: center_of_mass(mechanism, q), mechanism, q), atol=1e-8)
    feet = feet_of(mechanism, q)
    moved = feet.links == feet.links[-1]
    for residual in (feet.fixed, feet.on_ground, feet.stepped(moved), feet.lifted(moved)):
        by_q = differences(lambda q, residual=residual: residual(q)[0], mechanism, q)
        np.testing.assert_allclose(residual(q)[1], by_q, atol=1e-8 / FOOT_SCALE)


def test_a_foot_is_lifted_over_the_other_one(problem):
    """The centre of mass of the goal's pose is above the sole that stays, within what its residuals resolve."""
    mechanism = problem.dynamics.mechanism
    rows = tracking_of(problem.cost).x_ref[:, : mechanism.nq]
    loads = contact_forces(mechanism, rows[:1], np.zeros((1, mechanism.nv))).forces[0].any(axis=1)
    assert loads.sum() == 8  # the corners of both soles
    feet = feet_of(mechanism, rows[0])
    left = feet.links == mechanism.frame("left_foot").link
    middle = feet.places[left].mean(axis=0)
    swings = np.arange(len(rows)) * problem.dynamics.dt > 1.0
    c = center_of_mass(mechanism, rows)
    assert np.abs(c[swings, :2] - middle[:2]).max() < 2.0 * BALANCE_SCALE
    assert np.abs(c[0, 1] - middle[1]) > 0.08  # at the start it is between the feet, 0.18 m apart
    np.testing.assert_allclose(feet.fixed(rows[-1], np.flatnonzero(left))[0] * FOOT_SCALE, 0.0, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["squat", "lift"])
def test_a_biped_squats_and_lifts_a_foot(task):
    plan = planner.solve(planner.load_problem(BIPED / f"biped-{task}.toml"))
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
