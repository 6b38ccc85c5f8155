"""Growth predicts the replay's error, and halving the step shows the integrator's order."""

import functools
from dataclasses import replace

import numpy as np
import pytest

import planner
from planner import Problem, cases
from planner.model.mjcf.text import edited
from planner.proof.error_propagation import FACTOR, SMALL
from planner.proof.error_scales import path_error_bounds, shares_of_bounds
from planner.proof.step_convergence import ORDER_BOUND, _level, _observed


def proof_of(problem, **options):
    return planner.prove(planner.solve(problem), rollouts=0, **options)


def values(section):
    return {figure.name: figure.value for figure in section.measured}


@pytest.fixture(scope="module")
def proofs():
    problems = {
        "two-link": cases.two_link(horizon=100), "acrobot": cases.acrobot(),
        "acrobot, hanging": cases.acrobot(start="hanging"),
    }  # fmt: skip
    return {name: proof_of(problem) for name, problem in problems.items()}


def test_growth_is_told_in_shares_of_what_passes(proofs):
    proof = proofs["acrobot"]
    run = proof.replays["open-loop"]
    knots = run.error[:: run.substeps]
    np.testing.assert_array_equal(proof.errors.measured["open-loop"], shares_of_bounds(run.plan, knots))
    assert proof.errors.measured["open-loop"].max() <= 1.0  # it passes
    assert values(proof.growth)["predicted_over_bound_open_loop"] == proof.errors.predicted["open-loop"].max()
    np.testing.assert_allclose(
        proof.convergence.shares,
        shares_of_bounds(run.plan, run.plan.space.difference(proof.convergence.ends[1:], proof.convergence.ends[:-1])),
    )


@pytest.mark.parametrize("mode", ["open-loop", "feedback"])
def test_the_replays_error_is_the_predicted_one(proofs, mode):
    """Within a factor of 10 wherever the measured error is below 0.1, and mostly within 10 %."""
    seen = 0
    for proof in proofs.values():
        measured, predicted = (part[mode].max() for part in (proof.errors.measured, proof.errors.predicted))
        if measured < SMALL:
            seen += 1
            assert 1.0 / FACTOR < measured / predicted < FACTOR
            assert proof.errors.ratio(mode) == pytest.approx(measured / predicted)
        else:
            assert proof.errors.ratio(mode) is None
    assert seen >= 2


def test_a_wrong_model_is_not_predicted(proofs):
    """What a step cannot explain: a forearm 0.1 % heavier in MuJoCo alone, held by the gains."""
    plan = proofs["two-link"].replay.plan
    text = edited(plan.twin.mjcf, {".//body[@name='forearm']/inertial": {"mass": "0.5005"}})
    assert planner.prove(plan, mjcf=text, rollouts=0).errors.ratio("feedback") > FACTOR


def test_the_transition_is_the_product_of_the_stages(proofs):
    proof = proofs["acrobot"]
    plan = proof.replay.plan
    A, B = plan.problem.dynamics.linearize(plan.xs, plan.us)
    for mode, stages in (("open-loop", A), ("feedback", A + B @ plan.K)):
        bounds = path_error_bounds(plan)  # errors are shares of these
        phi = functools.reduce(np.matmul, stages[::-1]) * bounds / bounds[:, None]
        norm = np.linalg.norm(phi, 2)
        assert proof.errors.transition[mode][-1] == pytest.approx(np.log10(norm))
        assert proof.errors.rate(mode) == pytest.approx(np.log(norm) / plan.t[-1])


def test_gains_stop_the_growth(proofs):
    for proof in proofs.values():
        assert proof.errors.rate("feedback") < 0.0 < proof.errors.rate("open-loop")


def test_runge_kutta_plans_show_its_order(proofs):
    for proof in proofs.values():
        order = proof.convergence
        assert order.nominal == 4.0
        assert order.judged == ""
        assert order.observed > 4.0 - ORDER_BOUND
        assert np.allclose(order.steps[:-1] / order.steps[1:], 2.0)
        assert order.changes[-1] < order.changes[0]


def test_the_extrapolated_cost_is_that_of_a_far_finer_replay(proofs):
    proof = proofs["acrobot"]
    plan, order = proof.replay.plan, proof.convergence
    fine = planner.replay(plan, substeps=64).cost
    assert abs(order.extrapolated_cost - fine) <= 10.0 * order.cost_uncertainty + 1e-9
    assert abs(order.costs[0] - plan.cost) < 1e-6 * plan.cost  # MuJoCo's RK4 at the plan's step is the plan's


def test_the_replay_itself_is_one_of_the_halved_steps():
    """A hopper's order is about its refined step: that replay is not run again, and its bits are those of another."""
    plan = planner.solve(cases.hopper(horizon=50, height=5.0))
    run = planner.replay(plan)
    own, again = (
        _level(one, plan.problem, "rk4", run.substeps, exact=False) for one in (run, replace(run, integrator="EULER"))
    )
    np.testing.assert_array_equal(own[0], again[0])
    assert own[1] == again[1]


def test_semi_implicit_euler_is_of_first_order():
    """A slow motion of the arm, whose errors are small: the order is 1, and the cost moves by more than 1 %."""
    proof = proof_of(cases.two_link(duration=1.0, horizon=400, integrator="semi-implicit-euler", guess="paper"))
    assert proof.convergence.nominal == 1.0
    assert proof.convergence.observed == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize(
    ("option", "loss", "why"),
    [("", 'frictionloss="0.1"', "friction loss"), ('<option density="1.2" viscosity="1e-5"/>', "", "drag")],
    ids=["friction", "drag"],
)
def test_an_order_that_is_not_judged_is_that_of_the_replays(option, loss, why):
    """Friction loss and drag show no order, so that MuJoCo's RK4 is halved in place of the plan's Euler."""
    text = (
        f'<mujoco>{option}<worldbody><body><joint name="a" axis="0 1 0" {loss} damping="0.1"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/></body></worldbody>'
        '<actuator><motor joint="a"/></actuator></mujoco>'
    )
    dynamics = planner.RigidBodyDynamics(planner.Mechanism.from_mjcf(text), 0.005, "semi-implicit-euler")
    cost = planner.TrackingCost.joints(dynamics, [0.2, 0.0], 100, effort=0.01, final_position=100.0, final_velocity=1.0)
    convergence = proof_of(Problem(dynamics, cost, [0.0, 0.0])).convergence
    assert convergence.judged.startswith(why)
    assert convergence.nominal == 4.0


def test_a_first_order_method_in_place_of_the_fourth_is_seen(monkeypatch):
    """MuJoCo's Euler where the plan says RK4: what `order_shortfall` is for."""
    from planner.proof import step_convergence as module

    own = module.advancing
    monkeypatch.setattr(module, "advancing", lambda name, *rest: own("semi-implicit-euler", *rest))
    proof = proof_of(cases.two_link(duration=1.0, horizon=400))
    assert "order_shortfall" in [figure.name for figure in proof.order.failures]


def test_a_cost_that_a_finer_step_changes_fails_open_loop(proofs):
    proof = proofs["acrobot, hanging"]
    assert values(proof.order)["cost_change"] > 1.0
    assert proof.mode == "feedback"  # the gains hold it


@pytest.mark.parametrize(
    ("changes", "order"),
    [
        ([16.0, 4.0, 1.0], 2.0), ([1.0, 1e-10], None), ([1e-3, 1e-4, 1e-10], np.log2(10.0)), ([0.0, 0.0], None),
        ([np.inf, np.nan], 0.0), ([1.0], None), ([1.9e-7, 1.8e-8, 1.4e-9, 9e-11], np.log2(140.0 / 9.0)),
        ([1.6e-8, 2e-9, 4e-10], 3.0), ([8e-9, 4e-9, 9e-12], 1.0),
    ],
)  # fmt: skip
def test_the_observed_order_of_changes(changes, order):
    assert _observed(np.array(changes)) == (None if order is None else pytest.approx(order))


def test_contact_is_shown_and_not_judged():
    proof = proof_of(cases.hopper(height=10.0, duration=0.5, horizon=100))
    assert proof.convergence.judged
    assert proof.passed
    assert values(proof.order)["cost_change"] < 1.0


def test_costs_near_zero_are_compared_with_what_an_error_costs():
    """A plan that has nothing to do costs nothing; then 1 % of its cost is no measure."""
    problem = cases.two_link()
    start = np.array([np.pi / 2 + 1e-7, 0.0, 0.0, 0.0])
    still = Problem(problem.dynamics, problem.cost, start, horizon=problem.N, twin=problem.twin)
    proof = proof_of(still)
    assert proof.passed, proof.reason
    plan = proof.replay.plan
    assert plan.cost < 1e-9
    off = planner.prove(replace(plan, cost=plan.cost + 1e-3), rollouts=0)
    assert [figure.name for figure in off.plan.failures] == ["cost_error"]
