"""StateMap: a motion of the whole machine, or its mirror image, as a map of states.

    image of x = integrate(image, matrix difference(x, origin))

It is exact for quaternions, too. A rotation of the world multiplies each from the left. A reflection turns each about
the mirrored axis by the opposite angle, and the image of a product is the product of the images. So `matrix`, which is
orthogonal, is the derivative of the map everywhere.
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
