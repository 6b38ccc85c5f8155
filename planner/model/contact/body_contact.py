"""Contacts between two bodies: spheres and capsules, and the closest points of their axes. Data.

The axis of a capsule is a segment m + s a with |s| <= l, that of a sphere a point. Two of them touch along the line
between the points of their axes that are closest, by the law of model.contact.laws: with D the vector from the second
axis to the first and n = D/|D|

    e = r_1 + r_2 + lift - |D|,   p = (x_1 + x_2)/2 - (r_1 - r_2) n/2,   v = V_1(p) - V_2(p)

the force f(n, e, v) acts on the first at p, halfway between the surfaces, and -f on the second. Between capsules that
are parallel no points are closest, so of two capsules

    |D|^2/2 + b (s_1^2 + s_2^2)/2

is least, with b = (ramp/(l_1 + l_2))^2. It leads from end to end, smoothly, where their ends' depths differ by much
less than the ramp, to points that are at most ramp^2/2|D| farther apart than the closest ones. Where a closest point
reaches the end of its axis the force has a kink and no jump.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import array, count, number, set_fields
from planner.base.errors import PlannerError
from planner.model.contact.laws import ContactLaw

MIN_BLUNT = 1e-9  # b without a ramp: parallel capsules still touch somewhere, and rounding stays below a micrometre


@dataclass(frozen=True, eq=False)
class Capsule:
    """A capsule, or a sphere, of a link or of the world.

    Attributes:
        link: Which carries it, -1 for the world.
        middle: (3,) m, in the link's frame.
        half: (3,) m, from the middle to one end of its axis; zeros for a sphere.
        radius: m.
    """

    link: int
    middle: np.ndarray
    half: np.ndarray
    radius: float

    def __post_init__(self) -> None:
        link, radius = count("link", self.link, minimum=-1), number("radius", self.radius, minimum=0.0)
        middle, half = array("middle", self.middle, (3,)), array("half", self.half, (3,))
        set_fields(self, link=link, middle=middle, half=half, radius=radius)

    @property
    def length(self) -> float:
        """Half the length of its axis, m."""
        return float(np.linalg.norm(self.half))

    @property
    def axis(self) -> np.ndarray:
        """(3,) direction of its axis; zeros for a sphere."""
        return self.half / self.length if self.length > 0.0 else np.zeros(3)


@dataclass(frozen=True, eq=False)
class BodyContact:
    """Two spheres or capsules, of two links or of one link and the world.

    Attributes:
        first: On which the force acts.
        second: On which its opposite acts.
        law: The force.
        name: For pictures and messages.
    """

    first: Capsule
    second: Capsule
    law: ContactLaw
    name: str = ""

    def __post_init__(self) -> None:
        if self.first.link == self.second.link:
            raise PlannerError(f"first and second are both of link {self.first.link}, expected two links.")
        if not self.first.radius + self.second.radius > 0.0:
            raise PlannerError("first and second have radius 0, expected a radius above 0 of at least one.")

    @property
    def axis_regularization(self) -> float:
        """The weight b of the positions along the axes in the minimized sum; 0 where one is a sphere."""
        first, second = self.first.length, self.second.length
        if first == 0.0 or second == 0.0:
            return 0.0
        return max((self.law.ramp / (first + second)) ** 2, MIN_BLUNT)


def check_body_contact(contact: BodyContact, carriers: Any, where: str) -> None:
    """Raise a PlannerError unless both parts are of the world (-1) or of links in `carriers`, which have bodies."""
    for part in (contact.first, contact.second):
        if part.link >= 0 and part.link not in carriers:
            raise PlannerError(f"{where} is of link {part.link}, expected one with a body: {carriers}.")


def common_carrier(parent: np.ndarray, contact: BodyContact) -> int:
    """The last link that carries both parts of a contact: its motion does not change the contact; -1 for none."""
    above, i = {-1}, contact.first.link
    while i >= 0:
        above.add(i)
        i = int(parent[i])
    i = contact.second.link
    while i not in above:
        i = int(parent[i])
    return i
