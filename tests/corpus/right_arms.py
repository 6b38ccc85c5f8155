"""Right plans of arms: of all sizes, with all kinds of motors, limits and goals."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import planner
from corpus import machines
from corpus.asking import Rng, again, member, placed, reach, state, turned
from corpus.machines import arm, between
from planner import Limits, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics.kinematics import frame_pose
from planner.problem.costs.residual_functions import quaternion_of


@member("a planar arm of 1 joint", 1)
@member("a planar arm of 2 joints", 2)
@member("a planar arm of 3 joints", 3)
@member("a planar arm of 5 joints", 5)
@member("a spatial arm of 3 joints", 3, spatial=True)
@member("a spatial arm of 4 joints", 4, spatial=True)
@member("a spatial arm of 6 joints", 6, spatial=True)
@member("a spatial arm of 7 joints", 7, spatial=True)
@member("a light arm of 1 cm", 2, size=(0.01, 0.001))
@member("an arm of 1 cm, three joints", 3, size=(0.01, 0.003), spatial=True, stages=200, joint='damping="{damping}"')
@member("an arm of 10 cm, four joints", 4, size=(0.1, 0.05), spatial=True)
@member("an arm of 3 m and 100 kg", 3, size=(3.0, 100.0))
@member("a spatial arm of 3 m and 100 kg", 6, size=(3.0, 100.0), spatial=True)
@member("an arm in plain weights", 3, plain=True)
@member("an arm of 10 cm in plain weights", 2, plain=True, size=(0.1, 0.1))
@member("an arm in many stages", 2, stages=400)
@member("an arm in coarse stages", 2, stages=25)
@member("an arm with friction of its bearings", 3, joint='damping="{damping}"')
@member("an arm with rotors", 3, joint='armature="{armature}"')
@member("an arm with springs", 2, joint='stiffness="{stiffness}" springref="0.3"')
def moved_arm(
    rng: Rng, joints: int, *, size: tuple[float, float] | None = None, spatial: bool = False, plain: bool = False,
    stages: int = 100, joint: str = "",
) -> Plan:  # fmt: skip
    length, mass = size or (between(rng, 0.2, 2.0), between(rng, 0.1, 30.0))
    duration = between(rng, 0.6, 1.5) * max(length, 0.05) ** 0.5  # as the swing of a pendulum
    scale = {"damping": 0.03 / duration, "armature": 0.1, "stiffness": 5.0}
    if joints > 3:  # rods without rotors would fold up at once
        joint += ' damping="{damping}" armature="{armature}"'
    attributes = joint.format(**{k: machines.number(s * mass * length**2) for k, s in scale.items()})
    text = arm(rng, joints, length=length, mass=mass, spatial=spatial, joint=lambda i: attributes)
    return planner.solve(reach(text, turned(rng, joints), duration=duration, N=stages, plain=plain))


@member("an arm that starts in motion")
def moving_start(rng: Rng) -> Plan:
    x0 = rng.uniform(-1.0, 1.0, 4)
    return planner.solve(reach(arm(rng, 2, joint=lambda i: 'damping="0.3"'), [1.0, -1.0], start=x0))


@member("an arm for ten seconds", 2)
@member("an arm in weightlessness for ten seconds", 3, gravity="0 0 0")
def slow(rng: Rng, joints: int, gravity: str = "0 0 -9.81") -> Plan:
    damped = 'damping="0.3" armature="0.1"'
    m = Mechanism.from_mjcf(arm(rng, joints, gravity=gravity, joint=lambda i: damped))
    return planner.solve(
        reach(m, turned(rng, joints), start=np.full(joints, -0.5), duration=10.0, N=400, running=1.0, final=1e6)
    )


@member("an arm in tilted gravity")
def tilted(rng: Rng) -> Plan:
    return planner.solve(reach(arm(rng, 3, spatial=True, gravity="1.5 -2 -9"), turned(rng, 3)))


@member("an arm whose motors have gears")
def geared(rng: Rng) -> Plan:
    text = arm(rng, 2, actuator=lambda i: f'<motor name="m{i}" joint="j{i}" gear="{-60 + 150 * i}"/>')
    return planner.solve(reach(text, turned(rng, 2)))


SERVO = (
    '<general name="m{i}" joint="j{i}" gainprm="{k}" biastype="affine" biasprm="0 -{k} -{d}" {more}/>'
)  # fmt: skip


def servo(i: int, k: float = 30.0, d: float = 2.0, more: str = "") -> str:
    return SERVO.format(i=i, k=k, d=d, more=more)


@member("an arm of position servos")
@member("an arm of stiff servos", k=200.0, d=5.0, final=1e6)
@member("an arm of servos within their clamps", more='forcerange="-200 200" ctrlrange="-6 6"')
def servos(rng: Rng, k: float = 30.0, d: float = 2.0, more: str = "", final: float = 1e4) -> Plan:
    text = arm(rng, 2, actuator=lambda i: servo(i, k, d, more), joint=lambda i: 'armature="0.05"')
    return planner.solve(reach(text, turned(rng, 2), final=final))


@member("an arm whose motors lag", 'dyntype="filter" dynprm="0.05"')
@member("an arm of integrated motors", 'dyntype="integrator"')
def activated(rng: Rng, kind: str) -> Plan:
    text = arm(rng, 2, actuator=lambda i: f'<general name="m{i}" joint="j{i}" gainprm="5" {kind}/>')
    return planner.solve(reach(text, turned(rng, 2)))


@member("an arm within the ranges of its motors")
def bounded(rng: Rng) -> Plan:
    limits = Limits(control="model")
    text = arm(rng, 2, actuator=lambda i: f'<motor name="m{i}" joint="j{i}" ctrlrange="-14 14"/>')
    return planner.solve(reach(text, [0.8, -0.8], duration=1.0, limits=limits))


@member("an arm within ranges of its joints", position={"j1": (-0.5, 0.6)})
@member("an arm within a limit of its speed", velocity={"j0": 1.0})
@member("an arm to an exact end", final="exact")
def limited(rng: Rng, **limits: Any) -> Plan:
    return planner.solve(reach(arm(rng, 2), [0.8, 0.55], limits=Limits(**limits)))


@member("an arm at the stops of its file")
def stopped(rng: Rng) -> Plan:
    text = arm(rng, 2, joint=lambda i: 'range="-1 0.9"' if i else "")
    return planner.solve(reach(text, [1.2, 0.85], start=[0.0, -0.9], limits=Limits(position="model")))


@member("an arm with exact goals within limits")
def exact_within(rng: Rng) -> Plan:
    limits = Limits(control=15.0, velocity=3.0, final="exact")
    return planner.solve(reach(arm(rng, 2), [0.6, 0.6], duration=1.2, limits=limits))


@member("an arm whose base is driven as told", ("j0",))
@member("an arm of joints driven as told", ("j0", "j2"))
def prescribed(rng: Rng, names: tuple[str, ...]) -> Plan:
    return planner.solve(reach(arm(rng, 3), turned(rng, 3), prescribed=names))


@member("a hand to a place", "position")
@member("a hand to a direction", "orientation")
@member("a hand to a place and a direction", "position", "orientation")
def hand(rng: Rng, *targets: str) -> Plan:
    """Where it is in a pose that the arm can take."""
    m, start, pose = _reaching(rng)
    T = frame_pose(m, pose[None, : m.nq], m.frame("hand"))[0]
    there = {"position": T[:3, 3], "orientation": quaternion_of(T[None, :3, :3])[0]}
    return planner.solve(placed(m, start, **{name: there[name] for name in targets}))


def _reaching(rng: Rng) -> tuple[Mechanism, np.ndarray, np.ndarray]:
    """An arm of six joints, a start and another pose."""
    m = Mechanism.from_mjcf(arm(rng, 6, spatial=True, joint=lambda i: 'damping="0.3" armature="0.1"'))
    start = state(m, np.full(6, 0.4))
    return m, start, m.space.integrate(start, np.concatenate([rng.uniform(-0.4, 0.4, 6), np.zeros(6)]))


@member("a soft goal")
def soft(rng: Rng) -> Plan:
    return planner.solve(reach(arm(rng, 2), turned(rng, 2), final=0.5, tolerance="soft"))


@member("a goal in a velocity alone")
def thrown(rng: Rng) -> Plan:
    m = Mechanism.from_mjcf(arm(rng, 2))
    dynamics = RigidBodyDynamics(m, 0.01)
    cost = TrackingCost.joints(dynamics, [0, 0, 2.0, -3.0], 80, effort=0.01, final_velocity=1e3)
    return planner.solve(Problem(dynamics, cost, np.zeros(4)))


@member("a motion to be followed")
def followed(rng: Rng) -> Plan:
    m = Mechanism.from_mjcf(arm(rng, 2))
    dynamics, t = RigidBodyDynamics(m, 0.01), 0.01 * np.arange(151)
    turn = np.stack([0.5 * np.sin(2 * t), 0.4 * (1 - np.cos(3 * t)), np.cos(2 * t), 1.2 * np.sin(3 * t)], axis=1)
    cost = TrackingCost.joints(dynamics, None, 150, reference=turn, position=1e3, velocity=10.0, effort=0.001,
                               final_position=1e3)  # fmt: skip
    return planner.solve(Problem(dynamics, cost, turn[0]))


@member("an arm that is to stay hanging", np.array([-np.pi / 2, 0.0]))
@member("an arm that is to stay stretched out", np.array([0.0, 0.0]))
@member("an arm that is to stay upright", np.array([np.pi / 2, 0.0]))
def held(rng: Rng, pose: np.ndarray) -> Plan:
    m = Mechanism.from_mjcf(arm(rng, 2))
    x = state(m, pose)
    x[m.nq :] = 0.0
    return planner.solve(reach(m, x, start=x))


@member("an arm that is to stay, from no controls")
def held_from_nothing(rng: Rng) -> Plan:
    x = np.array([0.3, 0.4, 0.0, 0.0])
    return planner.solve(reach(arm(rng, 2), x, start=x, guess=0.0))


@member("an arm saved and loaded")
def stored(rng: Rng) -> Plan:
    return again(moved_arm(rng, 2))


@member("an arm within limits, saved and loaded")
def stored_within(rng: Rng) -> Plan:
    return again(bounded(rng))


WALL = '<geom name="wall" type="box" size="0.1 0.1 0.1" pos="-1.5 0 0"/>'
CAPSULE = '<geom type="capsule" fromto="0 0 0 {length} 0 0" size="{size}"/>'


@member("contacts left out and never touched")
@member("contacts left out and never touched, loaded", stored=True)
def clear(rng: Rng, stored: bool = False) -> Plan:
    plan = planner.solve(reach(arm(rng, 2, more=WALL, shapes=CAPSULE), [0.9, -0.9], contacts="off"))
    return again(plan) if stored else plan


@member("friction loss left out of a strong servo")
def without_loss(rng: Rng) -> Plan:
    text = arm(rng, 1, joint=lambda i: 'frictionloss="0.0005"')
    return planner.solve(reach(Mechanism.from_mjcf(text, ignore=("frictionloss",)), [0.8]))


@member("a model with defaults and classes")
def defaults(rng: Rng) -> Plan:
    head = '<default><joint damping="0.2" armature="0.01"/><motor gear="5"/><default class="x"/></default>'
    return planner.solve(reach(arm(rng, 3, head=head), turned(rng, 3)))


@member("a model in several files")
def included(rng: Rng) -> Plan:
    text = arm(rng, 2)
    start, end = text.index("<actuator>"), text.index("</actuator>") + len("</actuator>")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "motors.xml").write_text(f"<mujoco>{text[start:end]}</mujoco>")
        main = Path(folder) / "arm.xml"
        main.write_text(text[:start] + '<include file="motors.xml"/>' + text[end:])
        return planner.solve(reach(Mechanism.from_mjcf(main), turned(rng, 2)))
