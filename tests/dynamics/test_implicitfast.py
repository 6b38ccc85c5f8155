"""Steps of "implicitfast": MuJoCo's own, parts of them, second derivatives, and the machines that it refuses."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from closed_chains import four_bar
from gradients import second_order_differences
from hypothesis import assume
from trees import CHAINS, actuated, damped, driven, machines

from planner import Mechanism, RigidBodyDynamics
from planner.base.errors import PlannerError
from planner.cases.problem_file.machine import with_step
from planner.dynamics.step_stability import fastest_mode
from planner.proof.same_step import floats_alone

SERVO = """
<mujoco><option integrator="implicitfast" timestep="0.01"/><worldbody><body><joint name="a" axis="0 1 0" damping="0.3"/>
  <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><body><joint name="b" axis="0 1 0"/>
  <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body></body></worldbody>{more}
  <actuator><position joint="a" kp="10" kv="5" forcerange="-1 1"/>{actuator}</actuator></mujoco>
"""


def mujocos(model, x, u):
    """The state after one step of MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = np.split(x, [model.nq, model.nq + model.nv])
    data.ctrl[:] = u
    mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel, data.act])


@machines(16, max_dofs=20)
def test_a_step_is_mujocos(text, seed):
    """With dampers on hinges, slides, balls and free joints, servos' kv, and filters."""
    m, x, us, model = damped(text, seed)
    assume(not floats_alone(model))  # MuJoCo turns such a body by an implicit step of its gyroscopic forces, too
    model.opt.timestep = 0.02
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ours, theirs = RigidBodyDynamics(m, 0.02, "implicitfast").step(x[None], us)[0], mujocos(model, x, us[0])
    size = max(1.0, np.abs(m.space.difference(theirs, x)).max())
    assert np.abs(m.space.difference(ours, theirs)).max() < 1e-10 * size


def test_what_mujoco_clamps_it_does_not_damp():
    """A servo at its bound has no kv in MuJoCo's matrix: plans keep their forces within bounds, where both agree."""
    m = Mechanism.from_mjcf(SERVO.format(more="", actuator=""))
    model, dynamics = mujoco.MjModel.from_xml_string(m.mjcf), RigidBodyDynamics(m, 0.01, "implicitfast")
    x = np.zeros(4)
    for control, agrees in ((0.05, True), (0.1, False)):  # 0.5 N m, and 1 N m: its bound
        ours, theirs = dynamics.step(x[None], np.array([[control]]))[0], mujocos(model, x, [control])
        assert (np.abs(ours - theirs).max() < 1e-15) == agrees


@machines(6, max_dofs=12)
def test_a_part_of_a_stage_is_a_step_of_that_length(text, seed):
    dynamics, xs, us, rng = driven(text, seed, K=6, integrator="implicitfast")
    lengths = dynamics.dt * np.array([0.0, 1.0, *rng.random(2), 0.25, 0.25])
    ends = dynamics.step(xs, us, lengths)
    for x, u, h, end in zip(xs[1:], us[1:], lengths[1:], ends[1:], strict=True):
        part = RigidBodyDynamics(dynamics.mechanism, h, "implicitfast", dynamics.prescribed)
        wanted = part.step(x[None], u[None])[0]
        # lengths of parts are told apart by 1e-10 of a stage, and so are the armatures
        np.testing.assert_allclose(end, wanted, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(ends[0, dynamics.mechanism.nq :], xs[0, dynamics.mechanism.nq :], rtol=1e-15)
    np.testing.assert_array_equal(ends[1], dynamics.step(xs[1:2], us[1:2])[0])


def test_rates_are_the_machines_own():
    m = Mechanism.from_mjcf(actuated(CHAINS["arm"], np.random.default_rng(0)))
    m = replace(m, damping=np.full(m.nv, 1e3))
    rng = np.random.default_rng(1)
    xs, us = rng.normal(size=(3, m.space.nx)), rng.normal(size=(3, m.nu))
    explicit, implicit = (RigidBodyDynamics(m, 0.01, kind) for kind in ("semi-implicit-euler", "implicitfast"))
    np.testing.assert_array_equal(implicit.rates(xs, us), explicit.rates(xs, us))
    assert np.abs(implicit.step(xs, us) - explicit.step(xs, us)).max() > 1.0


def test_second_derivatives_are_differences_of_the_first():
    m = Mechanism.from_mjcf(actuated(CHAINS["arm"], np.random.default_rng(0), activations=False))
    dynamics = RigidBodyDynamics(replace(m, damping=np.array([50.0, 9.0, 300.0, 4.0])), 0.05, "implicitfast")
    rng = np.random.default_rng(2)
    at = [rng.normal(size=(k, n)) for k, n in ((2, dynamics.nx), (1, dynamics.nu), (2, dynamics.nx))]
    T = dynamics.second_order(*at)
    np.testing.assert_allclose(T, second_order_differences(dynamics, *at), atol=1e-7 * max(1.0, np.abs(T).max()))


TENDON = '<tendon><fixed damping="2"><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>'


@pytest.mark.parametrize(
    ("more", "actuator", "said"),
    [
        (TENDON, "", "damps joint 'a' and joint 'b' together"),
        ("", '<general joint="b" biastype="affine" biasprm="0 0 2"/>', "drives joint 'b' by negative damping"),
    ],
)
def test_other_damping_is_refused(more, actuator, said):
    m = Mechanism.from_mjcf(SERVO.format(more=more, actuator=actuator))
    with pytest.raises(PlannerError, match=said) as error:
        RigidBodyDynamics(m, 0.01, "implicitfast")
    assert '"rosenbrock"' in str(error.value)


def test_a_stage_is_one_step():
    m = Mechanism.from_mjcf(SERVO.format(more="", actuator=""))
    with pytest.raises(PlannerError, match="substeps is 2 and the integrator 'implicitfast'"):
        RigidBodyDynamics(m, 0.01, "implicitfast", substeps=2)


def test_it_is_chosen_where_a_closed_chain_has_stiff_damping():
    """Which the Rosenbrock method does not keep, and RK4 would follow in stages below 0.5 ms."""
    m = four_bar(damping=1e5)
    assert fastest_mode(m, m.home).rate > 16 * 2.0 / 5e-4
    auto = {"dt": "auto", "substeps": "auto", "integrator": "auto", "duration": 1.0}
    table, substeps, reasons = with_step(auto, m, (), [m.home])
    assert (table["integrator"], table["dt"], substeps) == ("implicitfast", 0.01, 1)
    assert "1 step a stage" in reasons["substeps"]
    dynamics, h = RigidBodyDynamics(m, 0.01, "implicitfast"), 1e-6
    x, u, space = dynamics.step(m.home[None], np.full((1, m.nu), 1e4))[0], np.full((1, m.nu), 1e4), m.space
    A, _ = dynamics.linearize(np.stack([x, x]), u)
    ends = [[dynamics.step((x + s * h * e)[None], u)[0] for s in (1, -1)] for e in np.eye(space.ndx)]
    theirs = np.array([(ahead - back) / (2.0 * h) for ahead, back in ends]).T
    np.testing.assert_allclose(A[0], theirs, atol=1e-7)  # rounding over h, of states of size 1


@pytest.mark.parametrize(
    ("damping", "shape", "integrator", "substeps"),
    # of rates of 97 and 993 per s, which RK4 follows by 2 and 10 substeps; the implicit method is exact by 4
    [
        (1, "", "rk4", 2),
        (100, "", "rosenbrock", 4),
        (100, '<geom name="floor" type="plane" size="1 1 1"/>', "rk4", None),
    ],
)
def test_a_method_is_chosen_by_what_it_costs_where_nothing_touches(damping, shape, integrator, substeps):
    m = Mechanism.from_mjcf(
        f'<mujoco><worldbody>{shape}<body pos="0 0 1"><joint name="a" axis="0 1 0" damping="{damping}"/>'
        '<geom size=".1" pos=".3 0 0" mass="1"/><body pos=".6 0 0"><joint name="b" axis="0 1 0" damping="1"/>'
        '<geom size=".1" pos=".3 0 0" mass="1"/></body></body></worldbody>'
        '<actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>',
        contacts="file" if shape else "auto",
    )
    auto = {"dt": "auto", "substeps": "auto", "integrator": "auto", "duration": 1.0}
    table, chosen, _ = with_step(auto, m, (), [m.home])
    assert (table["integrator"], table["dt"]) == (integrator, 0.01)
    assert substeps in (None, chosen)
