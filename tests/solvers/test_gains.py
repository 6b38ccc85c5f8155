"""Gains for ground that may be softer than the plan's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import planner
from planner.model.contact.laws import ContactLaw
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import Rollouts
from planner.proof.robustness.success import rule_of
from planner.solvers import lq
from planner.solvers.gains import PERSISTENCE, across_landings, has_uncertain_ground, robust_gains, with_robust_gains

STEP = Path(__file__).parents[2] / "benchmarks" / "moving" / "biped-step.toml"
LEG = """<mujoco><option timestep="0.001"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="trunk" pos="0 0 0.3"><joint name="z" type="slide" axis="0 0 1"/><geom type="sphere" size="0.05" mass="4"/>
<body name="foot" pos="0 0 -0.2"><joint name="leg" type="slide" axis="0 0 1"/>
<geom name="sole" type="sphere" size="0.1" mass="0.5"/></body></body></worldbody>
<actuator><motor name="push" joint="leg"/></actuator></mujoco>"""


def plain_gains(A, B, quadratic, bounds=None):
    sweep = lq.riccati(A, B, quadratic, bounds=bounds)
    assert sweep is not None
    return sweep.K


def robust(problem, xs, us, A, B, quadratic):
    K = robust_gains(problem, xs, us, A, B, quadratic, None)
    assert K is not None
    return K


def leg(uncertainty):
    mechanism = planner.Mechanism.from_mjcf(LEG, contacts="ground")
    contacts = tuple(replace(c, law=replace(c.law, uncertainty=uncertainty)) for c in mechanism.contacts)
    return replace(mechanism, contacts=contacts)


def one_stage(uncertainty, us, x0=(-0.003, 0.001, 0.1, -0.2)):
    """A stage from a foot that is pressed into the ground."""
    dynamics = planner.RigidBodyDynamics(leg(uncertainty), dt=0.005, integrator="rk4", substeps=4)
    cost = planner.TrackingCost(np.stack([np.zeros((4, 4)), np.diag([3.0, 2.0, 0.5, 0.2])]), np.full((1, 1, 1), 1e-3))
    problem = planner.Problem(dynamics, cost, x0=np.array(x0), us=us)
    xs = np.stack([problem.x0, dynamics.step(problem.x0[None], us)[0]])
    return problem, xs, *dynamics.linearize(xs, us), cost.quadratize(xs, us)


def other_dynamics(problem, factor):
    mechanism = problem.dynamics.mechanism
    softer = tuple(replace(c, law=replace(c.law, stiffness=c.law.stiffness * factor)) for c in mechanism.contacts)
    dynamics = problem.dynamics
    return planner.RigidBodyDynamics(
        replace(mechanism, contacts=softer), dt=dynamics.dt, integrator=dynamics.integrator, substeps=dynamics.substeps
    )


def test_the_gains_of_one_stage_minimize_the_expected_cost():
    us = np.array([[-30.0]])
    problem, xs, A, B, quadratic = one_stage(4.0, us)
    K = robust(problem, xs, us, A, B, quadratic)
    other_A, other_B = other_dynamics(problem, 0.25).linearize(xs, us)
    H = G = 0.0
    noise = np.sqrt(PERSISTENCE / problem.dynamics.dt)
    for w in (-noise, noise):  # of mean 0 and the variance of an error that lasts
        a, b = A[0] + w * (other_A[0] - A[0]), B[0] + w * (other_B[0] - B[0])
        H, G = H + 0.5 * b.T @ quadratic.Q[1] @ b, G + 0.5 * b.T @ quadratic.Q[1] @ a
    expected = -np.linalg.solve(H + quadratic.R[0], G)
    assert np.allclose(K[0], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    plain = plain_gains(A, B, quadratic)[0]
    assert np.abs(K[0] - plain).max() > 0.01 * np.abs(plain).max()  # the noise is seen


def test_known_ground_and_flight_have_the_gains_of_the_lq_problem():
    us = np.array([[-30.0]])
    problem, xs, A, B, quadratic = one_stage(1.0, us)
    assert not has_uncertain_ground(problem)
    plain = plain_gains(A, B, quadratic)
    assert np.array_equal(robust(problem, xs, us, A, B, quadratic), plain)
    problem, xs, A, B, quadratic = one_stage(4.0, us, x0=(0.1, 0.0, 0.0, 0.0))
    assert has_uncertain_ground(problem)
    assert np.array_equal(robust(problem, xs, us, A, B, quadratic), plain_gains(A, B, quadratic))


def test_ground_of_a_file_is_uncertain_and_a_law_that_a_user_gives_is_not():
    for ground in ("ground", "file"):
        assert {c.law.uncertainty for c in planner.Mechanism.from_mjcf(LEG, contacts=ground).contacts} == {4.0}
    law = ContactLaw.resting(4.5)
    assert {c.law.uncertainty for c in planner.Mechanism.from_mjcf(LEG, contacts=law).contacts} == {1.0}
    law = replace(law, uncertainty=2.0)
    assert {c.law.uncertainty for c in planner.Mechanism.from_mjcf(LEG, contacts=law).contacts} == {2.0}
    plain = ContactLaw(2e4, 100.0, uncertainty=3.0)  # without a ramp
    assert {c.law.uncertainty for c in planner.Mechanism.from_mjcf(LEG, contacts=plain).contacts} == {3.0}
    with pytest.raises(planner.PlannerError, match="uncertainty"):
        replace(law, uncertainty=0.5)


@pytest.mark.slow
def test_a_biped_that_has_just_stepped_stands_on_softer_ground_too(tmp_path):
    text = STEP.read_text(encoding="utf-8").replace("../../examples", str(STEP.parents[2] / "examples"))
    (tmp_path / "step.toml").write_text(f'contacts = "ground"\n{text}', encoding="utf-8")
    problem = planner.load_problem(tmp_path / "step.toml")
    plan = planner.solve(problem)
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    softer = other_dynamics(problem, 0.25).linearize(plan.xs, plan.us)
    assert plan.bound_penalties is None  # else the quadratic model had them
    quadratic = problem.cost.quadratize(plan.xs, plan.us)
    assert problem.bounds is not None
    plain = plain_gains(A, B, quadratic, problem.bounds.step_bounds(plan.xs, plan.us))
    landed = int(np.searchsorted(plan.t, 1.52))  # s: the foot lands at 1.5 s and carries a twentieth of the weight

    def growth(K):
        carried = np.eye(K.shape[2])
        for n in range(landed, plan.N):
            carried = (softer[0][n] + softer[1][n] @ K[n]) @ carried
        return np.linalg.norm(carried, 2)

    assert growth(plan.K) < 100.0 < 1000.0 < growth(plain)  # 12 and 9e5
    assert np.array_equal(with_robust_gains(plan).K, plan.K)  # they do not depend on the gains that were there
    assert planner.prove(plan, rollouts=0).passed


@pytest.mark.slow
def test_a_biped_shifts_its_weight_on_floors_that_lie_higher_or_lower():
    """By up to 5 mm; with the gains of the plan's own ground two rollouts of three fall."""
    plan = planner.solve(planner.load_problem(STEP.with_name("biped-shift.toml")))
    nothing = dict.fromkeys(Perturbation().to_dict(), 0.0)
    floors, rule = Perturbation(**{**nothing, "floor": 0.005}), rule_of(plan)
    with Rollouts(plan, CompiledTwin(plan.twin)) as simulator:
        draws = [draw(floors, 0, k, simulator.nominal.sizes) for k in range(16)]
        ends = simulator.run(simulator.batch(draws), "feedback")[:, -1]
    assert rule.succeeded(ends).all()


def test_gains_of_the_stage_of_a_landing_are_the_mean_of_those_beside_it():
    K = np.random.default_rng(0).normal(size=(20, 2, 4))
    smooth = across_landings(K, [0, 7, 12, 13, 19])
    for n in range(20):
        if n not in (7, 12, 13):  # before the first stage, and after the last, there are none
            np.testing.assert_array_equal(smooth[n], K[n])
    np.testing.assert_allclose(smooth[7], 0.5 * (K[6] + K[8]), rtol=1e-12)
    np.testing.assert_allclose(smooth[12], (2.0 * K[11] + K[14]) / 3.0, rtol=1e-12)  # two feet, one after the other
    np.testing.assert_allclose(smooth[13], (K[11] + 2.0 * K[14]) / 3.0, rtol=1e-12)
    np.testing.assert_array_equal(across_landings(K, ()), K)
