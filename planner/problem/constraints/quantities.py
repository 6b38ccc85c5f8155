"""Quantities of a machine that constraints bound and kernels compute, as residuals that costs have too.

    FramePosition       position of a frame, x, y, z                                           m
    FramePositionAlong  position of a frame along a direction of the world                     m
    FrameOrientation    rotation vector of a frame from an orientation, in its axes            rad
    FrameAxisAngle      angle between an axis of a frame and a direction of the world          rad
    CenterOfMass        position of the centre of mass                                         m

and the terms of planner.costs: Height, Distance, Gap, Velocity. An angle is not differentiable at 0, so bounds of a
FrameAxisAngle are above 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, set_fields, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.kernels.tree.residuals.kinds import HEIGHT, MASS_CENTRE, ORIENTATION, POSITION, TILT
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import Frame, Mechanism
from planner.model.space import space_of
from planner.problem.costs.least_squares import values_and_jacobians, values_of
from planner.problem.costs.penalty_terms import Penalty
from planner.problem.costs.residual_arrays import ResidualArrays, ResidualList, arrays_of_terms
from planner.problem.costs.residual_functions import KinematicsCache, rotation_of, tilt_curvature
from planner.problem.residual import Residual

__all__ = ["CenterOfMass", "FrameAxisAngle", "FrameOrientation", "FramePosition", "FramePositionAlong"]


class KernelResidual:
    """One term of ResidualArrays as a constraint function; its bounds and weights are ignored."""

    of_controls = False

    def __init__(self, dynamics: Dynamics, what: Any, arrays: ResidualArrays) -> None:
        self.mechanism, self.arrays, self.rows = mechanism_of(dynamics, what), arrays, len(arrays.weight)
        of = (getattr(arrays, name) for name in ("kind", "link", "offset", "share", "world", "constant", "reference"))
        self.same = tuple(one.tobytes() for one in of)
        self._ndx, self._nu, self._nx = space_of(dynamics).ndx, dynamics.nu, mechanism_of(dynamics, what).space.nx

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R)."""
        return values_of(self.mechanism, self.arrays.along(n), xs[:, : self._nx]).T

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, R, ndx) and zeros (K, R, nu)."""
        by_x, own = np.zeros((len(xs), self.rows, self._ndx)), self._jacobian(xs, n)
        by_x[:, :, : own.shape[2]] = own
        return by_x, np.zeros((len(xs), self.rows, self._nu))

    def _jacobian(self, xs: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, R, k) by the first k components of a deviation; zero by the others."""
        return values_and_jacobians(self.mechanism, self.arrays.along(n), xs[:, : self._nx])[1]

    def second_derivatives(self, xs: np.ndarray, n: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        """(K, ndx, ndx) second derivatives weighted by penalty gradients (K, R), of FrameAxisAngle alone.

        Their positive part; the Hessian of other terms is that of Gauss and Newton.
        """
        found = np.zeros((len(xs), self._ndx, self._ndx))
        if TILT in self.arrays.kind:
            curvature, across = tilt_curvature(
                KinematicsCache(self.mechanism, self.arrays.along(n), xs[:, : self._nx]), 0
            )
            nv = across.shape[1]
            found[:, :nv, :nv] = np.einsum("k,ki,kj->kij", np.maximum(curvature * gradients[:, 0], 0.0), across, across)
        return found


def function_of_term(term: Penalty, dynamics: Dynamics, N: int) -> KernelResidual:
    """The constraint function of a Height, Distance, Gap or Velocity."""
    return KernelResidual(dynamics, term, arrays_of_terms(mechanism_of(dynamics, term), N, [term], dynamics.dt))


def mechanism_of(dynamics: Dynamics, what: Any) -> Mechanism:
    """The mechanism of dynamics; messages name the quantity `what` that needs it."""
    mechanism = capabilities_of(dynamics).mechanism
    if mechanism is None:
        raise PlannerError(f"the {what} is that of a machine, expected dynamics with a mechanism.")
    return mechanism


def _frame_function(
    what: Any, dynamics: Dynamics, N: int, kind: int, oriented: bool = False, own: Any = (), reference: Any = ()
) -> KernelResidual:
    """Of a frame: its rotation in its link is prepended to a term's `own` constants, or rotates the first three."""
    mechanism, frame = mechanism_of(dynamics, what), what.frame
    if isinstance(frame, str):
        known = [*mechanism.sites, *filter(None, mechanism.body_names)]
        frame = mechanism.frame(choice("a constraint's frame", frame, known))
    elif not isinstance(frame, Frame):
        raise PlannerError(
            f"a constraint's frame is {short_repr(frame)}, expected a Frame, or a site's or body's name."
        )
    terms, R = ResidualList(N), frame.T[:3, :3]
    constant = (*R.ravel(), *own) if oriented else (*(R @ own[:3]), *own[3:]) if kind == TILT else own
    terms.add(kind, 4 * [terms.point(frame.link, frame.T[:3, 3])], 0.0, constant=constant, reference=reference)
    return KernelResidual(dynamics, what, terms.arrays())


@dataclass(frozen=True, eq=False)
class FramePosition(Residual):
    """Position of a frame in the world, x, y, z in m.

    Attributes:
        frame: Name of a site or body, or a Frame.
    """

    frame: str | Frame
    unit = "m"
    dim, names = 3, ("x", "y", "z")

    def __str__(self) -> str:
        return f"position of {_name(self.frame)}"

    def residual_function(self, dynamics: Dynamics, N: int) -> KernelResidual:
        """Its function, of a machine."""
        return _frame_function(self, dynamics, N, POSITION)


@dataclass(frozen=True, eq=False)
class FramePositionAlong(Residual):
    """Position of a frame along a direction of the world, m.

    Attributes:
        frame: Name of a site or body, or a Frame.
        direction: (3,) of any length above 0; upwards by default.
    """

    frame: str | Frame
    direction: Any = (0.0, 0.0, 1.0)
    unit = "m"

    def __post_init__(self) -> None:
        set_fields(self, direction=_normalized("direction", self.direction, 3))

    def __str__(self) -> str:
        return f"place of {_name(self.frame)}"  # part of a stored key

    def residual_function(self, dynamics: Dynamics, N: int) -> KernelResidual:
        """Its function, of a machine."""
        return _frame_function(self, dynamics, N, HEIGHT, own=(*self.direction, 0.0))


@dataclass(frozen=True, eq=False)
class FrameOrientation(Residual):
    """Rotation vector of a frame from an orientation, rad, in the axes of that orientation.

    Attributes:
        frame: Name of a site or body, or a Frame.
        orientation: (4,) quaternion, w first; normalized.
    """

    frame: str | Frame
    orientation: Any
    unit = "rad"
    dim, names = 3, ("x", "y", "z")

    def __post_init__(self) -> None:
        set_fields(self, orientation=_normalized("orientation", self.orientation, 4))

    def __str__(self) -> str:
        return f"orientation of {_name(self.frame)}"

    def residual_function(self, dynamics: Dynamics, N: int) -> KernelResidual:
        """Its function, of a machine."""
        reference = np.tile(rotation_of(self.orientation).reshape(9, 1), N + 1)
        return _frame_function(self, dynamics, N, ORIENTATION, oriented=True, reference=reference)


@dataclass(frozen=True, eq=False)
class FrameAxisAngle(Residual):
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
        set_fields(self, direction=_normalized("direction", self.direction, 3))
        set_fields(self, axis=_normalized("axis", self.axis, 3))

    def __str__(self) -> str:
        return f"tilt of {_name(self.frame)}"  # part of a stored key

    def residual_function(self, dynamics: Dynamics, N: int) -> KernelResidual:
        """Its function, of a machine."""
        return _frame_function(self, dynamics, N, TILT, own=(*self.axis, *self.direction))


@dataclass(frozen=True, eq=False)
class CenterOfMass(Residual):
    """Position of the centre of mass in the world, x, y, z in m."""

    unit = "m"
    dim, names = 3, ("x", "y", "z")

    def __str__(self) -> str:
        return "centre of mass"

    def residual_function(self, dynamics: Dynamics, N: int) -> KernelResidual:
        """Its function, of a machine."""
        terms = ResidualList(N)
        terms.add(MASS_CENTRE, [], 0.0)
        return KernelResidual(dynamics, self, terms.arrays())


def penalty_arrays(arrays: ResidualArrays, sides: np.ndarray, N: int) -> ResidualArrays:
    """The rows of a constraint function with a side each (R,), without a ramp and with weights of zero."""
    stages = np.zeros((len(sides), N + 1))
    return replace(arrays, side=sides, ramp=np.zeros(len(sides)), bound=stages, weight=stages.copy())


def _name(frame: str | Frame) -> str:
    return frame if isinstance(frame, str) else "a frame"


def _normalized(name: str, value: Any, size: int) -> np.ndarray:
    given = array(name, value, (size,))
    length = float(np.linalg.norm(given))
    if not length > 0.0:
        raise PlannerError(f"{name} is all zeros, expected {'a direction' if size == 3 else 'a quaternion'}.")
    return given / length
