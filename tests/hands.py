"""Machines with a hand, for the tests of costs of its place."""

MACHINE = """
<mujoco>
  <option gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <site name="fixed" pos="1 2 3"/>
    <body name="trunk">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="3" diaginertia="0.1 0.2 0.3"/>
      <body name="arm" pos="0.1 0.2 0" euler="0 30 10">
        <joint name="shoulder" axis="0 1 0"/>
        <inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>
        <body name="palm" pos="0.4 0 0">
          <joint name="wrist" type="ball"/>
          <inertial pos="0.05 0 0" mass="0.2" diaginertia="0.001 0.002 0.003"/>
          <site name="hand" pos="0.1 0.02 0" euler="10 20 30"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def random_states(machine, rng, count):
    return machine.space.integrate(machine.home, rng.uniform(-0.6, 0.6, (count, machine.space.ndx)))


ARM = """
<mujoco>
  <option><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body pos="0 0 -1">
        <joint name="b" axis="0 1 0" damping="0.1"/>
        <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/>
        <site name="tip" pos="0 0 -1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator>
</mujoco>
"""
