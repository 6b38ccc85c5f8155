"""Gravity compensation and fixed tendons: against MuJoCo term by term, and derivatives against complex steps."""

import numpy as np
import pytest
from gradients import assert_step_derivatives
from machines import MACHINE, lifted
from twins import assert_kernels_are_their_twin

import planner
from planner.base.errors import PlannerError
from planner.dynamics import algorithms
from planner.model.mechanism import Mechanism
from planner.proof.compare.rigid_parity import random_states

TEXT = lifted(MACHINE)


def test_parity_with_mujoco():
    section = planner.parity(Mechanism.from_mjcf(TEXT))
    assert section.passed, section
    wrong = planner.parity(Mechanism.from_mjcf(TEXT), TEXT.replace('gravcomp="0.6"', 'gravcomp="0.7"'))
    assert "mass with gravity compensation" in str(wrong)
    wrong = planner.parity(Mechanism.from_mjcf(TEXT), TEXT.replace('"2"><j', '"3"><j'))
    assert "stiffness of tendon 'taut'" in str(wrong)


def test_kernels_are_their_twin_and_their_derivatives_exact():
    assert_kernels_are_their_twin(Mechanism.from_mjcf(TEXT))


def test_a_stage_of_a_machine_with_both():
    m = Mechanism.from_mjcf(TEXT)
    dynamics, rng = planner.RigidBodyDynamics(m, 0.005), np.random.default_rng(1)
    xs, us = random_states(m, rng, 4), rng.normal(size=(4, 1))
    assert_step_derivatives(dynamics, xs, us, within=1e-6)


def test_weight_that_is_carried_needs_no_holding():
    body = '<body gravcomp="1"><joint axis="0 1 0"/><geom size="0.1" pos="1 0 0"/></body>'
    still = Mechanism.from_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert np.abs(algorithms.bias(still, [0.3], [0.0])).max() < 1e-12 * 9.81 * 4.2


def test_clamped_compensation_is_refused():
    text = (
        '<mujoco><worldbody><body gravcomp="1"><joint name="a" actuatorgravcomp="true" actuatorfrcrange="-1 1"/>'
        '<geom size="0.1" pos="1 0 0"/></body></worldbody><actuator><motor joint="a"/></actuator></mujoco>'
    )
    with pytest.raises(PlannerError, match="clamped actuatorgravcomp of joint 'a'"):
        Mechanism.from_mjcf(text)
    free = text.replace(' actuatorfrcrange="-1 1"', "")
    assert planner.parity(Mechanism.from_mjcf(free)).passed


def test_a_tendons_range_is_data_and_named_where_a_motion_leaves_it():
    from planner.base.gl import load_mujoco
    from planner.proof.replays.ranges import ranges_reached

    m = Mechanism.from_mjcf(TEXT)
    assert m.tendons[0].range == (-1.0, 1.0)
    w = np.tile(m.home, (3, 1))
    w[1:, m.q_address[m.joint("lift")]] += 2.0
    said = ranges_reached(load_mujoco().MjModel.from_xml_string(TEXT), np.arange(3.0), w, np.zeros((2, 1)))
    assert [one for one in said if "tendon 'slack' is outside its range from t = 1 s" in one]
