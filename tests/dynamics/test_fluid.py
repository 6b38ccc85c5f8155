"""Drag of a fluid: against MuJoCo term by term, and derivatives against complex steps."""

import numpy as np
import pytest
from gradients import assert_step_derivatives
from machines import MACHINE
from twins import assert_kernels_are_their_twin

import planner
from planner.base.errors import ModelError
from planner.model.mechanism import Mechanism
from planner.proof.compare.rigid_parity import random_states

WATER = MACHINE.replace("<option ", '<option density="1000" viscosity="2" ')
DRIVEN = WATER.replace("</mujoco>", '<actuator><motor joint="swing"/></actuator></mujoco>')


@pytest.mark.parametrize("option", ['density="1000"', 'viscosity="2"', 'density="1000" viscosity="2"'])
def test_parity_with_mujoco(option):
    text = MACHINE.replace("<option ", f"<option {option} ")
    section = planner.parity(Mechanism.from_mjcf(text))
    assert section.passed, section
    wrong = planner.parity(Mechanism.from_mjcf(text), WATER.replace('"1000"', '"900"'))
    assert "the drag of the fluid" in str(wrong)


def test_kernels_are_their_twin_and_their_derivatives_exact():
    assert_kernels_are_their_twin(Mechanism.from_mjcf(WATER))


def test_a_stage_in_water():
    m = Mechanism.from_mjcf(DRIVEN)
    dynamics, rng = planner.RigidBodyDynamics(m, 0.002), np.random.default_rng(1)
    xs, us = random_states(m, rng, 4), rng.normal(size=(4, m.nu))
    assert_step_derivatives(dynamics, xs, us, within=1e-6)


def test_a_plan_in_water_holds_in_mujoco():
    """A fish turns its tail."""
    text = """
    <mujoco>
      <option gravity="0 0 0" density="1000"><flag contact="disable"/></option>
      <worldbody>
        <body>
          <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
          <joint name="turn" axis="0 0 1"/>
          <geom type="capsule" size="0.05" fromto="-0.2 0 0 0.2 0 0"/>
          <body pos="-0.2 0 0">
            <joint name="tail" axis="0 0 1" damping="0.01"/>
            <geom type="box" size="0.1 0.01 0.06" pos="-0.1 0 0"/>
          </body>
        </body>
      </worldbody>
      <actuator><motor name="tail" joint="tail"/></actuator>
    </mujoco>
    """
    dynamics = planner.RigidBodyDynamics(Mechanism.from_mjcf(text), 0.01)
    goal = [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    cost = planner.TrackingCost.joints(dynamics, goal, 100, effort=0.1, final_position={"tail": 1e3})
    plan = planner.solve(planner.Problem(dynamics, cost, np.zeros(8)))
    assert planner.prove(plan, rollouts=0).passed
    assert abs(plan.xs[-1, 0]) > 1e-3  # the water moves it


@pytest.mark.parametrize(
    ("option", "shape", "phrase"),
    [('density="1" wind="1 0 0"', "", "wind"), ('viscosity="1"', 'fluidshape="ellipsoid"', "ellipsoid fluid forces")],
)
def test_what_of_a_fluid_is_not_modelled(option, shape, phrase):
    text = (
        f'<mujoco><option {option}/><worldbody><body><joint/><geom size="0.1" pos="1 0 0" {shape}/></body>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(ModelError, match=phrase):
        Mechanism.from_mjcf(text)
    assert not Mechanism.from_mjcf(text, ignore=["fluid"]).drags
