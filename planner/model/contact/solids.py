"""Solids of a machine and its world, as distances see them: round lines, round boxes and planes on links. Data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planner.base.arguments import set_fields
from planner.model.contact import distances
from planner.model.contact.distances import Near, Placed

LINE, BOX, PLANE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Solid:
    """A sphere, capsule, box or plane, or what stands for a cylinder, an ellipsoid or a mesh.

    Attributes:
        name: For a sentence: "geom 'forearm'".
        geom: Its number in the user's file.
        link: Which carries it, -1 for the world.
        T: (4, 4) pose in the link's frame.
        half: (3,) half lengths of its core along its axes, m: of a line the third alone. Of a plane nothing counts.
        radius: Of everything around the core, m.
        plane: Whether it is the half space under its first two axes.
        excess: By how much it reaches beyond the shape that it stands for, at most, m.
    """

    name: str
    geom: int
    link: int
    T: np.ndarray
    half: np.ndarray
    radius: float
    plane: bool = False
    excess: float = 0.0

    def __post_init__(self) -> None:
        set_fields(self, T=np.array(self.T, dtype=float), half=np.array(self.half, dtype=float))
        self.T.flags.writeable = self.half.flags.writeable = False

    @property
    def kind(self) -> int:
        """LINE, BOX or PLANE."""
        return PLANE if self.plane else BOX if np.any(self.half[:2] > 0.0) else LINE

    @property
    def reach(self) -> float:
        """Radius of the ball about its centre that holds it, m; of a plane infinite."""
        return float("inf") if self.plane else float(np.linalg.norm(self.half)) + self.radius

    def placed(self, T: np.ndarray) -> Placed:
        """Where it is when its link is at T (K, 4, 4)."""
        at = T @ self.T
        return Placed(at[:, :3, :3], at[:, :3, 3], self.half, self.radius)


def in_order(a: Solid, b: Solid) -> tuple[Solid, Solid]:
    """Two solids in the order in which distances are computed: a plane last, else a box last."""
    return (b, a) if a.kind > b.kind else (a, b)


def between(a: Solid, b: Solid, Ta: np.ndarray, Tb: np.ndarray) -> Near:
    """The signed distance of two solids in their order, whose links are at Ta and Tb (K, 4, 4)."""
    if b.kind == PLANE:
        measure = distances.from_plane
    elif b.kind == BOX:
        measure = distances.of_boxes if a.kind == BOX else distances.line_and_box
    else:
        measure = distances.of_lines
    return measure(a.placed(Ta), b.placed(Tb))
