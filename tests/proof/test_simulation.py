"""Ways to step a model that must not differ in a bit: all steps in C or one by one, with contacts recorded or not."""

import numpy as np
import pytest

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import compile_model
from planner.proof.replays import contact_history, simulation
from planner.proof.replays.contact_history import ContactRecorder
from planner.proof.replays.simulation import simulate

ARM = """
<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody>
  <body><joint axis="0 1 0" range="-20 20" limited="true"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".02"/>
    <body pos=".5 0 0"><joint axis="0 1 0"/><geom size=".05" pos=".3 0 0"/></body></body>{floor}
</worldbody><actuator><general joint="{joint}" dyntype="filter" dynprm="0.1"/></actuator></mujoco>
"""
PILE = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="2 2 1"/>
  <body pos="0 0 .11"><freejoint/><geom name="left" size=".1"/></body>
  <body pos="1 0 .13"><freejoint/><geom name="right" size=".1"/></body>
  <body pos="0 0.01 .33"><freejoint/><geom name="top" size=".1"/></body>
</worldbody></mujoco>
"""
FLOOR = '<geom type="plane" pos="0 0 -.4" size="2 2 1"/>'


def model(integrator, floor=""):
    text = ARM.format(integrator=integrator, floor=floor, joint="elbow")
    return compile_model(text.replace('<joint axis="0 1 0"/>', '<joint name="elbow" axis="0 1 0"/>'))


def pushing_back(i, w):
    return -5.0 * w[:1]


@pytest.mark.parametrize("control", [None, pushing_back])
@pytest.mark.parametrize("integrator", ["RK4", "Euler"])
def test_all_steps_at_once_are_those_one_by_one(monkeypatch, integrator, control):
    arm, ctrl = model(integrator), np.random.default_rng(0).normal(size=(300, 1))
    arm.geom_contype[:] = 0
    monkeypatch.setattr(simulation, "_AT_ONCE", 70)  # limits are reached, and the solver starts warm in every piece
    at_once, _ = simulate(arm, np.zeros(5), ctrl.copy(), control=control, held=40)
    monkeypatch.setattr(simulation, "_advance", lambda *_: False)
    one_by_one, warnings = simulate(arm, np.zeros(5), ctrl, control=control, held=40)
    np.testing.assert_array_equal(at_once, one_by_one)
    assert not warnings


def test_a_piece_that_diverges_is_stepped_again_to_say_when(monkeypatch):
    arm, ctrl = model("Euler"), np.zeros((300, 1))
    arm.geom_contype[:] = 0
    ctrl[200:] = 1e12  # MuJoCo warns of it and leaves it out

    def run():
        return simulate(arm, np.ones(5), ctrl, control=lambda i, w: ctrl[i : i + 30], held=30)

    at_once = run()
    monkeypatch.setattr(simulation, "_advance", lambda *_: False)
    one_by_one = run()
    np.testing.assert_array_equal(at_once[0], one_by_one[0])
    assert at_once[1] == one_by_one[1] == ("MuJoCo warned of badctrl 100 times.",)  # steps 200 to 299


@pytest.mark.parametrize("integrator", ["RK4", "Euler", "implicit", "implicitfast"])
def test_recording_contacts_changes_no_step(integrator):
    arm, ctrl = model(integrator, FLOOR), np.random.default_rng(0).normal(size=(600, 1))
    recorder = ContactRecorder(arm, len(ctrl))
    watched, _ = simulate(arm, np.zeros(5), ctrl, recorder=recorder)
    plain, _ = simulate(arm, np.zeros(5), ctrl)
    np.testing.assert_array_equal(watched, plain)
    assert recorder.force.max() > 0.0


@pytest.mark.parametrize("at_once", [1, 7, 4096])
def test_contacts_are_summed_up_as_one_by_one(monkeypatch, at_once):
    """Two balls fall on a floor, a third falls on one of them and off it: the sums of a plain loop over contacts."""
    monkeypatch.setattr(contact_history, "_AT_ONCE", at_once)
    monkeypatch.setattr(contact_history, "MAX_SAMPLES", 100)
    pile, steps = compile_model(PILE), 450
    recorder, data, w = ContactRecorder(pile, steps), load_mujoco().MjData(pile), np.zeros(6)
    force, moment, pairs, first = np.zeros(steps), np.zeros((steps, 3)), {}, None
    each, names = 5, [pile.geom(k).name for k in range(pile.ngeom)]
    for i in range(steps):
        recorder.look(i, data)
        for c in range(data.ncon):
            contact = data.contact[c]
            load_mujoco().mj_contactForce(pile, data, c, w)
            one, other = contact.geom
            first = first or (one, other, i)
            force[i] += w[0]
            moment[i] += w[0] * contact.pos
            sums = pairs.setdefault(f"{names[other]} on {names[one]}", np.zeros((91, 7)))  # the later on the earlier
            sums[i // each] += [*(contact.frame.reshape(3, 3).T @ w[:3]), w[0], *(w[0] * contact.pos)]
        load_mujoco().mj_step(pile, data)
    touching = force > 0.0
    np.testing.assert_allclose(recorder.force[:-1], force, rtol=1e-12)
    expected = moment[touching] / force[touching, None]
    np.testing.assert_allclose(recorder.point[:-1][touching], expected, rtol=1e-12, atol=1e-15)
    assert np.isnan(recorder.point[:-1][~touching]).all()
    assert recorder.first == first
    history = recorder.history(pile.opt.timestep * np.arange(steps + 1))
    assert sorted(history.names) == sorted(pairs)
    assert {"left on floor", "right on floor", "top on left"} <= {*pairs}
    for c, name in enumerate(history.names):
        count = np.array([each] * 90 + [1])[:, None]
        np.testing.assert_allclose(history.forces[:, c], pairs[name][:, :3] / count, rtol=1e-9, atol=1e-12)
        felt = pairs[name][:, 3] > 0.0
        expected = pairs[name][felt, 4:] / pairs[name][felt, 3:4]
        np.testing.assert_allclose(history.points[felt, c], expected, rtol=1e-9, atol=1e-12)


def test_controls_may_be_asked_for_several_steps_at_a_time():
    arm, asked = model("Euler"), []

    def control(i, w):
        asked.append(i)
        return np.arange(i, min(i + 3, 10))[:, None]

    ctrl = np.zeros((10, 1))
    states, _ = simulate(arm, np.zeros(5), ctrl, control=control, held=3)
    assert asked == [0, 3, 6, 9]
    np.testing.assert_array_equal(ctrl[:, 0], np.arange(10))
    np.testing.assert_array_equal(states, simulate(arm, np.zeros(5), ctrl)[0])


def test_a_runaway_ends_in_nan_and_a_sentence():
    arm = model("Euler")
    arm.opt.disableflags |= load_mujoco().mjtDisableBit.mjDSBL_AUTORESET
    states, warnings = simulate(arm, np.array([0.0, 0.0, 0.0, 1e9, 0.0]), np.zeros((400, 1)))
    assert np.isfinite(states[0]).all()
    assert np.isnan(states[-1]).all()
    assert "unstable" in warnings[0]
