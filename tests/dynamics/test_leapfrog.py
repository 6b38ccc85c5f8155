"""Leapfrog steps: their formula in NumPy, differences, MuJoCo's accelerations, order, stability and refusals."""

from __future__ import annotations

import pickle
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from closed_chains import four_bar
from machines import FRICTION_ARM
from trees import CHAINS, actuated, damped, driven, machines, random_state

import planner
from planner import Mechanism, Problem, RigidBodyDynamics
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.costs import FrameCost, TrackingCost
from planner.dynamics.protocol import rollout_states
from planner.dynamics.step_stability import FastestMode, leaping, leaps_of, substeps_of
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.model.contact.laws import Contact, ContactLaw, Plane
from planner.model.couplings import Coupling
from planner.model.passive_forces import damped_later, implicit_damping
from planner.model.twin import Twin
from planner.problem.rediscretize import COARSE, UNRESOLVED, finer, is_unresolved, stage_too_long, step_error
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.proof.same_step import stage_function
from planner.proof.step_convergence import ORDER_BOUND, step_convergence
from planner.solvers.engine import acquire_engine

LAW = ContactLaw(2e3, 80.0, friction=0.7, lead=0.02, cone="pyramidal", ramp=4e-3, force_ramp=0.0)
TWO_LINK = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody><body>
  <joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>
  <body pos=".5 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/></body></body>
  </worldbody><actuator><motor joint="a"/></actuator></mujoco>"""
BOX = """<mujoco><worldbody><body><freejoint/><geom type="box" size=".2 .1 .05" mass="3"/><body name="arm" pos=".2 0 0">
  <joint name="hinge" axis="0 1 0" damping="2" armature=".01"/>
  <geom type="capsule" fromto="0 0 0 .1 .1 -.2" size=".02" mass=".5"/></body></body></worldbody>
  <actuator><motor joint="hinge"/></actuator></mujoco>"""
SLIDER = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="slide" type="slide" damping="{damping}"
  stiffness="{stiffness}"/><geom size=".1" mass="1"/></body></worldbody><actuator><motor joint="slide"/></actuator>
  </mujoco>"""


def standing(x):
    """The box on four points of a plane, at heights about those where they touch at a state x (nx,)."""
    m = Mechanism.from_mjcf(BOX, contacts="off")
    corners = [np.array([a, b, -0.05]) for a in (-0.2, 0.2) for b in (-0.1, 0.1)]
    plane = Plane(np.array([0.0, 0.0, 1.0]), x[2] - 0.05)
    return replace(m, contacts=tuple(Contact(5, corner, 0.0, plane, LAW) for corner in corners))


def twin(m, delay, x, u, h):
    """One step of h s by the formulas of kernels.tree.leapfrog; `delay` s of damping, friction and leads."""
    later, space, nv = RigidBodyDynamics(damped_later(m, delay), h), m.space, m.nv
    v, rest = x[m.nq : m.nq + nv], np.zeros(nv)
    begin = later.rates(x[None], u[None])[0, 2 * nv :]
    middle = space.integrate(x, np.concatenate([0.5 * h * v, rest, 0.5 * h * begin]))
    rates = later.rates(middle[None], u[None])[0]
    a, rate = rates[nv : 2 * nv], rates[2 * nv :]
    return space.integrate(x, np.concatenate([h * (v + 0.5 * h * a), h * a, h * rate]))


def slopes(dynamics, x, u, h):
    """A and B (ndx, ndx + nu) of a stage by central differences."""
    space, nu = dynamics.space, dynamics.nu
    ways = h * np.eye(space.ndx + nu)
    us = [u + side * ways[:, space.ndx :] for side in (1.0, -1.0)]
    xs = [space.integrate(np.tile(x, (len(ways), 1)), side * ways[:, : space.ndx]) for side in (1.0, -1.0)]
    ends = [dynamics.step(*both) for both in zip(xs, us, strict=True)]
    return space.difference(*ends).T / (2.0 * h)


def error_of_slopes(dynamics, x, u, h=1e-6):
    A, B = dynamics.linearize(np.stack([x, x]), u[None])
    found = np.hstack([A[0], B[0]])
    return np.abs(slopes(dynamics, x, u, h) - found).max() / max(1.0, np.abs(found).max())


@machines(12, max_dofs=14)
def test_a_step_is_the_formula(text, seed):
    dynamics, _, us, rng = driven(text, seed, K=5, prescribe=False)
    m = replace(dynamics.mechanism, damping=10.0 ** rng.uniform(-1, 4, dynamics.mechanism.nv))
    xs = np.array([random_state(m.space, rng, unnormalized=False) for _ in us])
    once, twice = (RigidBodyDynamics(m, 0.02, "leapfrog", substeps=k) for k in (1, 2))
    for x, u, end, half_end in zip(xs, us, once.step(xs, us), twice.step(xs, us), strict=True):
        for found, h in ((end, 0.02), (half_end, 0.01)):
            wanted = x
            for _ in range(round(0.02 / h)):
                wanted = twin(m, 0.5 * h, wanted, u, h)
            far = max(1.0, np.abs(m.space.difference(wanted, x)).max())
            assert np.abs(m.space.difference(found, wanted)).max() < 1e-10 * far  # the same sums in another order


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("name", CHAINS)
def test_derivatives_are_those_of_differences(name, substeps):
    rng = np.random.default_rng(1)
    m = Mechanism.from_mjcf(actuated(CHAINS[name], np.random.default_rng(0)))
    m = replace(m, damping=10.0 ** rng.uniform(-1, 3, m.nv))
    dynamics = RigidBodyDynamics(m, 0.03, "leapfrog", substeps=substeps)
    x = m.space.integrate(m.home, 0.3 * rng.normal(size=m.space.ndx))
    # central differences: h^2 of the third derivatives and rounding over h, both about 1e-10 of entries of size 1
    assert error_of_slopes(dynamics, x, rng.normal(size=m.nu)) < 1e-7


@pytest.mark.parametrize("substeps", [1, 2])
def test_derivatives_of_what_touches_rubs_or_is_coupled_are_those_of_differences(substeps):
    rng, errors = np.random.default_rng(2), []
    for _ in range(20):
        m = Mechanism.from_mjcf(BOX, contacts="off")
        x = m.space.integrate(m.home, 0.1 * rng.normal(size=m.space.ndx))
        dynamics = RigidBodyDynamics(standing(x), 5e-3, "leapfrog", substeps=substeps)
        errors.append(error_of_slopes(dynamics, x, rng.normal(size=1), 1e-7))
    assert np.median(errors) < 1e-7  # a difference over an edge of the cone is off by the jump of the slope
    arm = replace(Mechanism.from_mjcf(FRICTION_ARM), damping=np.array([5.0, 9.0, 40.0]))
    coupled = replace(arm, couplings=(Coupling("mimic", (2, 1), (1.0, -0.7), 0.0),))
    x, u = 0.3 * rng.normal(size=6), 3.0 * rng.normal(size=3)
    x[[2, 5]] = 0.7 * x[[1, 4]]
    for machine, prescribed in ((arm, ()), (coupled, ()), (arm, ("lift",))):
        dynamics = RigidBodyDynamics(machine, 0.02, "leapfrog", prescribed, substeps)
        assert error_of_slopes(dynamics, x, np.zeros(dynamics.nu) if prescribed else u) < 1e-7


@machines(8, max_dofs=12)
def test_mujocos_accelerations_give_the_same_step(text, seed):
    m, x, us, model = damped(text, seed)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    found = stage_function("leapfrog", 0.02, model, Twin.of(m), m.space, damping=implicit_damping(m))
    assert found is not None
    wanted = RigidBodyDynamics(m, 0.02, "leapfrog").step(x[None], us)[0]
    far = max(1.0, np.abs(m.space.difference(wanted, x)).max())
    assert np.abs(m.space.difference(found[1](x, us[0]), wanted)).max() < 1e-9 * far


@pytest.mark.parametrize(("damping", "stiffness"), [(3.0, 0.0), (30.0, 0.0), (0.0, 100.0), (3.0, 100.0)])
def test_without_velocity_products_it_is_of_second_order(damping, stiffness):
    m = Mechanism.from_mjcf(SLIDER.format(damping=damping, stiffness=stiffness))
    x, u = np.array([[0.1, 1.0]]), np.array([[0.5]])
    true = RigidBodyDynamics(m, 0.1, substeps=16).step(x, u)
    errors = [np.abs(RigidBodyDynamics(m, 0.1, "leapfrog", substeps=k).step(x, u) - true).max() for k in (4, 8, 16)]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.1)


def test_with_velocity_products_it_is_of_first_order():
    m, x, u = Mechanism.from_mjcf(TWO_LINK), np.array([[0.3, 1.0, 2.0, -3.0]]), np.array([[0.5]])
    true = RigidBodyDynamics(m, 0.1, substeps=16).step(x, u)
    errors = [np.abs(RigidBodyDynamics(m, 0.1, "leapfrog", substeps=k).step(x, u) - true).max() for k in (4, 8, 16)]
    order = KNOWN_INTEGRATORS["leapfrog"].order
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.15)


def test_a_coarse_plan_of_it_is_unresolved_and_becomes_one_by_rk4():
    """Of the Euler methods an error as large as the motion is left to a proof; this one the planner chooses itself."""
    m = Mechanism.from_mjcf(TWO_LINK)
    dynamics = RigidBodyDynamics(m, 0.1, "leapfrog", substeps=2)
    cost = TrackingCost.joints(dynamics, [0.0, 0.0, 0.0, 0.0], 10, effort=1e-3, final_position=1e3)
    plan = planner.solve(Problem(dynamics, cost, [0.3, 1.0, 2.0, -3.0]), max_iterations=1)
    assert UNRESOLVED < step_error(plan) < COARSE
    assert is_unresolved(plan)
    fine = finer(plan.problem).dynamics
    assert (fine.integrator, fine.substeps, fine.dt) == ("rk4", 2, 0.1)


def test_the_proof_of_a_smooth_machine_finds_its_order():
    """A chain of two links at speed, on the controls alone, in steps of 10 ms and their halves."""
    m = Mechanism.from_mjcf(TWO_LINK)
    dynamics = RigidBodyDynamics(m, 0.01, "leapfrog")
    cost = TrackingCost.joints(dynamics, [0.0, 0.0, 0.0, 0.0], 30, effort=1.0)
    plan = planner.solve(Problem(dynamics, cost, [0.3, 1.0, 2.0, -3.0]), max_iterations=3)
    found = step_convergence(plan.problem, replay_in(CompiledTwin(plan.twin), plan))
    assert (found.nominal, found.judged) == (1.0, "")
    assert found.observed == pytest.approx(1.0, abs=ORDER_BOUND)
    assert "order_shortfall" not in [one.name for one in found.section.failures]


@pytest.mark.parametrize("damping", [1e-2, 1.0, 1e2, 1e4, 1e6])
def test_velocities_decay_at_any_rate(damping):
    m = Mechanism.from_mjcf(SLIDER.format(damping=damping, stiffness=0.0))
    end = RigidBodyDynamics(m, 0.01, "leapfrog").step(np.array([[0.0, 1.0]]), np.zeros((1, 1)))[0]
    assert end[1] == pytest.approx((1.0 - 0.005 * damping) / (1.0 + 0.005 * damping), rel=1e-12)  # between -1 and 1


def test_rates_stay_the_machines_own():
    m = Mechanism.from_mjcf(SLIDER.format(damping=100.0, stiffness=0.0))
    dynamics, x, u = RigidBodyDynamics(m, 0.01, "leapfrog", substeps=2), np.array([[0.1, 2.0]]), np.array([[0.5]])
    ends = dynamics.step(x, u)
    assert dynamics.rates(x, u)[0].tolist() == [2.0, 0.5 - 200.0]
    back = pickle.loads(pickle.dumps(dynamics))
    np.testing.assert_array_equal(back.step(x, u), ends)
    part = dynamics.step(x, u, np.array([0.005]))  # of a stage: as many steps of half the length
    np.testing.assert_array_equal(part, RigidBodyDynamics(m, 0.005, "leapfrog", substeps=2).step(x, u))


def test_what_it_does_not_take():
    with pytest.raises(PlannerError, match='"leapfrog" keeps no closed chains'):
        RigidBodyDynamics(four_bar(), 0.01, "leapfrog")
    drives = '<general joint="slide" biastype="affine" biasprm="0 0 2"/><motor'
    m = Mechanism.from_mjcf(SLIDER.format(damping=1.0, stiffness=0.0).replace("<motor", drives))
    with pytest.raises(PlannerError, match="drives joint 'slide' by negative damping"):
        RigidBodyDynamics(m, 0.01, "leapfrog")
    with pytest.raises(PlannerError, match="drives joint 'slide' by negative damping"):
        leaping(m, 0.01)


def test_leads_choose_its_steps():
    by_lead = FastestMode(350.0, "foot", 350.0, lead=0.01)
    assert [leaps_of(by_lead, dt) for dt in (0.002, 0.0021, 0.01)] == [1, 2, 5]  # each at most 0.2 of the lead
    with pytest.raises(PlannerError, match="16 are the most"):
        leaps_of(by_lead, 1.0)
    # What swings faster than the lead asks for: 350 per s 2 ms are 0.7, as of RK4.
    assert [leaps_of(by_lead._replace(own_rate=rate), 0.01) for rate in (100.0, 350.0, 400.0)] == [5, 5, 6]
    no_lead = FastestMode(400.0, "hinge", 400.0, own_rate=400.0)
    assert leaps_of(no_lead, 0.01) == substeps_of(no_lead, 0.01)


@pytest.mark.parametrize("damping", [1.0, 1e3, 1e5])
def test_a_file_that_asks_for_it_may_have_any_damping(tmp_path, damping):
    """RK4 would take 1e5 / s 0.01 s / 2 = 500 substeps; of what is left, 2 / dt at most, three are enough."""
    (tmp_path / "m.xml").write_text(SLIDER.format(damping=damping, stiffness=1.0))
    text = 'model = "m.xml"\nduration = 0.2\nintegrator = "leapfrog"\ngoal = { slide = 0.1 }\n'
    (tmp_path / "p.toml").write_text(text)
    problem = load(tmp_path / "p.toml").problem
    assert (problem.dynamics.dt, problem.dynamics.integrator) == (0.01, "leapfrog")
    assert problem.dynamics.substeps <= 3
    assert stage_too_long(problem) == ""


def test_a_swing_too_fast_for_it_is_told():
    m = Mechanism.from_mjcf(SLIDER.format(damping=1.0, stiffness=1e5))  # 316 rad/s, of 1 kg
    dynamics = RigidBodyDynamics(m, 0.01, "leapfrog")
    problem = Problem(dynamics, TrackingCost.joints(dynamics, [0.0, 0.0], 5, effort=1.0), [0.1, 0.0])
    assert 'expected integrator="rk4", substeps=5' in stage_too_long(problem)  # 316 per s 0.01 s / 0.7 = 4.5


@pytest.mark.parametrize("integrator", ["leapfrog", "rosenbrock", "semi-implicit-euler"])
def test_a_rollout_costs_what_its_cost_says(integrator):
    """Costs of frames are of the links at the knots, wherever the last evaluation of a stage has left them."""
    m = Mechanism.from_mjcf(BOX, contacts="off")
    dynamics, N = RigidBodyDynamics(m, 0.005, integrator), 20
    x0 = m.home
    x0[m.nq :] = 0.5
    reach = FrameCost(dynamics, "arm", position=(0.3, 0.1, 0.2), position_weight=10.0)
    cost = TrackingCost.joints(dynamics, m.home, N, effort=1e-2, velocity=0.1) + reach
    problem = Problem(dynamics, cost, x0, us=np.full((N, 1), 0.3))
    found = acquire_engine(problem).start_from_controls(x0, problem.us)
    assert found == pytest.approx(cost.value(rollout_states(dynamics, x0, problem.us), problem.us), rel=1e-10)
