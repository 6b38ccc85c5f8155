"""Wrong plans: what happens between the knots, or between two steps of a simulator, and bounds of other joints."""

from dataclasses import replace
from typing import Any

import numpy as np

import planner
from corpus.asking import reach
from corpus.machines import arm, number
from corpus.planting import KNOTS_ONLY, Rng, member
from planner import Follow, Goal, Limits, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics.kinematics import frame_pose

SIBLINGS = 5  # of each kind, with other sizes, masses and times


def siblings(name: str, make: Any) -> None:
    """Members that a generator tells apart."""
    for k in range(SIBLINGS):
        member(f"{name}, {'abcdefgh'[k]}", make)


def _arm(rng: Rng, joints: int = 2, **more: Any) -> Mechanism:
    return Mechanism.from_mjcf(arm(rng, joints, joint=lambda i: 'damping="0.3"', **more))


def coarse_path(rng: Rng) -> Plan:
    """A quarter of a turn in stages of a quarter of a second: the hand cuts the corners of its line."""
    m, N = _arm(rng), int(rng.integers(5, 9))
    T = rng.uniform(0.2, 0.3) * N
    t = np.linspace(0.0, T, 200)
    s = rng.uniform(1.0, 2.0) * (1.0 - np.cos(2.0 * np.pi * t / T))
    x = np.tile(m.home, (200, 1))
    x[:, :2] = np.stack([0.4 + s, -0.8 - 0.7 * s], axis=1)
    points = frame_pose(m, x[:, : m.nq], m.frame("hand"))[:, :3, 3]
    follow = Follow(frame="hand", points=np.column_stack([t, points]).tolist(), tolerance=0.005)
    return planner.solve(planner.task(m, {"j0": 0.4, "j1": -0.8}, follow=follow, duration=float(T), dt=float(T / N)))


siblings("a path that is left between knots", coarse_path)


def wiggle(rng: Rng) -> Plan:
    """A path that goes to and fro between two knots, which are on it."""
    m, dt = _arm(rng), 0.05
    t = np.arange(81) * dt / 4
    x = np.tile(m.home, (81, 1))
    x[:, :2] = [0.4, -0.8]
    x[:, 0] += 0.5 * t
    points = frame_pose(m, x[:, : m.nq], m.frame("hand"))[:, :3, 3]
    points[1::4, 2] += rng.uniform(0.02, 0.08)
    points[3::4, 2] -= rng.uniform(0.02, 0.08)
    follow = Follow(frame="hand", points=np.column_stack([t, points]).tolist(), tolerance=0.005)
    return planner.solve(planner.task(m, {"j0": 0.4, "j1": -0.8}, follow=follow, duration=1.0, dt=dt))


siblings("a path that wiggles between knots", wiggle)


def other_time(rng: Rng) -> Plan:
    """A fast waypoint half a stage beside a knot: at its own time the hand is elsewhere."""
    m, dt = _arm(rng), 0.02
    time = dt * (rng.integers(20, 30) + 0.5)
    at = rng.uniform(0.9, 1.1)
    goals = [Goal(joints={"j0": float(at), "j1": 0.5}, time=float(time), through=True, tolerance=0.004),
             Goal(joints={"j0": 2.2 * float(at), "j1": 0.9}, tolerance=0.01)]  # fmt: skip
    return planner.solve(planner.task(m, {}, goals, duration=1.0, dt=dt))


siblings("a waypoint at a time between knots", other_time)


def through_wire(rng: Rng) -> Plan:
    """A rod sweeps through a wire so thin that no step of the simulator sees the two meet."""
    thin = rng.uniform(0.0004, 0.0008)
    wire = f'<geom name="wire" type="capsule" size="{number(thin)}" fromto="0.6 -0.3 0.553 0.6 0.3 0.553"/>'
    rod = f'<geom type="capsule" fromto="0.1 0 0 {{length}} 0 0" size="{number(thin)}"/>'
    text = arm(rng, 1, more=wire, shapes=rod, gravity="0 0 0")
    return planner.solve(reach(text, [1.6], start=[-0.2], duration=rng.uniform(0.7, 0.9), N=25, contacts="off"))


siblings("a thin rod through a wire", through_wire)


# Bounds that other joints' motions widened


def spindle(rng: Rng) -> Problem:
    """A spindle of some fifty turns beside a hinge that is to come back from its own swing."""
    inertia = '<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>'
    turns = f'<body pos="0 1 0"><joint name="spindle" axis="0 0 1"/>{inertia}</body>'
    motor = '<motor name="ms" joint="spindle"/></actuator>'
    m = Mechanism.from_mjcf(arm(rng, 1, gravity="0 0 0", more=turns).replace("</actuator>", motor))
    dynamics = RigidBodyDynamics(m, 0.25)
    hinge, other = m.joint("j0").start, m.joint("spindle").start
    goal, start = np.zeros(4), np.zeros(4)
    goal[hinge], goal[other] = -1.0, 2.0 * np.pi * rng.uniform(40.0, 60.0)
    start[2 + hinge] = rng.uniform(2.0, 3.0)
    cost = TrackingCost.joints(dynamics, goal, 8, effort=1e-4, final_position=1e4, final_velocity=1e3)
    return Problem(dynamics, cost, start, horizon=8)


def beside_spindle(rng: Rng) -> Plan:
    """The range holds at the knots; between two the hinge leaves it by more than a hundredth of a radian."""
    while True:
        free = spindle(rng)
        hinge = free.dynamics.mechanism.joint("j0").start
        highest = rng.uniform(0.5, 0.95) * float(planner.solve(free).xs[:, hinge].max())
        plan = planner.solve(replace(free, limits=Limits(position={"j0": (-10.0, highest)})), KNOTS_ONLY)
        if plan.between_knots(50)[:, hinge].max() > highest + 0.01:  # exact: its torque is held, nothing else acts
            return plan


siblings("a hinge leaves its range beside a spindle", beside_spindle)


def gantry(rng: Rng) -> Plan:
    """Fifty metres of one axis; the other swings past its limit between knots."""
    text = f"""<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="{number(rng.uniform(1.0, 3.0))}" diaginertia="1 1 1"/>
      <body><joint name="y" type="slide" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
      </body>
      </worldbody><actuator><motor joint="x"/><motor joint="y"/></actuator></mujoco>"""
    speed = rng.uniform(1.5, 2.0)
    free = reach(text, [50.0, -1.0], start=[0.0, 0.0, 0.0, speed], duration=8.0, N=8)
    most = float(planner.solve(free).xs[:, 1].max())
    limits = Limits(position={"y": (-10.0, 0.6 * most)})
    limited = reach(text, [50.0, -1.0], start=[0.0, 0.0, 0.0, speed], duration=8.0, N=8, limits=limits)
    return planner.solve(limited, KNOTS_ONLY)


siblings("a gantry passes its limit between knots", gantry)
