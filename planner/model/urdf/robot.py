"""A robot as a URDF has it: links, joints and shapes. Data only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Numbers = tuple[float, ...]

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
SCALAR = ("revolute", "continuous", "prismatic")
"""Joints with one coordinate, which get a motor."""


@dataclass(frozen=True)
class Pose:
    """Position, m, and angles about fixed axes, rad."""

    xyz: Numbers = (0.0, 0.0, 0.0)
    rpy: Numbers = (0.0, 0.0, 0.0)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) Rz Ry Rx."""
        (a, b, c), (A, B, C) = np.cos(self.rpy), np.sin(self.rpy)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, a, -A], [0.0, A, a]])
        about_y = np.array([[b, 0.0, B], [0.0, 1.0, 0.0], [-B, 0.0, b]])
        about_z = np.array([[c, -C, 0.0], [C, c, 0.0], [0.0, 0.0, 1.0]])
        return about_z @ about_y @ about_x

    @property
    def T(self) -> np.ndarray:
        """(4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation, self.xyz
        return T


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass, kg, centre (3,), m, and inertia (3, 3), kg m^2, about the centre, all in the link's axes."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Shape:
    """A visual or collision element: `size` of a primitive as MJCF has it, `file` and `scale` of a mesh."""

    kind: str
    pose: Pose
    size: Numbers = ()
    file: str = ""
    scale: Numbers = (1.0, 1.0, 1.0)
    rgba: Numbers = ()


@dataclass(frozen=True)
class Link:
    """A link, with an inertial where the file gives one."""

    name: str
    inertial: Inertial | None
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]


@dataclass(frozen=True)
class Joint:
    """A joint; limits are infinite where the file gives none."""

    name: str
    kind: str
    parent: str
    child: str
    pose: Pose
    axis: Numbers
    range: tuple[float, float]
    effort: float
    velocity: float
    damping: float
    friction: float
    mimic: tuple[str, float, float] | None  # the joint that it follows, multiplier and offset
    unclear: tuple[tuple[str, str], ...] = ()  # a limit that is not there, or not as written, and why: for a phrase


@dataclass(frozen=True)
class Robot:
    """A tree of links: joints in an order in which parents come first."""

    root: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    meshdir: str  # of the <mujoco> extension
    name: str  # its own, or that of its root
