"""Frames of a machine: where one is, how it is turned, and how far an axis of it is from a direction. The angle is

    theta = atan2(|a x d|, a'd),    d theta / dt = -w'(a x d) / |a x d|,

of the frame's axis a and the world's direction d, with the frame's angular velocity w. At theta = 0 it has a kink, so a
bound of it is above 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, set_fields, shown
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.model.mechanism import Frame, Mechanism
from planner.model.space import conjugate, cross, log_jacobian, log_quaternion, product
from planner.problem.costs.frame import quaternion_of

_TINY = 1e-12  # of |a x d|: there the angle has no derivative


@dataclass(frozen=True, eq=False)
class Place:
    """Where a frame is in the world, x, y, z in m.

    Attributes:
        frame: Name of a site or body, or a Frame.
    """

    frame: str | Frame
    unit = "m"

    def __str__(self) -> str:
        return f"position of {_name(self.frame)}"

    def measure(self, dynamics: Dynamics, N: int) -> FrameMeasure:
        """Of a machine."""
        return FrameMeasure(dynamics, self.frame, _Place())


@dataclass(frozen=True, eq=False)
class Turn:
    """How a frame is turned from an orientation: a rotation vector in rad, about the axes of that orientation.

    Attributes:
        frame: Name of a site or body, or a Frame.
        orientation: (4,) quaternion, w first; normalised.
    """

    frame: str | Frame
    orientation: Any
    unit = "rad"

    def __post_init__(self) -> None:
        set_fields(self, orientation=_of_length_one("orientation", self.orientation, 4))

    def __str__(self) -> str:
        return f"orientation of {_name(self.frame)}"

    def measure(self, dynamics: Dynamics, N: int) -> FrameMeasure:
        """Of a machine."""
        return FrameMeasure(dynamics, self.frame, _Turn(self.orientation))


@dataclass(frozen=True, eq=False)
class Tilt:
    """The angle between an axis of a frame and a direction of the world, 0 to pi rad.

    Attributes:
        frame: Name of a site or body, or a Frame.
        direction: (3,) of the world, of any length above 0; upwards by default.
        axis: (3,) of the frame, likewise; its z by default.
    """

    frame: str | Frame
    direction: Any = (0.0, 0.0, 1.0)
    axis: Any = (0.0, 0.0, 1.0)
    unit = "rad"

    def __post_init__(self) -> None:
        set_fields(self, direction=_of_length_one("direction", self.direction, 3))
        set_fields(self, axis=_of_length_one("axis", self.axis, 3))

    def __str__(self) -> str:
        return f"tilt of {_name(self.frame)}"

    def measure(self, dynamics: Dynamics, N: int) -> FrameMeasure:
        """Of a machine."""
        return FrameMeasure(dynamics, self.frame, _Tilt(self.axis, self.direction))


def _name(frame: str | Frame) -> str:
    return frame if isinstance(frame, str) else "a frame"


def _of_length_one(name: str, value: Any, size: int) -> np.ndarray:
    given = array(name, value, (size,))
    length = float(np.linalg.norm(given))
    if not length > 0.0:
        raise PlannerError(f"{name} is all zeros, expected {'a direction' if size == 3 else 'a quaternion'}.")
    return given / length


class FrameMeasure:
    """What a frame's pose says: rows of its own, of poses T (K, 4, 4), and their derivatives by J (K, 6, nv)."""

    of_controls = False

    def __init__(self, dynamics: Dynamics, frame: str | Frame, seen: Any) -> None:
        mechanism = getattr(dynamics, "mechanism", None)
        if not isinstance(mechanism, Mechanism):
            raise PlannerError("a frame is one of a machine, expected dynamics with a mechanism.")
        if isinstance(frame, str):
            known = [*mechanism.sites, *filter(None, mechanism.body_names)]
            frame = mechanism.frame(choice("a constraint's frame", frame, known))
        elif not isinstance(frame, Frame):
            raise PlannerError(f"a constraint's frame is {shown(frame)}, expected a Frame, or a site's or body's name.")
        self.mechanism, self.frame, self.seen, self.rows = mechanism, frame, seen, seen.rows
        self._nu, self._ndx = dynamics.nu, getattr(dynamics, "ndx", mechanism.space.ndx)

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R)."""
        return self.seen.value(frame_pose(self.mechanism, xs[:, : self.mechanism.nq], self.frame))

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, R, ndx), and zeros (K, R, nu)."""
        q, by_x = xs[:, : self.mechanism.nq], np.zeros((len(xs), self.rows, self._ndx))
        T, J = (what(self.mechanism, q, self.frame) for what in (frame_pose, jacobian))
        by_x[:, :, : self.mechanism.nv] = self.seen.derivative(T, J)
        return by_x, np.zeros((len(xs), self.rows, self._nu))


class _Place:
    rows = 3

    def value(self, T: np.ndarray) -> np.ndarray:
        return T[:, :3, 3]

    def derivative(self, T: np.ndarray, J: np.ndarray) -> np.ndarray:
        return J[:, :3]


class _Turn:
    rows = 3

    def __init__(self, orientation: np.ndarray) -> None:
        self._back = conjugate(orientation)

    def value(self, T: np.ndarray) -> np.ndarray:
        return log_quaternion(product(self._back, quaternion_of(T[:, :3, :3])))

    def derivative(self, T: np.ndarray, J: np.ndarray) -> np.ndarray:
        return log_jacobian(self.value(T)) @ np.swapaxes(T[:, :3, :3], 1, 2) @ J[:, 3:]


class _Tilt:
    rows = 1

    def __init__(self, axis: np.ndarray, direction: np.ndarray) -> None:
        self._axis, self._direction = axis, direction

    def value(self, T: np.ndarray) -> np.ndarray:
        a = T[:, :3, :3] @ self._axis
        return np.arctan2(np.linalg.norm(cross(a, self._direction), axis=1), a @ self._direction)[:, None]

    def derivative(self, T: np.ndarray, J: np.ndarray) -> np.ndarray:
        about = cross(T[:, :3, :3] @ self._axis, self._direction)
        sine = np.linalg.norm(about, axis=1, keepdims=True)
        return -np.einsum("na,nai->ni", about / np.maximum(sine, _TINY), J[:, 3:])[:, None]
