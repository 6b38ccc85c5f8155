"""StateSpace: difference and sum of states x = (qpos, qvel, act) with quaternions, on the Lie group.

Ball and free joints store their orientation as a unit quaternion (w first), four numbers for three degrees of freedom.
So a state has nx components and a deviation ndx: a rotation vector in the body's own frame replaces each
quaternion, as in MuJoCo's mj_integratePos and mj_differentiatePos.

    x+ = integrate(x, dx),   dx = difference(x+, x);   quaternions: Q+ = Q exp(dx).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

_SMALL = 1e-4  # rad, angle below which third-order Taylor series are exact to rounding


@dataclass(frozen=True)
class StateSpace:
    """Sizes and quaternion addresses of a state and its deviation."""

    nx: int  # size of a state
    ndx: int  # size of a deviation
    quaternions: tuple[tuple[int, int], ...] = ()  # first index in the state and in the deviation of each

    @cached_property
    def _vector(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices in the state and in the deviation of all components outside quaternions."""
        in_x, in_dx = np.ones(self.nx, dtype=bool), np.ones(self.ndx, dtype=bool)
        for i, j in self.quaternions:
            in_x[i : i + 4], in_dx[j : j + 3] = False, False
        return np.flatnonzero(in_x), np.flatnonzero(in_dx)

    def in_deviation(self, index: int) -> int:
        """Index in the deviation of component `index` of the state; -1 within a quaternion."""
        in_x, in_dx = self._vector
        found = np.flatnonzero(in_x == index)
        return int(in_dx[found[0]]) if len(found) else -1

    def difference(self, x: np.ndarray, x_ref: np.ndarray) -> np.ndarray:
        """The deviation dx (..., ndx) with x = integrate(x_ref, dx), of x and x_ref (..., nx)."""
        if not self.quaternions:
            return x - x_ref
        shape = np.broadcast_shapes(x.shape[:-1], x_ref.shape[:-1])
        dx = np.empty((*shape, self.ndx))
        in_x, in_dx = self._vector
        dx[..., in_dx] = x[..., in_x] - x_ref[..., in_x]
        for i, j in self.quaternions:
            dx[..., j : j + 3] = log_quaternion(product(conjugate(x_ref[..., i : i + 4]), x[..., i : i + 4]))
        return dx

    def single_difference(self, x: np.ndarray, x_ref: np.ndarray) -> np.ndarray:
        """The difference (ndx,) of single states (nx,), in Python scalars, faster than NumPy on four numbers."""
        if not self.quaternions:
            return x - x_ref
        dx = np.empty(self.ndx)
        in_x, in_dx = self._vector
        dx[in_dx] = x[in_x] - x_ref[in_x]
        for i, j in self.quaternions:
            (w, a, b, c), (W, A, B, C) = x[i : i + 4].tolist(), x_ref[i : i + 4].tolist()
            real = W * w + A * a + B * b + C * c  # of conj(x_ref) x
            v = (
                W * a - w * A - (B * c - C * b),
                W * b - w * B - (C * a - A * c),
                W * c - w * C - (A * b - B * a),
            )  # fmt: skip
            sine, sign = math.hypot(*v), -1.0 if real < 0.0 else 1.0
            scale = 2.0 * sign * (math.atan2(sine, sign * real) / sine if sine > 1e-12 else 1.0)
            dx[j : j + 3] = scale * v[0], scale * v[1], scale * v[2]
        return dx

    def integrate(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """The state x + dx (..., nx) on the group, of x (..., nx) and a deviation dx (..., ndx)."""
        if not self.quaternions:
            return x + dx
        shape = np.broadcast_shapes(x.shape[:-1], dx.shape[:-1])
        result = np.empty((*shape, self.nx))
        in_x, in_dx = self._vector
        result[..., in_x] = x[..., in_x] + dx[..., in_dx]
        for i, j in self.quaternions:
            turned = product(unit(x[..., i : i + 4]), exp_quaternion(dx[..., j : j + 3]))
            result[..., i : i + 4] = turned
        return result

    def difference_jacobian(self, dx: np.ndarray) -> np.ndarray:
        """The derivative (..., ndx, ndx) of dx = difference(x, x_ref) with respect to a deviation of x."""
        J = np.zeros((*dx.shape, self.ndx))
        J[..., np.arange(self.ndx), np.arange(self.ndx)] = 1.0
        for _, j in self.quaternions:
            J[..., j : j + 3, j : j + 3] = log_jacobian(dx[..., j : j + 3])
        return J

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {"nx": self.nx, "ndx": self.ndx, "quaternions": [list(pair) for pair in self.quaternions]}


def euclidean(nx: int) -> StateSpace:
    """The space of vectors (nx,) without quaternions."""
    return StateSpace(nx, nx)


def space_of(dynamics: Any) -> StateSpace:
    """The state space of dynamics: their attribute `space`, else vectors (nx,)."""
    space = getattr(dynamics, "space", None)
    return space if isinstance(space, StateSpace) else euclidean(dynamics.nx)


def origin_of(space: StateSpace) -> np.ndarray:
    """(nx,) the state whose deviations are coordinates: zero, without rotation."""
    origin = np.zeros(space.nx)
    for i, _ in space.quaternions:
        origin[i] = 1.0
    return origin


def unit(quaternion: np.ndarray) -> np.ndarray:
    """The quaternion (..., 4), normalized, as MuJoCo does before every use."""
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product (..., 3), faster than np.cross, which handles any axes."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    result[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    result[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    result[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result


def conjugate(quaternion: np.ndarray) -> np.ndarray:
    """The inverse rotation of a unit quaternion (..., 4)."""
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The quaternion product a b (..., 4), rotation a after rotation b."""
    w = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    v = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + cross(a[..., 1:], b[..., 1:])
    return np.concatenate([w, v], axis=-1)


def exp_quaternion(rotation: np.ndarray) -> np.ndarray:
    """The unit quaternion (..., 4) of a rotation vector (..., 3), rad."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * rotation], axis=-1)


def log_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """The rotation vector (..., 3), rad, of a quaternion (..., 4), with a norm of at most pi."""
    quaternion = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, quaternion[..., :1])
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(sine > 1e-12, half / sine, 1.0 / quaternion[..., :1])
    return 2.0 * scale * quaternion[..., 1:]


def hat(v: np.ndarray) -> np.ndarray:
    """Skew-symmetric matrix (..., 3, 3) of v (..., 3); its product with w is v x w."""
    matrix = np.zeros((*v.shape, 3), dtype=v.dtype)
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return matrix - np.swapaxes(matrix, -1, -2)


def log_jacobian(rotation: np.ndarray) -> np.ndarray:
    """Inverse of SO(3)'s right Jacobian: log(R exp(e)) = r + J e to first order, log R = r (..., 3)."""
    square = np.sum(rotation**2, axis=-1)[..., None, None]
    angle = np.sqrt(np.maximum(square, _SMALL**2))
    factor = 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))
    factor = np.where(square > _SMALL**2, factor, 1.0 / 12.0 + square / 720.0)
    H = hat(rotation)
    return np.eye(3) + 0.5 * H + factor * (H @ H)


@dataclass(frozen=True, eq=False)
class StateMap:
    """A motion of the whole machine, or its mirror image, as a map of states.

        image of x = integrate(image, matrix difference(x, origin))

    It is exact for quaternions, too. A rotation of the world multiplies each from the left. A reflection turns each
    about the mirrored axis by the opposite angle, and the image of a product is the product of the images. So `matrix`
    is the derivative of the map everywhere.

    Attributes:
        origin: (nx,) a state.
        image: (nx,) where it goes.
        matrix: (ndx, ndx) orthogonal, of deviations.
        controls: (nu, nu) from controls to those of the image; None for the same ones.
    """

    origin: np.ndarray
    image: np.ndarray
    matrix: np.ndarray
    controls: np.ndarray | None = None

    def apply(self, space: StateSpace, xs: np.ndarray) -> np.ndarray:
        """The images of states (..., nx)."""
        return space.integrate(self.image, space.difference(xs, self.origin) @ self.matrix.T)

    def undo(self, space: StateSpace, xs: np.ndarray) -> np.ndarray:
        """The states (..., nx) whose images are given."""
        return space.integrate(self.origin, space.difference(xs, self.image) @ self.matrix)

    def images_of_controls(self, us: np.ndarray) -> np.ndarray:
        """The controls (..., nu) with which the image does what the machine does with controls (..., nu)."""
        return us if self.controls is None else us @ self.controls.T

    def then(self, space: StateSpace, other: StateMap) -> StateMap:
        """This map, and the other one after it."""
        both = [one for one in (other.controls, self.controls) if one is not None]
        controls = None if not both else both[0] if len(both) == 1 else both[0] @ both[1]
        return StateMap(self.origin, other.apply(space, self.image), other.matrix @ self.matrix, controls)

    def power(self, space: StateSpace, times: int) -> StateMap:
        """This map so many times, at least once."""
        found = self
        for _ in range(times - 1):
            found = found.then(space, self)
        return found

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        controls = {} if self.controls is None else {"controls": self.controls.tolist()}
        states = {"origin": self.origin.tolist(), "image": self.image.tolist(), "matrix": self.matrix.tolist()}
        return states | controls

    @classmethod
    def from_dict(cls, table: dict[str, Any]) -> StateMap:
        """The map of a table that to_dict made."""
        return cls(**{name: np.array(value) for name, value in table.items()})
