"""An arm with a light, damped finger: a joint that is too fast for one step of RK4 in a usual stage."""

FAST = """
<mujoco><worldbody><body name="arm"><joint name="arm" axis="0 1 0"/>
  <inertial mass="1" pos="0 0 -0.5" diaginertia="0.1 0.1 0.1"/>
  <body name="finger" pos="0 0 -1"><joint name="finger" axis="0 1 0" damping="0.02" stiffness="0.5"/>
    <inertial mass="0.02" pos="0 0 -0.05" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
  <actuator><motor joint="arm"/><position joint="finger" kp="1" kv="0.01"/></actuator></mujoco>
"""
