"""Stops of joints that nothing drives: MuJoCo's accelerations of any file, derivatives, and which joints have them."""

from dataclasses import replace

import numpy as np
import pytest
from gradients import assert_step_derivatives
from trees import mujoco

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.step_stability import LEAD_SHARE, TARGET_RATE_STEP, fastest_mode
from planner.model.mechanism import Mechanism

ARM = """<mujoco><compiler angle="radian"/><option tolerance="1e-15" iterations="200"/>
  <default><joint axis="0 1 0" solreflimit="{solref}" solimplimit="{solimp}" margin="{margin}"/></default><worldbody>
  <body><joint name="driven" range="-1 1" armature=".01"/><geom size=".05" pos=".2 0 0" mass="1"/>
    <body pos=".4 0 0"><joint name="wrist" range="-.2 .3" frictionloss="{loss}"/>
      <geom size=".05" pos=".2 0 0" mass=".5"/>
      <body pos=".3 0 0"><joint name="drawer" type="slide" axis="1 0 .2" range="-.01 .02"/><geom size=".03" mass=".1"/>
      </body></body></body></worldbody><actuator><motor joint="driven"/></actuator></mujoco>"""

FLAT, USUAL, RISING = ".9 .9 .001", ".9 .95 .001", ".015 .99 .01 .4 2"  # solimp: constant, the default, and rising far


def arm(solref=".02 1", solimp=USUAL, margin=0, loss=0):
    """The text of an arm with two undriven joints."""
    return ARM.format(solref=solref, solimp=solimp, margin=margin, loss=loss)


def states(m, number=40):
    """States (K, nx) near the ends of the undriven ranges and beyond, slow and fast, and controls (K, 1)."""
    rng = np.random.default_rng(0)
    xs = np.zeros((number, 2 * m.nv))
    for i in (1, 2):
        low, high = m.stops[2 * i - 2].end, m.stops[2 * i - 1].end
        share = rng.choice([-0.1, -0.003, 0.003, 0.5, 0.997, 1.003, 1.1], number)
        xs[:, i] = low + share * (high - low)
    xs[:, 0] = rng.uniform(-0.5, 0.5, number)
    xs[:, 3:] = rng.normal(size=(number, 3)) * rng.choice([0.01, 0.3, 3.0], (number, 1))
    return xs, rng.normal(size=(number, 1)) * 5.0


def accelerations(m, xs, us):
    """Accelerations (K, nv) of the kernels: a step of explicit Euler of 1 s."""
    return RigidBodyDynamics(m, 1.0, "euler").step(xs, us)[:, 3:] - xs[:, 3:]


def sharp(m):
    """The mechanism without the smoothing of its stops."""
    return replace(m, stops=tuple(replace(one, law=replace(one.law, ramp=0.0, force_ramp=0.0)) for one in m.stops))


@pytest.mark.parametrize("margin", [0, 0.004])
@pytest.mark.parametrize("solimp", [FLAT, USUAL, RISING])
@pytest.mark.parametrize("solref", [".02 1", ".005 .7", "-4000 -60"])
def test_stops_have_mujocos_accelerations(solref, solimp, margin):
    text = arm(solref, solimp, margin)
    m, model = sharp(Mechanism.from_mjcf(text)), mujoco.MjModel.from_xml_string(text)
    data, met = mujoco.MjData(model), 0
    xs, us = states(m)
    for x, u, ours in zip(xs, us, accelerations(m, xs, us), strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = x[:3], x[3:], u, 0.0
        mujoco.mj_forward(model, data)
        met += data.nefc > 0
        assert np.abs(ours - data.qacc).max() <= 1e-10 * max(
            1.0, np.abs(data.qacc).max()
        )  # Newton's of both ends at 1e-12
    assert met > 20


def test_only_what_nothing_drives_has_stops():
    text = arm().replace("</worldbody>", '</worldbody><equality><joint joint1="drawer" joint2="driven"/></equality>')
    assert [(one.dof, one.side, one.end) for one in Mechanism.from_mjcf(arm()).stops] == [
        (1, -1, -0.2), (1, 1, 0.3), (2, -1, -0.01), (2, 1, 0.02),
    ]  # fmt: skip
    assert {one.dof for one in Mechanism.from_mjcf(text).stops} == {1}  # the drawer goes where the driven joint does
    fourth = arm(solimp=".9 .95 .001 .5 3")  # a rise that no law has
    assert Mechanism.from_mjcf(fourth).stops == ()


@pytest.mark.parametrize("integrator", ["euler", "rk4", "rosenbrock"])
@pytest.mark.parametrize("loss", [0, 0.05])
def test_derivatives_are_those_of_differences(loss, integrator):
    m = Mechanism.from_mjcf(arm(loss=loss))
    m = replace(m, stops=tuple(replace(one, law=replace(one.law, ramp=2e-2, force_ramp=2.0)) for one in m.stops))
    dynamics = RigidBodyDynamics(m, 1e-3, integrator)
    # rounding then leaves 1e-9, and no state is as near to where a ramp begins
    assert_step_derivatives(dynamics, *states(m), h=1e-7, within=1e-6)


@pytest.mark.parametrize("loss", [0, 0.05])
def test_a_state_does_not_depend_on_those_beside_it(loss):
    """Without friction loss rounds are taken where any of four states is at a stop: the others are not to feel it."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(arm(loss=loss)), 2e-3, "rk4")
    xs, us = states(dynamics.mechanism)
    together, _ = dynamics.linearize(np.vstack([xs, xs[-1:]]), us)
    order = np.random.default_rng(1).permutation(len(xs))
    again, _ = dynamics.linearize(np.vstack([xs[order], xs[-1:]]), us[order])
    assert np.array_equal(again, together[order])
    alone = [dynamics.step(x[None], u[None])[0] for x, u in zip(xs, us, strict=True)]
    assert np.array_equal(dynamics.step(xs, us), alone)


def test_both_ends_press_where_margins_meet():
    text = arm(margin=0.02)  # the drawer's range is 0.03 m wide
    m, model = sharp(Mechanism.from_mjcf(text)), mujoco.MjModel.from_xml_string(text)
    x, data = np.array([[0.1, 0.05, 0.004, 0.2, -0.3, 0.1]]), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = x[0, :3], x[0, 3:]
    mujoco.mj_forward(model, data)
    assert data.nefc == 2
    np.testing.assert_allclose(accelerations(m, x, np.zeros((1, 1)))[0], data.qacc, rtol=1e-9)


TOE = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body pos="0 0 .25"><joint type="slide" axis="0 0 1"/><geom size=".05" mass="4" contype="0" conaffinity="0"/>
    <body><joint name="leg" type="slide" axis="0 0 1"/><geom size=".02" mass=".3" contype="0" conaffinity="0"/>
      <body pos="0 0 -.2"><joint name="toe" axis="0 1 0" range="-20 20"/><geom pos=".05 0 0" size=".03" mass=".2"/>
    </body></body></body></worldbody><actuator><motor joint="leg"/></actuator></mujoco>"""


def test_a_toe_at_its_stop_and_on_the_ground_accelerates_as_mujocos():
    m = sharp(Mechanism.from_mjcf(TOE))
    none = {"ramp": 0.0, "force_ramp": 0.0, "bend": 0.0}
    m = replace(m, contacts=tuple(replace(one, law=replace(one.law, **none)) for one in m.contacts))
    model, rng, met = mujoco.MjModel.from_xml_string(m.mjcf), np.random.default_rng(0), set()
    model.opt.tolerance, model.opt.iterations, data = 1e-15, 200, mujoco.MjData(model)
    for _ in range(40):
        q = np.array([rng.uniform(-0.03, 0.0), rng.uniform(-0.01, 0.01), rng.choice([-0.36, 0.36, 0.1])])
        v, u = rng.normal(size=3) * rng.choice([0.01, 1.0]), rng.normal(size=1) * 20.0
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = q, v, u, 0.0
        mujoco.mj_forward(model, data)
        met.add(int(data.nefc))
        ours = accelerations(m, np.concatenate([q, v])[None], u[None])[0]
        assert np.abs(ours - data.qacc).max() < 1e-11 * max(1.0, np.abs(data.qacc).max())
    assert met == {0, 1, 4, 5}  # rows of neither, of the stop, of the contact, of both


def test_prescribed_joints_leave_ranges_as_bounds():
    """MuJoCo's joints are then heavy, and so would be what its stops are relative to."""
    assert RigidBodyDynamics(Mechanism.from_mjcf(arm()), 0.01, prescribed=["driven"]).mechanism.stops == ()


def test_a_time_constant_below_two_steps_is_written_as_mujoco_takes_it():
    """The default timestep is 2 ms; a replay with a shorter one would take another."""
    m = Mechanism.from_mjcf(arm(solref=".001 1"))
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    np.testing.assert_array_equal(model.jnt_solref, [[0.001, 1.0], [0.004, 1.0], [0.004, 1.0]])
    assert m.stops[0].law.lead == pytest.approx(0.5 * 0.95 * 0.004)  # 1/b = dmax timeconst / 2


def test_a_stop_that_is_pressed_all_along_asks_for_no_shorter_substeps():
    """Near a stop a joint may meet it, which substeps of a part of its lead resolve."""
    m = Mechanism.from_mjcf(arm())
    free, near, pressed = (np.zeros((2, 6)) for _ in range(3))
    near[:, 1], pressed[:, 1] = 0.295, 0.301  # of a wrist whose range ends at 0.3 rad
    meets, leans = fastest_mode(m, near), fastest_mode(m, pressed)
    assert meets.joint == "joint 'wrist'"
    assert meets.rate == pytest.approx(TARGET_RATE_STEP / (LEAD_SHARE * m.stops[1].law.lead))
    assert max(fastest_mode(m, free).rate, leans.rate) < 0.7 * meets.rate
    assert fastest_mode(m, np.vstack([near, pressed])).rate == meets.rate
