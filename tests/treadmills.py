"""A treadmill with someone on it who only stands and slides: what is filmed needs no plan, only a replay."""

from types import SimpleNamespace

import numpy as np
from contact_machines import attributes

from planner.base.gl import load_mujoco
from planner.model.mjcf.contacts import contact_attributes
from planner.model.mjcf.model_index import compile_model
from planner.model.twin import Twin
from planner.problem.appearance import Appearance, Readout, View
from planner.problem.plan import Plan, Status
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import ContactRecorder
from planner.proof.replays.replaying import Replay

BELT_SPEED = 1.0  # m/s, backward
FRICTION, IMPRATIO = 0.6, 1000.0
WEIGHT = 9.81 * (10.0 + 1.0 + 1.0 + 0.1 + 0.1)
PAIR = attributes(contact_attributes(2e4, 300.0, 150.0, FRICTION, 9.81 / WEIGHT, IMPRATIO))

# The trunk hangs on damped slides, its two feet touch the belt. Between frame and trunk is a strut.
TREADMILL = f"""<mujoco model="treadmill"><option timestep="1e-3" cone="elliptic" impratio="{IMPRATIO}">
    <flag refsafe="disable"/></option>
  <visual><global offwidth="640" offheight="480"/></visual>
  <asset><texture name="checks" type="2d" builtin="checker" rgb1=".1 .1 .1" rgb2=".6 .6 .6" width="64" height="64"/>
    <material name="belt" texture="checks" texrepeat="2 2" texuniform="true"/></asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><site name="frame" pos="-.8 0 .9"/>
    <body name="belt"><joint name="belt" type="slide" axis="1 0 0"/>
      <geom name="belt" type="box" size="60 .5 .1" pos="0 0 -.1" mass="1e6" material="belt"/></body>
    <body name="trunk" pos="0 0 .8"><joint name="x" type="slide" axis="1 0 0" stiffness="4000" damping="400"/>
      <joint name="z" type="slide" axis="0 0 1" damping="200"/>
      <geom name="trunk" type="box" size=".1 .15 .2" mass="10" rgba=".2 .3 .8 1"/><site name="girdle" pos="-.1 0 0"/>
      <geom type="capsule" fromto="0 .1 0 0 .1 -.75" size=".04" mass="1" rgba=".2 .3 .8 1"/>
      <geom type="capsule" fromto="0 -.1 0 0 -.1 -.75" size=".04" mass="1" rgba=".2 .3 .8 1"/>
      <geom name="left_foot" type="sphere" pos="0 .1 -.75" size=".05" mass=".1"/>
      <geom name="right_foot" type="sphere" pos="0 -.1 -.75" size=".05" mass=".1"/></body></worldbody>
  <tendon><spatial name="strut" width=".02" rgba=".9 .7 .1 1"><site site="frame"/><site site="girdle"/></spatial>
  </tendon>
  <contact><pair geom1="belt" geom2="left_foot" {PAIR}/>
    <pair geom1="belt" geom2="right_foot" {PAIR}/></contact></mujoco>"""

APPEARANCE = Appearance(
    title="standing", readouts=(Readout("height", 2, "m"),), scenery=("belt", "strut"), look_at=(0.0, 0.0, 0.5),
    distance=3.0, views=(View(90.0, -8.0, label="side"), View(180.0, -8.0, label="front")), force_scale=0.004,
)  # fmt: skip


def standing(appearance=APPEARANCE, steps=400, text=TREADMILL):
    """MuJoCo's replay of one who is dragged along by the belt until friction holds what his spring does; x = (q, v)."""
    mujoco, model = load_mujoco(), compile_model(text)
    data, recorder = mujoco.MjData(model), ContactRecorder(model, steps)
    data.qvel[0] = -BELT_SPEED
    w = np.empty((steps + 1, model.nq + model.nv))
    for i in range(steps + 1):
        w[i] = np.concatenate([data.qpos, data.qvel])
        recorder.look(i, data)
        mujoco.mj_step(model, data)
    t, eye, none = model.opt.timestep * np.arange(steps + 1), np.eye(w.shape[1]), np.zeros(w.shape[1])
    twin = Twin(mjcf=text, to_x=eye, to_x_offset=none, to_sim=eye[None], to_sim_offset=none[None])
    problem = SimpleNamespace(appearance=appearance, dynamics=SimpleNamespace(nx=w.shape[1]))
    plan = Plan(
        t=t[::steps], xs=w[::steps], us=np.zeros((1, 0)), K=np.zeros((1, 0, w.shape[1])), cost=0.0, gradient_norm=0.0,
        status=Status.CONVERGED, history=(), problem=problem, twin=twin,
    )  # fmt: skip
    return Replay(
        plan=plan, compiled=CompiledTwin(twin), feedback=False, integrator="EULER", t=t, qpos=w[:, : model.nq],
        qvel=w[:, model.nq :], act=np.zeros((steps + 1, 0)), ctrl=np.zeros((steps, 0)), xs=w, plan_xs=w,
        contact_force=recorder.force, contact_point=recorder.point, substeps=steps, contacts=recorder.history(t),
    )  # fmt: skip
