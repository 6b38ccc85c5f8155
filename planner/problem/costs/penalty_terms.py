"""Terms of a PenaltyCost: heights and velocities of points, distances of points or capsules, gaps of contacts. Data.

A term is a function of the state, `value`, compared with a bound or target at each stage:

    lower    r = ramp(lower - value; a) / tolerance
    upper    r = ramp(value - upper; a) / tolerance
    target   r = (value - target) / tolerance

    ramp(e; a) = 0, e^2 / 2a, e - a/2          for e < 0, 0..a, > a

Errors of one tolerance cost the same in all terms. The ramp length a is the tolerance by default: the second derivative
of the cost is continuous at the bound and jumps at e = a, and the Gauss-Newton Hessian grows gradually from 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.base.arguments import array, number, numbers, set_fields, short_repr
from planner.base.errors import PlannerError
from planner.model.contact.signed_distance import CollisionShape
from planner.model.mechanism import Frame

SIDES = ("lower", "upper", "target")


@dataclass(frozen=True, eq=False)
class Point:
    """A point: share times the world position of `offset` in `frame`, plus `world`.

    Attributes:
        frame: Name of a site or body, a Frame, or None for the world.
        offset: (3,) m, in the frame.
        share: Factor of the position.
        world: (3,) or (N+1, 3) m, added to it.
    """

    frame: str | Frame | None = None
    offset: Any = (0.0, 0.0, 0.0)
    share: float = 1.0
    world: Any = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (self.frame is None or isinstance(self.frame, (str, Frame))):
            raise PlannerError(
                f"frame is {short_repr(self.frame)}, expected a Frame, the name of a site or body, or None."
            )
        world = numbers("world", self.world)
        world = array("world", world, ("N+1", 3) if world.ndim == 2 else (3,))
        set_fields(self, offset=array("offset", self.offset, (3,)), share=number("share", self.share), world=world)

    def __str__(self) -> str:
        return self.frame if isinstance(self.frame, str) else "a point" if self.frame is None else "a frame"


@dataclass(frozen=True, eq=False)
class Segment:
    """A straight line between two points, or a capsule about it.

    Attributes:
        start: One end.
        end: The other.
        radius: Of the capsule, m; 0 for the line.
    """

    start: Point
    end: Point
    radius: float = 0.0

    def __post_init__(self) -> None:
        _check_types(self, ("start", "end"), Point, "a Point")
        set_fields(self, radius=number("radius", self.radius, minimum=0.0))

    def __str__(self) -> str:
        return f"{self.start} - {self.end}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Penalty:
    """A bound of a value or a target for it, exactly one of lower, upper and target, and its weight.

    Attributes:
        lower: A number, or (N+1,) with NaN at stages where the term is off.
        upper: The same.
        target: The same.
        tolerance: Error with residual 1, m; of a velocity m/s.
        ramp: Ramp length a, unit of the tolerance, its default.
        weight: Running weight of r^2 / 2, 1/s, a number or (N+1,).
        final_weight: Final weight of r^2 / 2; by default dt times the last of `weight`.
    """

    lower: Any = None
    upper: Any = None
    target: Any = None
    tolerance: float
    ramp: float | None = None
    weight: Any = 1.0
    final_weight: float | None = None

    def __post_init__(self) -> None:
        given = [name for name in SIDES if getattr(self, name) is not None]
        if len(given) != 1:
            raise PlannerError(f"{' and '.join(given) or 'none'} of {', '.join(SIDES)} given, expected just one.")
        tolerance = number("tolerance", self.tolerance, greater_than=0.0)
        ramp = tolerance if self.ramp is None else number("ramp", self.ramp, greater_than=0.0)
        bound = _per_stage(given[0], getattr(self, given[0]))
        if np.isinf(bound).any():
            raise PlannerError(f"{given[0]} is infinite at a stage, expected finite numbers, or NaN where it is off.")
        weight = _per_stage("weight", self.weight)
        if not (np.isfinite(weight).all() and weight.min(initial=0.0) >= 0.0):
            raise PlannerError(f"weight is {short_repr(self.weight)}, expected finite weights of at least 0.")
        if self.final_weight is not None:
            set_fields(self, final_weight=number("final_weight", self.final_weight, minimum=0.0))
        set_fields(self, tolerance=tolerance, ramp=ramp, weight=weight, **{given[0]: bound})

    @property
    def side(self) -> str:
        """The one that is given: "lower", "upper" or "target"."""
        return next(name for name in SIDES if getattr(self, name) is not None)


@dataclass(frozen=True, eq=False)
class Height(Penalty):
    """Coordinate of a point along a direction of the world, m.

    Attributes:
        point: The Point.
        normal: (3,) the direction, of any length above 0; upwards by default.
    """

    point: Point
    normal: Any = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_types(self, ("point",), Point, "a Point")
        set_fields(self, normal=_direction("normal", self.normal))

    def __str__(self) -> str:
        return f"height of {self.point}"


@dataclass(frozen=True, eq=False)
class Velocity(Penalty):
    """Velocity of a point along a direction of the world, relative to another point, m/s.

    Attributes:
        point: The Point; its `world` part is taken as constant.
        direction: (3,) of any length above 0.
        relative: The reference Point, of a belt for example; by default at rest in the world.
    """

    point: Point
    direction: Any
    relative: Point = field(default_factory=Point)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_types(self, ("point", "relative"), Point, "a Point")
        set_fields(self, direction=_direction("direction", self.direction))

    def __str__(self) -> str:
        return f"velocity of {self.point}"


@dataclass(frozen=True, eq=False)
class Distance(Penalty):
    """Distance between two points, lines or capsules, m; negative where capsules overlap.

    The distance between the centre lines has no sign: if they cross, the gradient does not separate them. For parallel
    lines the gradient is discontinuous, like the nearest points.

    Attributes:
        a: A Point or Segment.
        b: The other.
    """

    a: Point | Segment
    b: Point | Segment

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_types(self, ("a", "b"), (Point, Segment), "a Point or a Segment")

    def __str__(self) -> str:
        return f"distance of {self.a} and {self.b}"


@dataclass(frozen=True, eq=False)
class Gap(Penalty):
    """The gap between sphere and plane of a contact of the mechanism, m, negative in penetration.

    Attributes:
        contact: Its name in mechanism.contacts; "toe" also stands for "geom 'toe'".
    """

    contact: str

    def __str__(self) -> str:
        return f"gap of {self.contact}"


@dataclass(frozen=True, eq=False)
class Clearance(Penalty):
    """Signed distance of two collision shapes, m, minus the penetration depth if they overlap. Lower bound only.

    Attributes:
        a: The first CollisionShape; planner.constraints.Avoid makes them from a model's shapes.
        b: The second, in the order of model.contact.collision_shapes.in_order.
        lift: m, offset added to the distance, for overlap of the fitted shapes at the start.
    """

    a: CollisionShape
    b: CollisionShape
    lift: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_types(self, ("a", "b"), CollisionShape, "a Solid")
        if self.side != "lower":
            raise PlannerError(f"{self.side} is given for a Clearance, expected lower: the distance to be kept.")

    def __str__(self) -> str:
        return f"clearance of {self.a.name} and {self.b.name}"


def _check_types(term: Any, names: Sequence[str], kind: type | tuple[type, ...], expected: str) -> None:
    for name in names:
        if not isinstance(getattr(term, name), kind):
            raise PlannerError(f"{name} is {short_repr(getattr(term, name))}, expected {expected}.")


def _direction(name: str, value: Any) -> np.ndarray:
    """(3,) of length one."""
    direction = array(name, value, (3,))
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        raise PlannerError(f"{name} is (0, 0, 0), expected a direction.")
    return direction / length


def _per_stage(name: str, value: Any) -> np.ndarray:
    """() or (N+1,) array; whether they are finite is checked later."""
    given = numbers(name, value)
    return array(name, given, ("N+1",), any_value=True) if given.ndim else given
