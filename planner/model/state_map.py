"""StateMap: a motion of the whole machine, or its mirror image, as a map of states.

    image of x = integrate(image, matrix difference(x, origin))

It is exact for quaternions: a rotation of the world multiplies them from the left, a reflection turns each about the
mirrored axis by the opposite angle, and both leave products products. So `matrix`, which is orthogonal, is the
derivative of the map everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.model.space import StateSpace


@dataclass(frozen=True, eq=False)
class StateMap:
    """A map of states.

    Attributes:
        origin: (nx,) a state.
        image: (nx,) where it goes.
        matrix: (ndx, ndx) orthogonal, of deviations.
    """

    origin: np.ndarray
    image: np.ndarray
    matrix: np.ndarray

    def apply(self, space: StateSpace, xs: np.ndarray) -> np.ndarray:
        """The images of states (..., nx)."""
        return space.integrate(self.image, space.difference(xs, self.origin) @ self.matrix.T)

    def undo(self, space: StateSpace, xs: np.ndarray) -> np.ndarray:
        """The states (..., nx) whose images are given."""
        return space.integrate(self.origin, space.difference(xs, self.image) @ self.matrix)

    def then(self, space: StateSpace, other: StateMap) -> StateMap:
        """This map, and the other one after it."""
        return StateMap(self.origin, other.apply(space, self.image), other.matrix @ self.matrix)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values; of the matrix what is not zero, as rows of i, j and the entry."""
        at = np.argwhere(self.matrix != 0.0).tolist()
        entries = [[i, j, float(self.matrix[i, j])] for i, j in at]
        return {"origin": self.origin.tolist(), "image": self.image.tolist(), "entries": entries}

    @classmethod
    def from_dict(cls, table: dict[str, Any], ndx: int) -> StateMap:
        """The map of a table that to_dict made, of deviations (ndx,)."""
        matrix = np.zeros((ndx, ndx))
        for i, j, entry in table["entries"]:
            matrix[int(i), int(j)] = entry
        return cls(np.array(table["origin"]), np.array(table["image"]), matrix)
