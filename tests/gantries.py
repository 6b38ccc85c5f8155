"""A tool on two slides beside a wall, whose straight way is through it; shared by tests of what is kept apart."""

GANTRY = """<mujoco model="gantry">
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <joint name="x" type="slide" axis="1 0 0" range="-2 2" damping="1"/>
      <joint name="z" type="slide" axis="0 0 1" range="-1 2" damping="1"/>
      <geom name="tool" {tool} mass="1"/>
    </body>
    <geom name="wall" {wall}/>
    {others}
  </worldbody>
  <actuator><motor name="x" joint="x" ctrlrange="-60 60"/><motor name="z" joint="z" ctrlrange="-60 60"/></actuator>
  <keyframe><key name="left" qpos="-0.5 0.1"/><key name="right" qpos="0.5 0.1"/></keyframe>
</mujoco>"""


def gantry(tool='type="sphere" size="0.05"', wall='type="box" size="0.05 0.5 0.3"', others=""):
    return GANTRY.format(tool=tool, wall=wall, others=others)
