"""A dog of 10 kg in a plane: two legs of two joints each, balls for feet, default contacts. No one's machine."""

DOG = """<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 .45">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom type="capsule" fromto="-.3 0 0 .3 0 0" size=".06" mass="7"/>
      {legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>"""
LEG = """<body name="{name} thigh" pos="{x} 0 0">
  <joint name="{name} hip" axis="0 1 0" range="-60 60" damping="1"/>
  <geom type="capsule" fromto="0 0 0 -.1 0 -.17" size=".03" mass="1"/>
  <body name="{name} shank" pos="-.1 0 -.17">
    <joint name="{name} knee" axis="0 1 0" range="-80 40" damping="1"/>
    <geom type="capsule" fromto="0 0 0 .1 0 -.17" size=".02" mass=".4"/>
    <geom name="{name} foot" size=".035" pos=".1 0 -.17" mass=".1"/>
  </body>
</body>"""
MOTOR = '<motor joint="{}" ctrllimited="true" ctrlrange="-40 40"/>'


def dog() -> str:
    """The MJCF."""
    legs = "".join(LEG.format(name=name, x=x) for name, x in (("fore", 0.3), ("hind", -0.3)))
    names = [f"{name} {joint}" for name in ("fore", "hind") for joint in ("hip", "knee")]
    return DOG.format(legs=legs, motors="".join(MOTOR.format(name) for name in names))
