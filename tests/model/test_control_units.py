"""The units of controls: of a motor its joint's force's, of a servo its joint's, "" where neither is plain."""

from thrusters import QUADROTOR

from planner.model.coordinates import controls_of_mechanism
from planner.model.mechanism import Mechanism
from planner.problem.default_appearance import default_appearance

ARM = """<mujoco>
  <worldbody><body><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1"/>
    <body pos="0 0 .3"><joint name="elbow" axis="0 1 0"/><geom size=".1" pos="0 0 .2"/></body></body></worldbody>
  <actuator>
    <motor name="push" joint="rail"/><motor name="turn" joint="elbow"/><motor joint="elbow" gear="50"/>
    <position name="goto" joint="elbow" kp="30"/><position name="slide to" joint="rail" kp="30" kv="2"/>
    <velocity name="speed" joint="rail" kv="3"/>
  </actuator>
</mujoco>"""


def test_units_of_controls():
    mechanism = Mechanism.from_mjcf(ARM)
    assert controls_of_mechanism(mechanism) == (
        ("push", "N"), ("turn", "N m"), ("actuator 2", ""), ("goto", "rad"), ("slide to", "m"), ("speed", ""),
    )  # fmt: skip


def test_a_rotor_pushes_with_newtons():
    assert {unit for _, unit in controls_of_mechanism(Mechanism.from_mjcf(QUADROTOR))} == {"N"}
    couple = QUADROTOR.replace("0 0 1 0 0 0.016", "0 0 0 0 1 0").replace("0 0 1 0 0 -0.016", "0 0 2 0 0 0")
    assert {unit for _, unit in controls_of_mechanism(Mechanism.from_mjcf(couple))} == {"N m", ""}


def test_a_panel_has_controls_of_one_unit():
    panels = [panel for panel in default_appearance(Mechanism.from_mjcf(ARM)).plots if panel.controls]
    assert [panel.ylabel for panel in panels] == ["force, N", "torque, N m", "control", "angle, rad", "position, m"]
    assert [[i for i, _ in panel.controls] for panel in panels] == [[0], [1], [2, 5], [3], [4]]
