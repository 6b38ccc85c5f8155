"""Right plans: machines and motions of many kinds, drawn by a seed, each a plan that is solved with ordinary settings."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import planner
from corpus import machines
from corpus.machines import arm, between, cart, gantry
from planner import FrameCost, Limits, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost, cases
from planner.contact import ContactLaw
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.kinematics import frame_pose
from planner.problem.costs.frame import quaternion_of
from planner.problem.guess import holding_controls

Rng = np.random.Generator
MEMBERS: dict[str, Callable[[Rng], Plan]] = {}


def member(name: str, *arguments: Any, **options: Any) -> Callable:
    """A member of the corpus: a function of a generator that makes a plan, with arguments of its own."""

    def add(make: Callable) -> Callable:
        MEMBERS[name] = partial(_called, make, arguments, options)
        return make

    return add


def _called(make: Callable, arguments: tuple, options: dict, rng: Rng) -> Plan:
    return make(rng, *arguments, **options)


def plan_of(name: str, seed: int) -> Plan:
    """The plan of a member; the same seed draws the same machine, whatever other members there are."""
    return MEMBERS[name](np.random.default_rng([seed, *name.encode()]))


def reach(
    text: str | Mechanism, goal: Any, *, start: Any = None, duration: float = 1.0, N: int = 100, integrator: str = "rk4",
    effort: float = 1.0, final: float = 1e4, prescribed: tuple[str, ...] = (), guess: Any = None, running: float = 0.0,
    limits: Limits | None = None, tolerance: Any = None, plain: bool = False, contacts: Any = "on",
    more: Callable | None = None,
) -> Problem:  # fmt: skip
    """From rest to rest: goal (nv,) or state (nx,). Efforts and speeds are weighed in the machine's own scale."""
    m = text if isinstance(text, Mechanism) else Mechanism.from_mjcf(text, contacts=contacts)
    dynamics = RigidBodyDynamics(m, duration / N, integrator, prescribed)
    x0, xg = (state(m, x) for x in (start, goal))
    way = np.maximum(np.abs(m.space.difference(xg, x0))[: m.nv], 0.1 if plain else 1e-3)
    way = np.maximum(way, 0.1 * way.max())
    inertia = np.diag(mass_matrix(m, x0[: m.nq]))
    typical = np.maximum(np.abs(m.actuators.moment * m.actuators.gain[:, None]), 1e-12)  # (nu, nv) force per control
    moved = np.abs(m.actuators.moment) > 0
    needed = inertia * way / duration**2 * 8.0
    scale = np.array([np.max(needed[on] / typical[a, on], initial=1e-12) for a, on in enumerate(moved)])
    scale = np.concatenate([scale, np.repeat(np.max(way) / duration**2 * 8.0, dynamics.nu - m.nu)])
    weights = effort * (np.ones(dynamics.nu) if plain else 1.0 / scale**2) / duration
    rate = way / duration
    cost = TrackingCost.joints(
        dynamics, xg, N, effort=weights, final_position=final * (1.0 if plain else 1.0 / way**2),
        final_velocity=final * (0.1 if plain else 0.1 / rate**2), velocity=running / rate**2 / duration,
    )  # fmt: skip
    whole = cost if more is None else cost + more(dynamics)
    if guess is None and not prescribed and not m.na:  # what holds the start, as far as the motors can
        guess = holding_controls(m, x0)
    us = None if guess is None else np.broadcast_to(guess, (N, dynamics.nu)).copy()
    return Problem(dynamics, whole, x0, us=us, horizon=N, limits=limits, tolerance=tolerance)


def state(m: Mechanism, x: Any) -> np.ndarray:
    """(nx,) of a state, of positions (nv,) as a move from home, or of None for home."""
    if x is None:
        return m.home.copy()
    x = np.asarray(x, dtype=float)
    return x.copy() if len(x) == m.space.nx and m.space.nx != m.nv else m.space.integrate(
        m.home, np.concatenate([x, np.zeros(m.space.ndx - len(x))])
    )  # fmt: skip


def turned(rng: Rng, joints: int, most: float = 1.2) -> np.ndarray:
    """Angles of 0.3 to `most` either way."""
    return rng.uniform(0.3, most, joints) * rng.choice([-1.0, 1.0], joints)


def again(plan: Plan) -> Plan:
    """The plan saved and loaded."""
    with tempfile.TemporaryDirectory() as folder:
        return planner.load_plan(plan.save(Path(folder) / "plan.npz"))


# Arms


@member("a planar arm of 1 joint", 1)
@member("a planar arm of 2 joints", 2)
@member("a planar arm of 3 joints", 3)
@member("a planar arm of 5 joints", 5)
@member("a spatial arm of 3 joints", 3, spatial=True)
@member("a spatial arm of 4 joints", 4, spatial=True)
@member("a spatial arm of 6 joints", 6, spatial=True)
@member("a spatial arm of 7 joints", 7, spatial=True)
@member("a light arm of 1 cm", 2, size=(0.01, 0.001))
@member("an arm of 1 cm, three joints", 3, size=(0.01, 0.003), spatial=True)
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
    scale = {"damping": 0.3 / duration, "armature": 0.1, "stiffness": 5.0}
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


def placed(m: Mechanism, start: np.ndarray, final: float = 1e3, **target: Any) -> Problem:
    """A hand that is to be somewhere, at rest."""
    dynamics = RigidBodyDynamics(m, 0.01)
    still = TrackingCost.joints(dynamics, m.home, 100, effort=0.001, final_velocity=10.0)
    there = FrameCost(dynamics, "hand", **target, **{f"final_{name}_weight": final for name in target})
    return Problem(dynamics, still + there, start, us=np.tile(holding_controls(m, start), (100, 1)))


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


# Swings


@member("a pendulum swung up")
@member("a pendulum swung up by a weak motor", most=0.35)
def pendulum(rng: Rng, most: float | None = None) -> Plan:
    mass, length = between(rng, 0.2, 5.0), between(rng, 0.2, 1.5)
    torque = mass * 9.81 * length / 2
    limits = None if most is None else Limits(control=most * torque)
    duration = (2.0 if most is None else 4.5) * length**0.5
    t = np.linspace(0.0, 1.0, 150)[:, None]
    guess = 0.2 * torque * np.sin(2 * np.pi * duration * 0.6 / length**0.5 * t)
    text = arm(rng, 1, mass=mass, length=length)
    down = np.array([-np.pi / 2, 0.0])
    return planner.solve(
        reach(text, [np.pi / 2, 0.0], start=down, duration=duration, N=150, limits=limits, guess=guess, effort=0.01)
    )


@member("a cart swings its pole up")
@member("a cart swings its pole up on a short rail", limits={"control": 30.0, "position": {"rail": (-1.2, 1.2)}})
@member("a small cart swings its pole up", scale=0.05)
def cart_pole(rng: Rng, limits: dict | None = None, scale: float = 1.0) -> Plan:
    text, duration = cart(rng, scale=scale, damping=0.0), 2.0 * scale**0.5
    t = np.linspace(0.0, 1.0, 120)[:, None]
    guess = 2.0 * scale**3 * np.sin(6.0 * t)
    return planner.solve(
        reach(text, [0.0, np.pi, 0.0, 0.0], duration=duration, N=120, guess=guess, effort=1.0,
              limits=None if limits is None else Limits(**limits))
    )  # fmt: skip


@member("a cart moves its hanging pole")
@member("a cart moves two hanging poles", poles=2)
@member("a cart moves its hanging pole for ten seconds", duration=10.0)
def crane(rng: Rng, poles: int = 1, duration: float = 3.0) -> Plan:
    goal = np.array([1.0, *[0.0] * (2 * poles + 1)])
    return planner.solve(reach(cart(rng, poles, damping=0.01), goal, duration=duration, N=200))


@member("a case: the two-link arm", cases.two_link)
@member("a case: the acrobot", cases.acrobot)
@member("a case: the acrobot from hanging", cases.acrobot, start="hanging")
@member("a case: the puma", cases.puma)
def case(rng: Rng, make: Callable[..., Problem], **options: Any) -> Plan:
    return planner.solve(make(**options))


@member("an acrobot of other masses")
def acrobot(rng: Rng) -> Plan:
    masses = {"mass1": rng.uniform(0.45, 0.55), "mass2": rng.uniform(0.45, 0.55)}
    return planner.solve(cases.acrobot(**masses), max_iterations=3000)


@member("a double pendulum swung about", 3.0)
@member("a double pendulum swung about for ten seconds", 10.0)
def chaotic(rng: Rng, duration: float) -> Plan:
    """Its shoulder follows a swing, its second rod goes where that takes it."""
    m = Mechanism.from_mjcf(arm(rng, 2, driven=(0,), joint=lambda i: 'damping="0.01"'))
    N = round(100 * duration)
    dynamics, t = RigidBodyDynamics(m, 0.01), 0.01 * np.arange(N + 1)
    reference = np.zeros((N + 1, 4))
    reference[:, 0], reference[:, 2] = -np.pi / 2 + np.sin(3.0 * t), 3.0 * np.cos(3.0 * t)
    cost = TrackingCost.joints(dynamics, None, N, reference=reference, position={"j0": 10.0}, velocity={"j0": 1.0},
                               effort=0.1)  # fmt: skip
    return planner.solve(Problem(dynamics, cost, np.array([-np.pi / 2, rng.uniform(0.5, 1.0), 0.0, 0.0])))


# Other trees


@member("a gantry with a load")
@member("a gantry with springs", more='stiffness="20" springref="0.2"')
def gantries(rng: Rng, more: str = "") -> Plan:
    return planner.solve(reach(gantry(rng, more=more), [1.0, -0.7, 0.4, 0.0], duration=2.0))


@member("a branched tree")
@member("a branched tree in gravity", gravity="0 0 -9.81")
@member("a branched tree with balls", balls=True)
@member("a floating tree", free=True)
@member("a floating tree with balls", free=True, balls=True)
def trees(rng: Rng, **options: Any) -> Plan:
    m = Mechanism.from_mjcf(machines.tree(rng, **options))
    goal = 0.6 * rng.uniform(-1.0, 1.0, m.nv)
    tolerance = None
    if options.get("free"):
        goal[:6], tolerance = 0.0, "soft"  # the trunk cannot be moved as one likes
        x = m.space.integrate(m.home, np.concatenate([goal, np.zeros(m.nv)]))
        dynamics = RigidBodyDynamics(m, 0.01)
        inertia = np.diag(mass_matrix(m, m.home[: m.nq])).min()
        p = np.concatenate([np.zeros(6), np.ones(m.nv - 6)])
        cost = TrackingCost.joints(dynamics, x, 100, effort=0.01 / inertia**2, final_position=1e3 * p,
                                   final_velocity=1e2 * p)  # fmt: skip
        return planner.solve(Problem(dynamics, cost, m.home, tolerance=tolerance))
    return planner.solve(reach(m, goal, tolerance=tolerance))


# Steps


@member("semi-implicit Euler in small steps", "semi-implicit-euler", 2000)
@member("Euler in small steps", "euler", 4000)
def eulers(rng: Rng, integrator: str, N: int) -> Plan:
    return planner.solve(reach(arm(rng, 1, joint=lambda i: 'damping="0.3"'), [0.8], N=N, integrator=integrator))


@member("a stiff joint", 10.0)
@member("a very stiff joint", 25.0)
def stiff(rng: Rng, rate: float) -> Plan:
    """A damper on the end of an arm: its rate, 1/s, is that of the last rod held at its joint, and four times that free."""
    text = arm(rng, 2, gravity="0 0 0", joint=lambda i: f'damping="{machines.number(rate * 0.0417)}"' if i else "")
    return planner.solve(reach(text, turned(rng, 2)))


# Contact


@member("a ball that lands and is pushed along")
@member("a heavy ball that lands and is pushed along", 20.0)
def bounced(rng: Rng, mass: float = 1.0, depth: float = 0.3) -> Plan:
    text = machines.ball_on_floor(rng, mass)
    law = ContactLaw.resting(mass, sink=0.01, friction=0.5)
    m = Mechanism.from_mjcf(text, contacts=law)
    return planner.solve(reach(m, [0.5, -depth], duration=1.0, N=200, tolerance="soft", final=100.0))


@member("a ball that stays above the floor it knows")
def hovering(rng: Rng) -> Plan:
    m = Mechanism.from_mjcf(machines.ball_on_floor(rng, 1.0), contacts=ContactLaw.resting(1.0))
    return planner.solve(reach(m, [0.5, 0.3], duration=1.0))


@member("a ball pushes another")
def pushed(rng: Rng) -> Plan:
    mass = between(rng, 0.2, 5.0)
    m = Mechanism.from_mjcf(machines.pusher(rng, mass), contacts=ContactLaw.resting(mass, sink=0.01, friction=0.0))
    problem = reach(m, [0.5, 0.3, 0.0, 0.0], duration=1.5, N=300, tolerance="soft", final=10.0)
    return planner.solve(replace(problem, us=np.full((300, 1), 0.5 * mass)), gain_tolerance=1e-6)


# Other ways of asking


@member("the exact Hessian", hessian="exact")
@member("the open-loop update", update="open-loop")
@member("one of three starts", starts=3, seed=4)
def ways(rng: Rng, **options: Any) -> Plan:
    return planner.solve(reach(arm(rng, 2), turned(rng, 2)), **options)


@member("the shortest way in time")
def timed(rng: Rng) -> Plan:
    problem = reach(arm(rng, 1, gravity="0 0 0"), [0.8], N=60, limits=Limits(control=1.0, final="exact"))
    return planner.solve_for(problem, {"time": 1.0, "effort": 0.01}, durations=(0.5, 3.0))


@member("a way of little jerk")
def jerked(rng: Rng) -> Plan:
    problem = reach(arm(rng, 2, gravity="0 0 0"), turned(rng, 2), final=1e7)
    return planner.solve(planner.costs.with_objective(problem, {"jerk": 1.0}))
