"""The mechanisms of rigid_body.py as chains of joints, and the MJCF text of a chain. NumPy only.

A chain is what both sides are built from: {"gravity": (3,), "joints": [joint, ...]} with the joints depth first, and a
joint is {"name", "parent" (its number from 1, 0 for the world), "type" (RX, RY, RZ a hinge about that axis, PX a slide
along x, FF a free base), "R" (3, 3) and "p" (3,) (pose in the parent's frame), "mass", "com", "inertia" (3, 3) about
the centre of mass, "armature"}. It is plain JSON, so that a peer in another environment builds its own model from it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

Chain = dict[str, Any]
GRAVITY = 9.81
AXES = {"PX": (1.0, 0.0, 0.0), "RX": (1.0, 0.0, 0.0), "RY": (0.0, 1.0, 0.0), "RZ": (0.0, 0.0, 1.0)}


def _joint(
    name: str, parent: int, kind: str, p: Any, mass: float, com: Any, inertia: Any, R: Any = None, armature: float = 0.0
) -> dict[str, Any]:
    return {
        "name": name, "parent": parent, "type": kind, "R": np.asarray(np.eye(3) if R is None else R, float).tolist(),
        "p": np.asarray(p, float).tolist(), "mass": float(mass), "com": np.asarray(com, float).tolist(),
        "inertia": np.asarray(inertia, float).tolist(), "armature": float(armature),
    }  # fmt: skip


def two_rods() -> Chain:
    """The planar 2R: two uniform rods of 0.5 kg and 1 m, the first angle from the horizontal."""
    mass, length = 0.5, 1.0
    across = mass * length**2 / 12.0
    # MuJoCo refuses a rod of no thickness; about its own axis neither rod ever turns.
    inertia = np.diag([1e-3 * across, across, across])
    joints = [
        _joint(name, parent, "RZ", [length * parent, 0, 0], mass, [0.5 * length, 0, 0], inertia)
        for parent, name in enumerate(("shoulder", "elbow"))
    ]
    return {"gravity": [0.0, -GRAVITY, 0.0], "joints": joints}


def cart_pole() -> Chain:
    """A cart of 1 kg on a rail, and a pole of 0.2 kg and 1 m that hangs from it."""
    mass, length = 0.2, 1.0
    across = mass * length**2 / 12.0
    inertia = np.diag([across, across, 1e-3 * across])
    joints = [
        _joint("cart", 0, "PX", [0, 0, 0], 1.0, [0, 0, 0], 1e-2 * np.eye(3)),
        _joint("pole", 1, "RY", [0, 0, 0], mass, [0, 0, -0.5 * length], inertia),
    ]
    return {"gravity": [0.0, 0.0, -GRAVITY], "joints": joints}


def puma() -> Chain:
    """Six joints like a Puma 560's: lengths, masses and motors as published by Armstrong and by Corke.

    The published third inertia of link 3, 0.0125, is less than a body of its other two can have: it is 0.0225 here.
    """
    offset = [0, 0, 0.15005, 0.4318, 0, 0]
    length = [0, 0.4318, 0.0203, 0, 0, 0]
    twist = np.array([1, 0, -1, 1, -1, 0]) * np.pi / 2
    mass = [13.0, 17.4, 4.8, 0.82, 0.34, 0.09]
    com = [[0, 0, 0], [-0.3638, 0.006, 0.2275], [-0.0203, -0.0141, 0.07], [0, 0.019, 0], [0, 0, 0], [0, 0, 0.032]]
    inertia = [
        [0.35, 0.35, 0.35], [0.13, 0.524, 0.539], [0.066, 0.086, 0.0225], [1.8e-3, 1.3e-3, 1.8e-3],
        [0.3e-3, 0.4e-3, 0.3e-3], [0.15e-3, 0.15e-3, 0.04e-3],
    ]  # fmt: skip
    rotor = np.array([200e-6] * 3 + [33e-6] * 3)
    gear = np.array([62.6111, 107.815, 53.7063, 76.0364, 71.923, 76.686])
    joints, R, p = [], np.eye(3), np.zeros(3)
    for i in range(6):
        # Denavit and Hartenberg place the link's frame behind the joint: every joint turns about its own z.
        c, s = np.cos(twist[i]), np.sin(twist[i])
        link_R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        link_p = np.array([length[i], 0, offset[i]])
        turned, centre = link_R @ np.diag(inertia[i]) @ link_R.T, link_R @ com[i] + link_p
        joints.append(_joint(f"joint{i + 1}", i, "RZ", p, mass[i], centre, turned, R, rotor[i] * gear[i] ** 2))
        R, p = link_R, link_p
    return {"gravity": [0.0, 0.0, -GRAVITY], "joints": joints}


def _with_random_bodies(skeleton: list[tuple[int, str, tuple[float, float, float]]], seed: int) -> Chain:
    """Links of 0.8 to 4 kg, none symmetric, on a skeleton of (parent, type, place)."""
    rng = np.random.default_rng(seed)
    joints = []
    for i, (parent, kind, p) in enumerate(skeleton):
        mass, com, L = rng.uniform(0.8, 4.0), rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.1, 0.1, (3, 3))
        joints.append(_joint(f"joint{i + 1}", parent, kind, p, mass, com, L @ L.T + 0.05 * np.eye(3)))
    return {"gravity": [0.0, 0.0, -GRAVITY], "joints": joints}


def arm7() -> Chain:
    """A serial arm of seven joints about z and y in turn."""
    skeleton = [(i, "RZ" if i % 2 == 0 else "RY", (0.0, 0.02 * (i % 2), 0.2)) for i in range(7)]
    return _with_random_bodies(skeleton, seed=7)


def tree24() -> Chain:
    """A tree of 24 joints: a waist of 3 with a neck, two arms of 4 on it, two legs of 6 on its first joint."""
    skeleton = [(0, "RZ", (0, 0, 1.0)), (1, "RY", (0, 0, 0.1)), (2, "RX", (0, 0, 0.1)), (3, "RZ", (0, 0, 0.5))]
    arm = ("RY", "RX", "RZ", "RY"), ((0, 0.2, 0.4), (0, 0.05, 0), (0, 0, -0.15), (0, 0, -0.2))
    leg = (
        ("RZ", "RX", "RY", "RY", "RY", "RX"),
        ((0, 0.1, -0.1), (0, 0, -0.05), (0, 0, -0.05), (0, 0, -0.4), (0, 0, -0.4), (0, 0, -0.05)),
    )
    for (kinds, places), root in ((arm, 3), (leg, 1)):
        for side in (1, -1):
            parent = root
            for kind, (x, y, z) in zip(kinds, places, strict=True):
                skeleton.append((parent, kind, (x, side * y, z)))
                parent = len(skeleton)
    return _with_random_bodies(skeleton, seed=24)


def humanoid() -> Chain:
    """Pinocchio's sample humanoid on its free base, 28 hinges; see "origin" in humanoid.json."""
    data = json.loads(Path(__file__).with_name("humanoid.json").read_text(encoding="utf-8"))
    turns = {"none": np.eye(3), "x180": np.diag([1.0, -1.0, -1.0]), "y90": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]}
    joints = []
    for name, parent, kind, turn, place, body in data["joints"]:
        b = data["bodies"][body]
        joints.append(_joint(name, parent, kind, place, b["mass"], b["com"], b["inertia"] * np.eye(3), turns[turn]))
    return {"gravity": [0.0, 0.0, -GRAVITY], "joints": joints}


def serial(n: int) -> Chain:
    """A serial chain of n joints about x, y and z in turn, for scaling.py."""
    return _with_random_bodies([(i, ("RX", "RY", "RZ")[i % 3], (0.0, 0.0, 2.0 / n)) for i in range(n)], seed=n)


def random_tree(n: int) -> Chain:
    """A random tree of n joints, for scaling.py; each hangs on the joint before it or on one of its ancestors."""
    rng = np.random.default_rng(n)
    skeleton: list[tuple[int, str, tuple[float, float, float]]] = []
    line: list[int] = [0]  # the last joint and its ancestors: what keeps the order depth first
    for i in range(n):
        if rng.random() < 0.3:
            line = line[: rng.integers(1, len(line) + 1)]
        skeleton.append((line[-1], ("RX", "RY", "RZ")[i % 3], tuple(rng.uniform(-0.3, 0.3, 3).tolist())))
        line.append(i + 1)
    return _with_random_bodies(skeleton, seed=n)


def holding(chain: Chain) -> np.ndarray:
    """Torques (n,) that hold a chain of hinges against gravity where all angles are zero."""
    joints, gravity = chain["joints"], np.array(chain["gravity"])
    R, p = [np.eye(3)], [np.zeros(3)]
    for joint in joints:
        carrier = joint["parent"]
        p.append(p[carrier] + R[carrier] @ joint["p"])
        R.append(R[carrier] @ np.array(joint["R"]))
    torques = np.zeros(len(joints))
    for i, joint in enumerate(joints, start=1):
        weight, at = joint["mass"] * gravity, p[i] + R[i] @ joint["com"]
        while i:
            torques[i - 1] -= (R[i] @ AXES[joints[i - 1]["type"]]) @ np.cross(at - p[i], weight)
            i = joints[i - 1]["parent"]
    return torques


def motorized(chain: Chain) -> list[str]:
    """Names of the joints that can have a motor: all but a free base."""
    return [joint["name"] for joint in chain["joints"] if joint["type"] != "FF"]


def _numbers(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def mjcf(chain: Chain, motors: list[str] | None = None) -> str:
    """MJCF text: one body per joint, no geoms (so nothing can touch), a motor of gear 1 on each joint of `motors`.

    Args:
        chain: The mechanism.
        motors: Names in the order of the controls; by default `motorized`.
    """
    joints = chain["joints"]
    lines = [
        "<mujoco>",
        '  <compiler angle="radian"/>',
        f'  <option gravity="{_numbers(chain["gravity"])}"/>',
        "  <worldbody>",
    ]
    open_bodies: list[int] = []  # from the world to the last joint
    for i, joint in enumerate(joints, start=1):
        while open_bodies and open_bodies[-1] != joint["parent"]:
            open_bodies.pop()
            lines.append("  " * (len(open_bodies) + 2) + "</body>")
        if joint["parent"] and not open_bodies:
            raise ValueError(f"joint {i} hangs on joint {joint['parent']}, expected joints depth first.")
        indent = "  " * (len(open_bodies) + 2)
        x_axis, y_axis = np.array(joint["R"]).T[:2]
        # The six numbers of the full inertia are xx yy zz xy xz yz.
        inertia = np.array(joint["inertia"])[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        kind = "slide" if joint["type"] == "PX" else "hinge"
        motion = (
            f'<freejoint name="{joint["name"]}"/>'
            if joint["type"] == "FF"
            else f'<joint name="{joint["name"]}" type="{kind}" '
            f'axis="{_numbers(AXES[joint["type"]])}" armature="{_numbers(joint["armature"])}"/>'
        )
        lines += [
            f'{indent}<body name="{joint["name"]}" pos="{_numbers(joint["p"])}" xyaxes="{_numbers([x_axis, y_axis])}">',
            f'{indent}  <inertial pos="{_numbers(joint["com"])}" mass="{_numbers(joint["mass"])}" '
            f'fullinertia="{_numbers(inertia)}"/>',
            f"{indent}  {motion}",
        ]
        open_bodies.append(i)
    while open_bodies:
        open_bodies.pop()
        lines.append("  " * (len(open_bodies) + 2) + "</body>")
    lines += ["  </worldbody>", "  <actuator>"]
    lines += [f'    <motor name="{name}" joint="{name}"/>' for name in (motorized(chain) if motors is None else motors)]
    return "\n".join([*lines, "  </actuator>", "</mujoco>", ""])
