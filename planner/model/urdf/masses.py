"""Check that a robot's masses can move, and say what to write where they cannot.

MuJoCo refuses a moving body without mass or inertia. A link may have none where others that it carries have some:
then it gets LEAST of both, far below the rounding of what it carries. A tensor that no body has is not altered.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.base.errors import ModelError
from planner.model.urdf.robot import SCALAR, Inertial, Joint, Robot

LEAST = 1e-12
"""kg and kg m^2."""
_WATER = 1000.0  # kg/m^3, for a suggestion
_ROUNDING = 1e-9  # of a tensor whose principal moments fulfil the triangle inequality as an equation


def possible(inertial: Inertial, where: str) -> Inertial:
    """The same inertial, with LEAST where it has no mass or inertia about an axis.

    Raises:
        ModelError: No body has this inertia.
    """
    values, axes = np.linalg.eigh(inertial.inertia)
    nearest = _nearest(values)
    if np.max(np.abs(nearest - values)) > _ROUNDING * np.max(np.abs(values)):
        tensor = axes @ np.diag(nearest * (1.0 + 1e-6)) @ axes.T
        raise ModelError(
            f"{where} has the principal moments of inertia {' '.join(f'{v:.4g}' for v in values)} kg m^2, expected "
            f"positive ones of which none exceeds the sum of the others: the nearest is {_written(tensor)}."
        )
    if values[0] < LEAST or inertial.mass < LEAST or not np.array_equal(nearest, values):
        inertia = axes @ np.diag(_nearest(np.maximum(values, 0.0)) + LEAST) @ axes.T
        return replace(inertial, mass=max(inertial.mass, LEAST), inertia=inertia)
    return inertial


def _nearest(values: np.ndarray) -> np.ndarray:
    """The nearest principal moments, ascending, that a body can have."""
    a, b, c = np.maximum(values, 0.0)
    excess = max(0.0, c - a - b) / 3.0
    return np.array([a + excess, b + excess, c - excess])


def _written(tensor: np.ndarray) -> str:
    keys = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    size = np.max(np.abs(tensor))
    entries = {key: tensor[at] if abs(tensor[at]) > 1e-9 * size else 0.0 for key, at in keys.items()}
    return "<inertia " + " ".join(f'{key}="{value:.7g}"' for key, value in entries.items()) + "/>"


def check_moved(robot: Robot, joints: tuple[Joint, ...], name: str) -> None:
    """Raise ModelError for a joint that moves no mass, or turns no inertia, with all that hangs on it."""
    poses = {robot.root: np.eye(4), "": np.eye(4)}  # "" is the world
    for joint in joints:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = joint.pose.rotation, joint.pose.xyz
        poses[joint.child] = poses[joint.parent] @ T
    mass, moment, inertia = {}, {}, {}  # of each link and what hangs on it, about the origin of the root
    for link, T in poses.items():
        given = robot.links[link].inertial if link else None
        body = given or Inertial(0.0, np.zeros(3), np.zeros((3, 3)))
        R, c = T[:3, :3], T[:3, :3] @ body.centre + T[:3, 3]
        mass[link], moment[link] = body.mass, body.mass * c
        inertia[link] = R @ body.inertia @ R.T + body.mass * (c @ c * np.eye(3) - np.outer(c, c))
    for joint in reversed(joints):
        child, parent = joint.child, joint.parent
        moves = mass[child]
        if joint.kind in (*SCALAR, "planar") and joint.kind != "prismatic":
            p = poses[child][:3, 3]
            a = poses[child][:3, :3] @ (np.array(joint.axis) / np.linalg.norm(joint.axis))
            about = mass[child] * (p @ p * np.eye(3) - np.outer(p, p)) - 2.0 * (p @ moment[child]) * np.eye(3)
            about += np.outer(p, moment[child]) + np.outer(moment[child], p)
            moves = a @ (inertia[child] + about) @ a
        if joint.kind != "fixed" and moves < 10.0 * LEAST:
            raise ModelError(_cure(robot, joint, mass[child], name))
        mass[parent], moment[parent] = mass[parent] + mass[child], moment[parent] + moment[child]
        inertia[parent] = inertia[parent] + inertia[child]


def _cure(robot: Robot, joint: Joint, mass: float, name: str) -> str:
    where = f"joint {joint.name!r} of {name} moves link {joint.child!r}"
    own = robot.links[joint.child].inertial
    if mass < LEAST:
        return (
            f"{where}, which has no mass and carries none: write its <inertial> with a mass and an inertia, or make "
            'the joint type="fixed".'
        )
    ball = 0.4 * mass * (3.0 * mass / (4.0 * np.pi * _WATER)) ** (2.0 / 3.0)
    weighs = f"its {own.mass:g} kg" if own is not None and own.mass > 0.0 else f"the {mass:g} kg that it carries"
    return (
        f"{where}, which has no inertia about the joint's axis: write its <inertia>; {weighs} as a ball of water would "
        f'have ixx="{ball:.3g}" iyy="{ball:.3g}" izz="{ball:.3g}".'
    )
