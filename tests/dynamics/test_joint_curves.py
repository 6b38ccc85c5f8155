"""Torques that are exponentials of coordinates: kernels, NumPy and MuJoCo agree, and what cannot have them says so."""

import copy
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from driven import moved_cart
from gradients import assert_step_derivatives
from machines import MACHINE
from swings import mechanism, swing
from trees import mujoco

import planner
from planner import Mechanism, RigidBodyDynamics, Twin
from planner.base.errors import ModelError, PlannerError
from planner.contact import ExponentialTorque
from planner.dynamics.algorithms import forward_dynamics
from planner.dynamics.contacts import generalized_forces
from planner.kernels.tree import passive_forces as kernels
from planner.model import passive_forces
from planner.model.mjcf.model_index import compile_model
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import Rollouts

# Two arms on a cart that slides: curves couple all three, as muscles do that span several joints.
ARMS = """
<mujoco>
  <worldbody><body><joint name="cart" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <body><joint name="hip" axis="0 -1 0" damping="0.1"/>
      <inertial pos="0 0 -.2" mass="2" diaginertia=".02 .02 .01"/>
      <body pos="0 0 -.4"><joint name="knee" axis="0 -1 0"/>
        <inertial pos="0 0 -.2" mass="1" diaginertia=".01 .01 .01"/></body></body></body></worldbody>
  <actuator><motor joint="hip"/></actuator>
</mujoco>
"""
CURVES = (
    ExponentialTorque(1, 2.0, 0.3, {1: -2.0, 2: 0.7}),
    ExponentialTorque(2, -1.5, -0.4, {2: 3.0}),
    ExponentialTorque(0, 0.8, 0.1, {0: -1.0, 1: 0.5}),
    ExponentialTorque(2, 0.25),
)
# The ends of a pendulum's range: 1 N m at 0.8 and -1.2 rad, twice as much every 3 degrees.
ENDS = (ExponentialTorque(0, -1.0, -9.6, {0: 12.0}), ExponentialTorque(0, 1.0, -14.4, {0: -12.0}))


@pytest.fixture(scope="module")
def arms():
    return Mechanism.from_mjcf(ARMS).with_curves(CURVES)


@pytest.fixture(scope="module")
def plan():
    return planner.solve(swing("rk4", N=200, machine=mechanism().with_curves(ENDS)))


def states(m, K=7):
    rng = np.random.default_rng(3)
    return 0.4 * rng.normal(size=(K, m.space.nx)), rng.normal(size=(K, 1))


def test_the_kernels_bound_of_an_exponent_is_the_models():
    assert kernels.LARGEST == passive_forces.LARGEST


def test_a_torque_is_its_formula(arms):
    """Written out by hand."""
    x, y, z = q = np.array([0.3, -0.2, 0.5])
    expected = [
        0.8 * math.exp(0.1 - x + 0.5 * y),
        2.0 * math.exp(0.3 - 2.0 * y + 0.7 * z),
        -1.5 * math.exp(-0.4 + 3.0 * z) + 0.25,
    ]
    np.testing.assert_allclose(generalized_forces(arms, q, np.zeros(3)), expected, rtol=1e-14)


def test_kernels_add_the_torques_to_what_is_applied(arms):
    xs, us = states(arms)
    q, qd = xs[:, :3], xs[:, 3:]
    tau = generalized_forces(arms, q, qd)
    tau[:, 1] += us[:, 0]
    ours = RigidBodyDynamics(arms, 0.01).rates(xs, us)[:, 3:]
    np.testing.assert_allclose(ours, forward_dynamics(arms, q, qd, tau), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4"])
def test_derivatives_of_a_stage_are_those_of_differences(arms, integrator):
    dynamics = RigidBodyDynamics(arms, 0.02, integrator)
    assert_step_derivatives(dynamics, *states(arms))


def test_a_pendulum_between_exponential_ends_keeps_its_energy():
    """A torque of its own coordinate alone is minus the slope of amplitude / slope exp(...)."""
    m = mechanism().with_curves(ENDS)
    dynamics = RigidBodyDynamics(m, 1e-3)
    x, path = np.array([[0.3, 3.5]]), []
    for _ in range(3000):
        x = dynamics.step(x, np.zeros((1, 1)))
        path.append(x[0])
    q, v = np.array(path).T
    stored = sum(-c.amplitude / c.slopes[0][1] * np.exp(c.constant + c.slopes[0][1] * q) for c in ENDS)
    energy = 0.5 * (1.0 + 1e-6) * v**2 - 9.81 * np.cos(q) + stored
    assert np.ptp(energy) < 1e-6  # of 4 J; RK4's own error
    assert q.max() > 0.8  # both ends were felt
    assert q.min() < -0.9
    assert stored.max() > 0.1


def test_a_plan_is_proved(plan):
    """MuJoCo asks for the torques at every stage of its integrator: the same step agrees to rounding."""
    proof = planner.prove(plan, rollouts=0)
    assert proof.verdict == "PASS", proof.reason
    assert max(figure.value for figure in proof.same_step.measured) < 1e-12
    assert np.abs(proof.replays["open-loop"].error).max() < 1e-6
    assert mujoco.get_mjcb_passive() is None


@pytest.mark.parametrize(
    "curves", [(), ENDS[:1], (ENDS[0], replace(ENDS[1], amplitude=1.01))], ids=["none", "one", "one percent"]
)
def test_other_curves_in_the_simulator_are_found(plan, curves):
    proof = planner.prove(plan, twin=replace(plan.twin, curves=curves), rollouts=0)
    assert proof.verdict == "FAIL"
    assert "bias force error" in proof.reason
    assert "gravity or spring at joint 'pivot'" in proof.reason


def test_a_plan_is_stored_with_its_curves(plan, tmp_path):
    loaded = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert loaded.twin.curves == ENDS
    assert loaded.problem.dynamics.mechanism.curves == ENDS
    np.testing.assert_array_equal(planner.replay(loaded).xs, planner.replay(plan).xs)
    maps = json.loads(json.dumps(plan.twin.to_dict()))
    assert Twin.from_dict(plan.twin.mjcf, maps).curves == ENDS
    for broken in ("curves", [[0, 1.0]], [[0, 1.0, 0.0, 5.0]], [["a", 1.0, 0.0, []]]):
        with pytest.raises(PlannerError):
            Twin.from_dict(plan.twin.mjcf, maps | {"curves": broken})


def test_rollouts_feel_the_curves_as_stiff_as_they_were_drawn(plan):
    """One with everything nominal is the replay; a stiffer one is not."""
    with Rollouts(plan, CompiledTwin(plan.twin)) as rollouts:
        errors = draw(Perturbation(), 0, 0, rollouts.nominal.sizes)
        zero = {name: np.zeros_like(getattr(errors, name)) for name in ("drag", "friction", "start", "noise")}
        one = {name: np.ones_like(getattr(errors, name)) for name in ("mass", "inertia", "damping", "stiffness")}
        nominal = replace(errors, **zero, **one, contact_friction=1.0, delay=0.0)
        stiff = replace(nominal, stiffness=1.5 * nominal.stiffness)
        ends = rollouts.run(rollouts.batch([nominal, stiff]), "open-loop")[:, -1]
    assert np.abs(ends[0] - planner.replay(plan).xs[-1]).max() < 1e-3  # at an eighth of a stage
    assert np.abs(ends[1] - ends[0]).max() > 1e-3


def test_forces_on_a_prescribed_joint_do_nothing():
    problem = moved_cart()
    m = problem.dynamics.mechanism
    on_cart, on_hip = ExponentialTorque(0, 9.0, 0.0, {0: 1.0}), ExponentialTorque(1, -0.5, 0.0, {1: 2.0, 0: 0.5})
    moved = [
        replace(problem, dynamics=RigidBodyDynamics(m.with_curves(c), 0.01, prescribed=("cart",)), twin=None)
        for c in ((on_hip,), (on_cart, on_hip))
    ]
    one, both = (planner.solve(p) for p in moved)
    np.testing.assert_array_equal(one.xs, both.xs)
    assert both.twin.curves == (on_hip,)
    assert planner.prove(both, rollouts=0).passed


def test_the_callback_acts_on_its_own_models_and_goes():
    twin = Twin.of(mechanism().with_curves(ENDS[:1]))
    mine, other = (copy.copy(compile_model(twin.mjcf)) for _ in range(2))
    data = [mujoco.MjData(model) for model in (mine, other)]

    def run():
        for model, one in zip((mine, other), data, strict=True):
            one.qpos[0] = 0.8
            mujoco.mj_forward(model, one)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), curves_acting(twin, mine, factors=np.array([[2.0]])):
        run()
    assert data[0].qfrc_passive[0] == pytest.approx(-2.0)
    assert data[1].qfrc_passive[0] == 0.0
    assert mujoco.get_mjcb_passive() is None


def test_the_compiled_callback_is_the_one_in_python():
    """For each model with its own factors, in each data; other models feel nothing."""
    coupled = (*ENDS, ExponentialTorque(0, 0.3, -0.2, {0: 1.5, 1: -0.7}), ExponentialTorque(1, -0.4))
    arm = """<mujoco><worldbody><body><joint name="a"/><geom size="0.1" pos="0 0 -1"/>
        <body pos="0 0 -1"><joint name="b"/><geom size="0.1" pos="0 0 -1"/></body></body></worldbody></mujoco>"""
    twin = replace(Twin.of(mechanism()), mjcf=arm, curves=coupled)
    models = [copy.copy(compile_model(twin.mjcf)) for _ in range(4)]
    factors = np.random.default_rng(0).uniform(0.5, 2.0, (3, len(coupled)))
    data = [mujoco.MjData(models[0]) for _ in range(2)]

    def forces():
        found = []
        for i, model in enumerate(models):
            one = data[i % 2]
            one.qpos[:] = 0.3 + 0.1 * i, -0.4
            mujoco.mj_forward(model, one)
            found.append(one.qfrc_passive.copy())
        return np.array(found)

    nothing = forces()
    with curves_acting(twin, *models[:3], factors=factors):
        python = forces()
    with curves_acting(twin, *models[:3], factors=factors, data=data):
        compiled = forces()
    np.testing.assert_allclose(compiled, python, rtol=1e-14)
    np.testing.assert_array_equal(compiled[3], nothing[3])
    assert np.all(compiled[:3] != nothing[:3])
    np.testing.assert_array_equal(forces(), nothing)
    assert mujoco.get_mjcb_passive() is None


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((-1, 1.0), "dof is -1"),
        ((0, math.nan), "amplitude is nan"),
        ((0, 1.0, math.inf), "constant is inf"),
        ((0, 1.0, 0.0, {0: math.nan}), r"slopes\[0\] is nan"),
        ((0, 1.0, 0.0, 3.0), "slopes is 3.0"),
        ((0, 1.0, 0.0, [(0, 1.0), (0, 2.0)]), "each degree of freedom once"),
    ],
)
def test_numbers_that_are_none_are_refused(given, words):
    with pytest.raises(PlannerError, match=words):
        ExponentialTorque(*given)


def test_machines_and_models_without_the_joint_refuse():
    whole = Mechanism.from_mjcf(MACHINE)
    ball = int(np.flatnonzero(whole.kind != 0)[0])
    for curve in (
        ExponentialTorque(ball, 1.0),
        ExponentialTorque(0, 1.0, 0.0, {ball: 1.0}),
        ExponentialTorque(99, 1.0),
    ):
        with pytest.raises(PlannerError, match="expected those of hinges or slides"):
            whole.with_curves([curve])
    with pytest.raises(PlannerError, match=r"curves\[0\] is 3, expected an ExponentialTorque"):
        whole.with_curves([3])
    model = compile_model(MACHINE)
    with (
        pytest.raises(ModelError, match="no hinge or slide"),
        curves_acting(replace(Twin.of(mechanism()), curves=(ExponentialTorque(ball, 1.0),)), model),
    ):
        pass


def test_exact_hessians_refuse(plan):
    with pytest.raises(PlannerError, match="no second derivatives of exponential torques"):
        planner.solve(plan.problem, hessian="exact")
