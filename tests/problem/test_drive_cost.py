"""Forces of prescribed joints as a cost; jerk as a control: machines, derivatives, what MuJoCo makes of them."""

from dataclasses import replace

import numpy as np
import pytest
from driven import CART, PELVIS, hanging_leg, moved_cart, standing_leg
from gradients import assert_gradients
from trees import mujoco

import planner
from planner import Mechanism, PlannerError, RigidBodyDynamics, TrackingCost
from planner.dynamics.algorithms import rnea
from planner.dynamics.contacts import generalized_forces
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, twin_of
from planner.model.twin import Twin
from planner.problem.costs.jerk import driven_by_jerk
from planner.problem.costs.motors import DriveCost
from planner.problem.costs.tracking import tracking_of
from planner.problem.objective import with_objective
from planner.proof.robustness.perturbation import Nominal


def standing(K, spread=0.02):
    """A leg that presses on a belt, led by its pelvis, in K states and under K accelerations."""
    m, x = standing_leg()
    rng = np.random.default_rng(0)
    xs = x + spread * rng.normal(size=(K, m.space.nx))
    return RigidBodyDynamics(m, 0.005, prescribed=PELVIS), xs, rng.normal(size=(K, 6))


# forces


def test_forces_are_those_of_inverse_dynamics():
    """With contact: what rnea asks for, less what the belt does."""
    dynamics, xs, us = standing(5)
    m = dynamics.mechanism
    q, qd = xs[:, : m.nq], xs[:, m.nq :]
    tau = rnea(m, q, qd, dynamics.rates(xs, us)[:, m.nv :]) - generalized_forces(m, q, qd)
    forces = DriveCost(dynamics, 5, 1.0).forces(xs, us)
    np.testing.assert_allclose(forces, tau[:, 1:7], rtol=0.0, atol=1e-8 * np.abs(tau).max())
    assert np.abs(generalized_forces(m, q, qd)[:, 3]).max() > 10.0  # N, of the belt


def test_forces_of_joints_that_have_springs_and_servos_of_their_own():
    """What acts on a driven joint alone does nothing; other motors act on."""
    dynamics = moved_cart().dynamics
    m, rng = dynamics.mechanism, np.random.default_rng(1)  # type: ignore[attr-defined]
    xs, us = rng.normal(size=(4, 6)), rng.normal(size=(4, 3))
    free = replace(m, stiffness=np.where(np.arange(3) == 0, 0.0, m.stiffness), damping=m.damping * [0.0, 1.0, 1.0],
                   armature=m.armature * [0.0, 1.0, 1.0])  # fmt: skip
    tau = rnea(free, xs[:, :3], xs[:, 3:], dynamics.rates(xs, us)[:, 3:])  # type: ignore[attr-defined]
    np.testing.assert_allclose(DriveCost(dynamics, 4, 1.0).forces(xs, us)[:, 0], tau[:, 0], rtol=1e-10)


def test_gradients_are_differences_of_the_value():
    (xs, us), problem = _walk(5), moved_cart()
    cost = DriveCost(problem.dynamics, 4, 1e-2, 3.0)
    model = assert_gradients(cost, cost.space, xs, us[:4])
    assert model.S is not None
    for n in range(4):
        H = np.block([[model.R[n], model.S[n]], [model.S[n].T, model.Q[n]]])
        assert np.linalg.eigvalsh(H).min() > -1e-12 * np.abs(H).max()


def test_gradients_with_contact():
    """Steps of 1e-7: a contact's force bends within millimetres, so larger ones see its curvature."""
    dynamics, xs, us = standing(4, spread=1e-3)
    cost, us, h = DriveCost(dynamics, 3, np.linspace(1e-4, 2e-4, 6), np.arange(6)), us[:3], 1e-7
    model = cost.quadratize(xs, us)
    assert model.S is not None
    rng = np.random.default_rng(3)
    for _ in range(20):
        dx, du = rng.normal(size=xs.shape), rng.normal(size=us.shape)
        slope = (cost.value(xs + h * dx, us + h * du) - cost.value(xs - h * dx, us - h * du)) / (2.0 * h)
        assert np.sum(model.q * dx) + np.sum(model.r * du) == pytest.approx(slope, rel=1e-5)
        # the Hessian: of forces that are linear in the change
        ahead, behind = (cost.forces(xs[:3] + s * dx[:3], us + s * du) for s in (h, -h))
        change = (ahead - behind) / (2.0 * h)
        curvature = np.einsum("ni,nij,nj->", dx, model.Q, dx) + np.einsum("ni,nij,nj->", du, model.R, du)
        curvature += 2.0 * np.einsum("ni,nij,nj->", du, model.S, dx[:3])
        assert curvature == pytest.approx(0.005 * np.sum(cost.weight * change**2), rel=1e-5)


def _walk(K):
    rng = np.random.default_rng(2)
    return rng.normal(size=(K, 6)), rng.normal(size=(K, 3))


def test_a_hanging_mass_is_carried():
    """In J stands what is more than the reference, dt times half the weighted square."""
    dynamics, xs, us = standing(2, spread=0.0)
    xs[:, 3] += 1.0  # in the air, all joints held by nothing: at rest the pelvis carries less than the leg's weight
    cost = DriveCost(dynamics, 1, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 100.0, 0.0, 0.0, 0.0])
    lifted = cost.forces(xs[:1], us[:1])[0, 2]
    assert cost.value(xs, us[:1]) == pytest.approx(0.005 * 0.5 * 2.0 * (lifted - 100.0) ** 2)


def test_less_force_is_asked_for_and_effort_can_be_weighed_beside_it():
    problem = moved_cart()
    spared = replace(problem, cost=problem.cost + DriveCost(problem.dynamics, problem.N, 3.0))
    usual, gentle = planner.solve(problem), planner.solve(spared)
    measured = DriveCost(problem.dynamics, problem.N, 1.0)
    assert usual.success
    assert gentle.success
    assert measured.value(gentle.xs, gentle.us) < 0.9 * measured.value(usual.xs, usual.us)
    weighed, tracking = with_objective(spared, {"effort": 2.0}).cost, tracking_of(problem.cost)
    assert tracking is not None
    effort = 0.5 * np.einsum("ni,nij,nj->", usual.us, tracking.R, usual.us)  # once more
    assert weighed.value(usual.xs, usual.us) == pytest.approx(spared.cost.value(usual.xs, usual.us) + effort)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"dynamics": RigidBodyDynamics(Mechanism.from_mjcf(CART), 0.01)}, "expected RigidBodyDynamics with prescr"),
        ({"horizon": 0}, "horizon"),
        ({"weight": -1.0}, "weight of a drive's force is -1, expected at least 0"),
        ({"weight": [1.0, 2.0]}, "weight has shape"),
        ({"reference": np.nan}, "reference"),
    ],
)
def test_bad_input_is_refused(given, said):
    arguments = {"dynamics": moved_cart().dynamics, "horizon": 3, "weight": 1.0} | given
    with pytest.raises(PlannerError, match=said):
        DriveCost(**arguments)


# jerk


def test_accelerations_become_states():
    """The machine moves as the prescribed one does, but for the force on the joint over HEAVY."""
    led = moved_cart().dynamics
    jerked = RigidBodyDynamics(driven_by_jerk(led.mechanism, ["cart"]), 0.01)  # type: ignore[attr-defined]
    assert (jerked.nu, jerked.mechanism.na) == (3, 1)
    xs, us = _walk(6)
    jerks = np.linspace(-1.0, 1.0, 6)[:, None]
    found = jerked.rates(np.hstack([xs, us[:, 2:]]), np.hstack([us[:, :2], jerks]))
    force = DriveCost(led, 6, 1.0).forces(xs, us)
    np.testing.assert_allclose(found[:, :6], led.rates(xs, us), atol=20.0 * np.abs(force).max() / PRESCRIBED_ARMATURE)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(found[:, 6:], jerks)


def test_contacts_and_stops_keep_their_law():
    m, x = standing_leg()
    jerked = driven_by_jerk(m, PELVIS)
    for one, other in zip(m.contacts, jerked.contacts, strict=True):
        for name in ("stiffness", "damping", "slip_damping", "friction", "ramp"):
            assert getattr(other.law, name) == pytest.approx(getattr(one.law, name), rel=1e-9)
    assert [stop.law.stiffness for stop in jerked.stops] == pytest.approx([stop.law.stiffness for stop in m.stops])
    led = RigidBodyDynamics(m, 0.005, prescribed=PELVIS)
    a = np.arange(6.0)[None]
    theirs = RigidBodyDynamics(jerked, 0.005).rates(np.hstack([x[None], a]), np.zeros((1, 6)))[:, : led.ndx]
    np.testing.assert_allclose(theirs, led.rates(x[None], a), atol=1e-3)  # of 30 rad/s^2


def test_jerk_is_solved_proved_and_kept(tmp_path):
    """A plan like any other: compiled, with gains on the added state, replayed with MuJoCo's own activations."""
    problem = moved_cart()
    m = driven_by_jerk(problem.dynamics.mechanism, ["cart"])  # type: ignore[attr-defined]
    dynamics, goal = RigidBodyDynamics(m, 0.01), [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    cost = TrackingCost.joints(dynamics, goal, 120, effort=[1e-2, 1e-2, 1e-4], final_position=200.0,
                               final_velocity=50.0, final_activation=1.0)  # fmt: skip
    plan = planner.solve(planner.Problem(dynamics, cost, np.zeros(7)))
    assert plan.success
    assert np.abs(plan.K[:, 2, 6]).max() > 0.0
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.table()
    usual = planner.solve(problem)
    assert np.abs(np.diff(plan.xs[:, 6])).max() < 0.1 * abs(usual.us[0, 2])  # which pushes at once
    plan.save(tmp_path / "plan.npz")
    read = planner.load_plan(tmp_path / "plan.npz")
    assert read.problem is not None
    np.testing.assert_array_equal(read.problem.dynamics.step(plan.xs[:1], plan.us[:1]), plan.xs[1:2])


def test_files_and_keyframes_go_along():
    """A keyframe with activations gets zeros for the accelerations."""
    filtered = CART.replace(
        '<motor name="motor" joint="knee"/>',
        '<general name="motor" joint="knee" dyntype="filter" dynprm=".1" gainprm="2" gear="1" ctrlrange="-50 50"/>',
    ).replace('ctrl="0.1 0.2"/>', 'ctrl="0.1 0.2" act=".3"/>')
    m = driven_by_jerk(Mechanism.from_mjcf(filtered), ["cart"])
    assert m.na == 2
    np.testing.assert_allclose(m.keyframe("hanging"), [0.0] * 6 + [0.3, 0.0])


def test_a_wrong_mass_of_what_follows_is_found():
    m = driven_by_jerk(Mechanism.from_mjcf(CART), ["cart"])
    assert planner.parity(m).passed
    assert not planner.parity(m, m.mjcf.replace('mass="0.6"', 'mass="0.6006"')).passed


def test_what_is_driven_by_jerk_has_no_bearings_to_rub():
    """As a prescribed joint: drag and dry friction in proportion to its inertia of 1e8 kg would move it."""
    m = driven_by_jerk(Mechanism.from_mjcf(hanging_leg()), PELVIS)
    model = compile_model(Twin.of(m).mjcf, {})
    assert isinstance(model, mujoco.MjModel)
    nominal = Nominal(model, np.ones(m.nv), np.ones(m.nu), None)  # type: ignore[arg-type]
    np.testing.assert_array_equal(nominal._in_joints, [1.0] + 6 * [0.0] + 3 * [1.0])


@pytest.mark.parametrize(
    ("mechanism", "joints", "said"),
    [
        (3, ["cart"], "mechanism is 3, expected a Mechanism that was read from an MJCF"),
        (CART, [], "expected names of at least one joint"),
        (CART, "cart", "expected names of at least one joint"),
        (CART, ["wheel"], "joint is 'wheel', expected one of: cart, hip, knee"),
    ],
)
def test_no_such_joint_to_drive(mechanism, joints, said):
    given = Mechanism.from_mjcf(mechanism) if mechanism is CART else mechanism
    with pytest.raises(PlannerError, match=said):
        driven_by_jerk(given, joints)


def test_the_twin_stays_as_it_was():
    """The text with motors that a prescribed replay uses is not the one with integrators."""
    m = Mechanism.from_mjcf(CART)
    before = twin_of(m, ["cart"]).mjcf
    driven_by_jerk(m, ["cart"])
    assert twin_of(m, ["cart"]).mjcf == before
    assert "integrator" not in before.split("<actuator>")[-1]
