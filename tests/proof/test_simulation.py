"""Ways to step a model that must not differ in a bit: all steps in C or one by one, with contacts recorded or not."""

import numpy as np
import pytest

from planner.base.gl import load_mujoco
from planner.model.mjcf.survey import compile_model
from planner.proof import simulation
from planner.proof.contact_history import ContactRecorder
from planner.proof.simulation import simulate

ARM = """
<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody>
  <body><joint axis="0 1 0" range="-20 20" limited="true"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".02"/>
    <body pos=".5 0 0"><joint axis="0 1 0"/><geom size=".05" pos=".3 0 0"/></body></body>{floor}
</worldbody><actuator><general joint="{joint}" dyntype="filter" dynprm="0.1"/></actuator></mujoco>
"""
FLOOR = '<geom type="plane" pos="0 0 -.4" size="2 2 1"/>'


def model(integrator, floor=""):
    text = ARM.format(integrator=integrator, floor=floor, joint="elbow")
    return compile_model(text.replace('<joint axis="0 1 0"/>', '<joint name="elbow" axis="0 1 0"/>'))


@pytest.mark.parametrize("integrator", ["RK4", "Euler"])
def test_all_steps_at_once_are_those_one_by_one(monkeypatch, integrator):
    arm, ctrl = model(integrator), np.random.default_rng(0).normal(size=(300, 1))
    arm.geom_contype[:] = 0
    monkeypatch.setattr(simulation, "_AT_ONCE", 70)  # limits are reached, and the solver starts warm in every piece
    at_once, _ = simulate(arm, np.zeros(5), ctrl)
    monkeypatch.setattr(simulation, "_at_once", lambda *_: False)
    one_by_one, warnings = simulate(arm, np.zeros(5), ctrl)
    np.testing.assert_array_equal(at_once, one_by_one)
    assert not warnings


@pytest.mark.parametrize("integrator", ["RK4", "Euler", "implicit", "implicitfast"])
def test_recording_contacts_changes_no_step(integrator):
    arm, ctrl = model(integrator, FLOOR), np.random.default_rng(0).normal(size=(600, 1))
    recorder = ContactRecorder(arm, len(ctrl))
    watched, _ = simulate(arm, np.zeros(5), ctrl, recorder=recorder)
    plain, _ = simulate(arm, np.zeros(5), ctrl)
    np.testing.assert_array_equal(watched, plain)
    assert recorder.force.max() > 0.0


def test_a_runaway_ends_in_nan_and_a_sentence():
    arm = model("Euler")
    arm.opt.disableflags |= load_mujoco().mjtDisableBit.mjDSBL_AUTORESET
    states, warnings = simulate(arm, np.array([0.0, 0.0, 0.0, 1e9, 0.0]), np.zeros((400, 1)))
    assert np.isfinite(states[0]).all()
    assert np.isnan(states[-1]).all()
    assert "unstable" in warnings[0]
