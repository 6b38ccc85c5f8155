"""Solids of a machine and its world, as distances see them: round lines, round boxes and planes on links. Data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planner.base.arguments import set_fields
from planner.model.contact import signed_distance
from planner.model.contact.signed_distance import PlacedShapes

CAPSULE, BOX, PLANE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A sphere, capsule, box or plane, or what stands for a cylinder, an ellipsoid or a mesh.

    Attributes:
        name: For a sentence: "geom 'forearm'".
        geom: Its number in the user's file.
        link: Which carries it, -1 for the world.
        T: (4, 4) pose in the link's frame.
        half: (3,) half lengths of its core along its axes, m: of a line the third alone. Of a plane nothing counts.
        radius: Of everything around the core, m.
        plane: Whether it is the half space under its first two axes.
        overestimate: By how much it reaches beyond the shape that it stands for, at most, m.
    """

    name: str
    geom: int
    link: int
    T: np.ndarray
    half: np.ndarray
    radius: float
    plane: bool = False
    overestimate: float = 0.0

    def __post_init__(self) -> None:
        set_fields(self, T=np.array(self.T, dtype=float), half=np.array(self.half, dtype=float))
        self.T.flags.writeable = self.half.flags.writeable = False

    @property
    def kind(self) -> int:
        """LINE, BOX or PLANE."""
        return PLANE if self.plane else BOX if np.any(self.half[:2] > 0.0) else CAPSULE

    @property
    def reach(self) -> float:
        """Radius of the ball about its centre that holds it, m; of a plane infinite."""
        return float("inf") if self.plane else float(np.linalg.norm(self.half)) + self.radius


def in_order(a: CollisionShape, b: CollisionShape) -> tuple[CollisionShape, CollisionShape]:
    """Two solids in the order in which distances are computed: a plane last, else a box last."""
    return (b, a) if a.kind > b.kind else (a, b)


def placed(solids: Sequence[CollisionShape], T: np.ndarray) -> PlacedShapes:
    """Solids whose links are at T (..., P, 4, 4), one after the other."""
    at = (T @ np.array([solid.T for solid in solids])).reshape(-1, 4, 4)
    count = len(at) // len(solids)
    half, radius = (np.array([getattr(solid, name) for solid in solids]) for name in ("half", "radius"))
    return PlacedShapes(at[:, :3, :3], at[:, :3, 3], np.tile(half, (count, 1)), np.tile(radius, count))


def kind_of(a: CollisionShape, b: CollisionShape) -> int:
    """The place in MEASURES of how two solids in their order are measured."""
    return 3 if b.kind == PLANE else a.kind + b.kind


MEASURES = (
    signed_distance.segment_segment,
    signed_distance.segment_box,
    signed_distance.of_boxes,
    signed_distance.from_plane,
)
