"""Machines beside things that their plans do not know: drawn by a generator, each with a way that meets them or not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import planner
from corpus.machines import number
from planner import FunctionDynamics, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics.quasi_static import quasi_static_controls

Rng = np.random.Generator
N = 50


def reach(
    text: str, goal: Any, *, seconds: float = 1.0, prescribed: tuple[str, ...] = (), final: np.ndarray | None = None,
    **reading: Any,
) -> Plan:  # fmt: skip
    """From rest at home to rest at joints' positions; `final` are weights of the end in place of the usual."""
    m = Mechanism.from_mjcf(text, **reading)
    d = RigidBodyDynamics(m, seconds / N, prescribed=prescribed)
    there = np.concatenate([np.atleast_1d(goal), np.zeros(m.nv)])
    cost = TrackingCost.joints(d, there, N, effort=1e-3, final_position=1e3, final_velocity=1e2)
    if final is not None:
        cost = TrackingCost(np.concatenate([cost.Q[:-1], final[None]]), cost.R, cost.x_ref, cost.u_ref)
    us = None if prescribed else np.tile(quasi_static_controls(m, m.home), (N, 1))
    return planner.solve(Problem(d, cost, m.home, us=us))


class Beside(NamedTuple):
    """A kind of machine: a text, a goal that meets what is beside it, one that does not, and how it is asked for."""

    text: str
    into: list[float]
    away: list[float]
    options: dict[str, Any]


def walled(rng: Rng, joint: str = "") -> Beside:
    """An arm that turns about the vertical, and a wall."""
    length, angle = rng.uniform(0.3, 2.0), rng.uniform(0.5, 1.1) * rng.choice([-1.0, 1.0])
    at = 0.8 * length * np.array([np.cos(angle), np.sin(angle)])
    x, y, size = (number(value) for value in (*at, rng.uniform(0.05, 0.1) * length))
    text = (
        f'<mujoco><worldbody><geom name="wall" type="box" size="{size} {size} 1" pos="{x} {y} 0"/><body>'
        f'<joint name="hinge" axis="0 0 1" damping="{number(rng.uniform(0.05, 0.3))}" {joint}/><geom name="arm" '
        f'type="capsule" fromto="{number(0.2 * length)} 0 0 {number(length)} 0 0" size="{number(0.02 * length)}" '
        f'mass="{number(rng.uniform(0.3, 3.0))}"/><site name="tip" pos="{number(length)} 0 0"/></body></worldbody>'
        '<actuator><motor joint="hinge"/></actuator></mujoco>'
    )
    return Beside(text, [angle + 0.6 * np.sign(angle)], [-angle], {"contacts": "off"})


def lying(rng: Rng, low: float, high: float, margin: str = "") -> Beside:
    """An arm on a slide that lies over a table, at a gap between two lengths, m; negative inside."""
    gap, radius, way = rng.uniform(low, high), rng.uniform(0.01, 0.05), rng.uniform(0.05, 0.3)
    text = (
        '<mujoco><worldbody><geom name="table" type="box" size="1 1 .2" '
        f'pos="1 0 {number(-0.2 - radius - gap)}" {margin}/>'
        '<body name="lift"><joint name="lift" type="slide" axis="0 0 1"/><geom name="arm" type="capsule" '
        f'fromto=".2 0 0 1 0 0" size="{number(radius)}" mass="{number(rng.uniform(0.3, 3.0))}" {margin}/></body>'
        '</worldbody><actuator><motor joint="lift"/></actuator></mujoco>'
    )
    return Beside(text, [-way], [way], {"contacts": "off"})


def fingers(rng: Rng) -> Beside:
    """Two fingers that start closed: from a tenth of a millimetre apart to a millimetre in each other."""
    half, gap, way = rng.uniform(0.02, 0.1), rng.uniform(-1e-3, 1e-4), rng.uniform(0.05, 0.2)
    bodies = "".join(
        f'<body pos="0 {number(sign * (half + 0.5 * gap))} 0"><joint name="{name}" type="slide" axis="0 1 0"/>'
        f'<geom name="finger {name}" type="box" size=".1 {number(half)} .1" '
        f'mass="{number(rng.uniform(0.1, 1.0))}"/></body>'
        for name, sign in (("left", 1.0), ("right", -1.0))
    )
    text = (
        f'<mujoco><option gravity="0 0 0"/><worldbody>{bodies}</worldbody><actuator><motor joint="left"/>'
        '<motor joint="right"/></actuator></mujoco>'
    )
    return Beside(text, [-way, way], [way, -way], {"contacts": "off"})


def carried(rng: Rng) -> Beside:
    """A cart whose acceleration is prescribed, with a pole, and a wall on its rail."""
    side, at = rng.choice([-1.0, 1.0]), rng.uniform(0.3, 0.8)
    text = (
        f'<mujoco><worldbody><geom name="wall" type="box" size=".05 1 .2" pos="{number(side * at)} 0 .6"/>'
        '<body pos="0 0 .5"><joint name="rail" type="slide" axis="1 0 0"/><geom name="cart" type="box" size=".1 .1 .1" '
        'mass="1"/><body><joint name="pole" axis="0 1 0" damping=".1"/><geom type="capsule" size=".01" mass=".2" '
        f'fromto="0 0 -.15 0 0 {number(-rng.uniform(0.3, 0.5))}"/></body></body></worldbody>'
        '<actuator><motor joint="pole"/></actuator></mujoco>'
    )
    options = {"contacts": "off", "prescribed": ("rail",)}
    return Beside(text, [side * (at + 0.4), 0.0], [-side * 0.5, 0.0], options)


def loaded(rng: Rng) -> Beside:
    """An arm whose payload reaches as far as a wall that its links do not meet."""
    kind = walled(rng)
    model = Mechanism.from_mjcf(kind.text, contacts="off")
    length = float(model.sites["tip"].T[0, 3])
    angle = float(kind.into[0] - 0.6 * np.sign(kind.into[0]))
    at = 1.25 * length * np.array([np.cos(angle), np.sin(angle)])
    head, _, tail = kind.text.partition("pos=")
    text = f'{head}pos="{number(at[0])} {number(at[1])} 0"{tail.partition("/>")[1]}{tail.partition("/>")[2]}'
    edge = number(0.7 * length)
    payload = {"frame": "tip", "mass": rng.uniform(0.1, 1.0), "size": [float(edge), 0.1 * length, 0.1 * length]}
    return kind._replace(text=text, options={"attach": payload})


def coupled(rng: Rng, soft: str) -> Beside:
    """Two rods whose second joint turns against the first, by an equality of the file."""
    length, mass = rng.uniform(0.3, 0.8), rng.uniform(0.5, 2.0)
    rod = f'<geom type="capsule" fromto="0 0 0 {number(length)} 0 0" size=".02" mass="{number(mass)}"/>'
    text = (
        f'<mujoco><worldbody><body><joint name="a" axis="0 1 0" damping=".1"/>{rod}<body pos="{number(length)} 0 0">'
        f'<joint name="b" axis="0 1 0" damping=".1"/>{rod}</body></body></worldbody><equality><joint joint1="b" '
        f'joint2="a" polycoef="0 -1 0 0 0" {soft}/></equality><actuator><motor joint="a"/></actuator></mujoco>'
    )
    way = rng.uniform(0.6, 1.0) * rng.choice([-1.0, 1.0])
    return Beside(text, [way, -way], [way, -way], {})


def own_python(kind: Beside, goal: list[float], **reading: Any) -> Plan:
    """A plan by somebody's own equation of a hinge, with a twin of the file that a mechanism was read from."""
    mechanism = Mechanism.from_mjcf(kind.text, **reading)
    inertia = float(planner.dynamics.mass_matrix(mechanism, np.zeros(1))[0, 0])
    damping = float(mechanism.damping[0])

    def rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 1], (u[..., 0] - damping * x[..., 1]) / inertia], axis=-1)

    dynamics = FunctionDynamics(rate, 2, 1, 1.0 / N, "rk4")
    cost = TrackingCost.reach([*goal, 0.0], N, final=1e3, effort=1e-3, dt=1.0 / N)
    return planner.solve(Problem(dynamics, cost, [0.0, 0.0], twin=planner.Twin.of(mechanism)))


def siblings(
    add: Callable[[str, Callable[[Rng], Any]], Any], name: str, make: Callable[[Rng], Any], count: int
) -> None:
    """Add as many members of a kind, each drawn by a generator of its own."""
    for k in range(1, count + 1):
        add(f"{name}, {k}", make)
