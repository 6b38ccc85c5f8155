"""Gains as a controller applies them: at instants, held, late, within bounds, and from what encoders measure."""

import itertools
from dataclasses import replace

import carts
import numpy as np
import pytest
import rolled_out_plans
from swings import mechanism, swing

import planner
from planner.base.errors import PlannerError
from planner.model.mjcf.model_index import compile_model
from planner.proof.goal_regulator import slowest_rate
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay
from planner.proof.replays.sampled_gains import HINGE, SLIDE, Encoders, Sampling, sampling_in, sampling_of

DT = 0.01


def rail(K, N=40, dt=DT, x0=(0.3, -0.2), us=0.0, **limits):
    """1 kg on a rail that starts off its plan, which says to stay at zero."""
    problem = carts.cart(N, N * dt)
    limited = planner.Limits(**limits) if limits else None
    problem = replace(problem, x0=np.array(x0), limits=limited, twin=planner.Twin.of(problem.dynamics.mechanism))
    plan = rolled_out_plans.rolled_out(problem)
    rest = {"xs": np.zeros((N + 1, 2)), "us": np.full((N, 1), us)}
    return replace(plan, **rest, K=np.tile(np.array([K], dtype=float), (N, 1, 1)))


def pushed(h):
    """The double integrator of 1 kg over h s of a held force."""
    return np.array([[1.0, h], [0.0, 1.0]]), np.array([0.5 * h * h, h])


def test_at_every_step_and_without_delay_gains_are_ideal():
    plan = planner.solve(swing("rk4", 40))
    ideal = replay(plan, feedback=True)
    sampled = replay(plan, feedback=True, sampling=Sampling(ideal.timestep, delay=0))
    for name in ("qpos", "qvel", "ctrl", "xs"):
        np.testing.assert_array_equal(getattr(sampled, name), getattr(ideal, name))
    assert ideal.sampling is None
    assert replay(plan, sampling=sampling_of(plan)).sampling is None  # open loop


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("stages", [1 / 5, 2 / 5, 1, 3], ids="{:.2g} stages".format)
def test_a_double_integrator_follows_its_discrete_closed_loop(stages, delay):
    """x(k+1) = A x(k) + B K x(k - delay): a held force moves a mass as Runge-Kutta says, without error."""
    K, h = (-4.0, -2.0), stages * DT
    run = replay(rail(K), feedback=True, sampling=Sampling(h, delay))
    each = round(h / run.timestep)
    A, B = pushed(h)
    expected = [np.array([0.3, -0.2])]
    for k in range((len(run.ctrl) - 1) // each):
        force = np.dot(K, expected[k - delay]) if k >= delay else 0.0
        np.testing.assert_allclose(run.ctrl[k * each : (k + 1) * each], force, rtol=1e-9, atol=1e-12)
        expected.append(A @ expected[k] + B * force)
    np.testing.assert_allclose(run.xs[: len(expected) * each : each], expected, atol=1e-12)


def test_the_planned_control_is_not_late():
    plan = replace(rail((-4.0, -2.0)), us=np.linspace(1.0, 2.0, 40)[:, None])
    plan = replace(plan, K=0.0 * plan.K)
    run = replay(plan, feedback=True, sampling=Sampling(3 * DT, delay=5))
    np.testing.assert_array_equal(run.ctrl, replay(plan).ctrl)


def test_the_correction_is_of_the_stage_of_its_instant():
    """The gain of the first stage alone: its corrections act in the next period too, when that stage has ended."""
    plan = rail((-4.0, 0.0))
    plan = replace(plan, K=plan.K * (np.arange(40) == 0)[:, None, None])
    run = replay(plan, feedback=True, sampling=Sampling(DT))
    of_stage = run.ctrl.reshape(40, -1)
    np.testing.assert_allclose(of_stage[1], -4.0 * 0.3)
    assert not of_stage[[0, *range(2, 40)]].any()


def test_bounds_act_on_the_sum():
    plan = rail((-4.0, -2.0), us=-0.5, control=1.0)
    run = replay(plan, feedback=True, sampling=sampling_of(plan))
    assert run.ctrl.min() == -1.0
    assert run.ctrl[0] == -0.5


def upright(K):
    """A pendulum that is to stand upright for four seconds, and starts a thousandth of a radian off."""
    machine = mechanism()
    problem = replace(swing("rk4", 400, machine, planner.RigidBodyDynamics(machine, DT)), x0=np.array([np.pi, 0.0]))
    plan = replace(rolled_out_plans.rolled_out(problem), xs=np.tile([np.pi, 0.0], (401, 1)))
    problem = replace(problem, x0=np.array([np.pi + 1e-3, 0.0]))
    return replace(plan, problem=problem, us=np.zeros((400, 1)), K=np.tile(np.array([K]), (400, 1, 1)))


def test_stiff_gains_hold_at_every_step_but_not_at_500_hz():
    """A loop of 300 rad/s: 0.15 rad per step of 0.5 ms, but late by two to four ms it has no phase left."""
    plan = upright((-(300.0**2), -2.0 * 300.0))
    assert np.abs(replay(plan, feedback=True).error[-1]).max() < 1e-9
    lost = replay(plan, feedback=True, sampling=sampling_of(plan))
    assert not np.abs(lost.error[-1]).max() < 1.0
    slack = upright((-(30.0**2), -2.0 * 30.0))
    assert np.abs(replay(slack, feedback=True, sampling=sampling_of(slack)).error[-1]).max() < 1e-9


def test_replays_are_deterministic():
    plan = planner.solve(swing("rk4", 40))
    sampling = replace(sampling_of(plan), encoders=True)
    one, other = (replay(plan, feedback=True, sampling=sampling) for _ in range(2))
    np.testing.assert_array_equal(one.xs, other.xs)
    assert one.sampling == sampling


# When


@pytest.mark.parametrize(
    ("dt", "period"),
    [(0.01, 0.002), (0.02, 0.002), (0.0021, 0.0021), (0.002, 0.002), (0.001, 0.002), (0.0005, 0.002), (1e-5, 0.002),
     (0.0015, 0.0015), (0.005, 0.0025), (0.003, 0.003), (0.0084, 0.0021), (0.0008, 0.0024), (9.0, 0.002)],
)  # fmt: skip
def test_the_rate_of_a_proof_is_the_nearest_to_500_hz_that_fits(dt, period):
    sampling = sampling_in(dt)
    np.testing.assert_allclose(sampling.period, period, rtol=1e-12)
    assert sampling.delay == 1
    assert not sampling.encoders
    stages = sampling.in_stages(dt)
    assert 1 in (stages.numerator, stages.denominator)


def test_instants_and_stages_end_with_steps_of_the_simulator():
    plan = rail((-4.0, -2.0))
    assert replay(plan, feedback=True, sampling=Sampling(DT / 3)).substeps == 21
    assert replay(plan, feedback=True, sampling=Sampling(0.4 * DT)).substeps == 20
    assert replay(plan, feedback=True, sampling=Sampling(7 * DT)).substeps == 20
    assert replay(plan, feedback=True, sampling=Sampling(DT / 3), substeps=6).substeps == 6
    with pytest.raises(PlannerError, match="substeps is 5, expected a multiple of 3"):
        replay(plan, feedback=True, sampling=Sampling(DT / 3), substeps=5)
    for period in (DT / np.pi, 1e-320, 1e308):
        with pytest.raises(PlannerError, match="expected a whole fraction of a stage"):
            replay(plan, feedback=True, sampling=Sampling(period))


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [((0.0,), "period is 0"), ((np.nan,), "period is nan"), ((1.0, -1), "delay is -1"), ((1.0, 0.5), "delay is 0.5")],
    ids=str,
)  # fmt: skip
def test_wrong_samplings_are_refused(arguments, fragment):
    with pytest.raises(PlannerError, match=fragment):
        Sampling(*arguments)


# Encoders

MOVING = """
<mujoco><worldbody>
  <body><freejoint/><geom size=".1"/>
    <body pos="1 0 0"><joint type="slide" axis="1 0 0"/><joint axis="0 1 0"/><geom size=".1"/>
      <body pos="1 0 0"><joint type="ball"/><geom size=".1"/></body></body></body>
</worldbody><actuator><general joint="hinge" dyntype="filter" dynprm="0.1"/></actuator></mujoco>
"""


def test_encoders_count_and_everything_else_is_exact():
    model = compile_model(MOVING.replace('<joint axis="0 1 0"/>', '<joint name="hinge" axis="0 1 0"/>'))
    rng, period = np.random.default_rng(0), 0.002
    ws = rng.normal(size=(3, model.nq + model.nv + model.na))
    encoders = Encoders(model, period)
    read = [encoders(w) for w in ws]
    q, v = [7, 8], [model.nq + 6, model.nq + 7]
    for w, one in zip(ws, read, strict=True):
        np.testing.assert_array_equal(np.delete(one, [*q, *v]), np.delete(w, [*q, *v]))
        assert (np.abs(one[q] - w[q]) <= 0.5000001 * np.array([SLIDE, HINGE])).all()
        np.testing.assert_allclose(np.remainder(one[q] / [SLIDE, HINGE] + 0.5, 1.0), 0.5, atol=1e-6)
    np.testing.assert_array_equal(read[0][v], ws[0][v])  # nothing was read before
    for before, one in itertools.pairwise(read):
        np.testing.assert_allclose(one[v], (one[q] - before[q]) / period, rtol=1e-9)


def test_a_machine_at_rest_on_a_count_is_held_by_its_encoders_alone():
    plan = rail((-4.0, -2.0), x0=(0.25 * SLIDE, 0.0))
    run = replay(plan, feedback=True, sampling=replace(sampling_of(plan), encoders=True))
    assert not run.ctrl.any()  # a quarter of a count is read as zero


# The slowest rate


def test_the_slowest_rate_is_the_last_whose_closed_loop_is_stable():
    K = (-900.0, -60.0)
    plan = rail(K, N=200)

    def stable(h):
        A, B = pushed(h)
        late = np.block([[A, B[:, None]], [np.array([K]), np.zeros((1, 1))]])  # state and the correction on its way
        return np.abs(np.linalg.eigvals(late)).max() < 1.0

    found = slowest_rate(plan, CompiledTwin(plan.twin), lambda run: np.abs(run.error[-1]).max() < 0.2)
    periods = [one.sampling.period for one in found.tried]
    np.testing.assert_allclose(periods, 0.002 * 2.0 ** np.arange(len(periods)))
    assert [one.passed for one in found.tried] == [stable(h) for h in periods]
    assert len(periods) > 2
    assert not found.tried[-1].passed
    assert found.slowest == found.tried[-2].sampling
    np.testing.assert_allclose(found.once_a_stage.sampling.period, DT)
    assert found.once_a_stage.passed == stable(DT)


def test_no_rate_passes_where_the_first_does_not():
    plan = rail((-4.0, -2.0))
    found = slowest_rate(plan, CompiledTwin(plan.twin), lambda run: False)
    assert found.slowest is None
    assert len(found.tried) == 1


def test_rates_end_where_a_period_is_half_of_the_motion():
    plan = rail((0.0, 0.0))
    found = slowest_rate(plan, CompiledTwin(plan.twin), lambda run: True)
    assert [round(1e3 * one.sampling.period) for one in found.tried] == [2, 4, 8, 16, 32, 64, 128]
