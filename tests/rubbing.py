"""Machines with friction loss, gravity compensation and fixed tendons as MJCF, for tests."""

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <default><joint armature="0.05" damping="0.2"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 1"><joint name="turn" axis="0 0 1" frictionloss="0.6"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0 0 0.3" mass="2"/>
      <body pos="0 0 0.3"><joint name="lift" axis="0 1 0" frictionloss="0.4" solreffriction="-3 -60"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.4 0 0" mass="2"/>
        <body pos="0.4 0 0"><joint name="bend" axis="0 1 0" frictionloss="0.2" solimpfriction="0.8 0.9 0.1"/>
          <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0" mass="1"/></body></body></body>
  </worldbody>
  <actuator><motor joint="turn"/><motor joint="lift"/><motor joint="bend"/></actuator>
</mujoco>
"""

LIFTED = ('<body name="arm"', '<body name="tip"', '<body name="wrist"', '<body name="kite"')
"""Bodies of mechanisms.MACHINE, of which gravity compensation carries a share."""

TENDONS = """
<tendon>
  <fixed name="slack" stiffness="5" springlength="0.1 0.4" damping="0.7" limited="true" range="-1 1">
    <joint joint="lift" coef="1.3"/><joint joint="swing" coef="-0.6"/><joint joint="turn" coef="0.4"/></fixed>
  <fixed name="taut" stiffness="2"><joint joint="slip" coef="1"/><joint joint="turn" coef="2"/></fixed>
</tendon>
<actuator><motor name="push" joint="slip"/></actuator>
"""


def lifted(text: str) -> str:
    """mechanisms.MACHINE with gravity compensation of several shares and with fixed tendons."""
    for share, body in zip((1.0, 0.6, -0.5, 1.2), LIFTED, strict=True):
        text = text.replace(body, f'{body} gravcomp="{share}"')
    return text.replace("</worldbody>", f"</worldbody>{TENDONS}")
