"""Closed chains: algebraic constraints phi(q) = 0 on a tree (section 1.2). Data only.

    LoopClosure         two frames of the machine, or one and the world, coincide in position (MuJoCo's connect) or
                        also in orientation (weld)
    PolynomialCoupling  a joint follows another one by a polynomial (MuJoCo's nonlinear equality of joints)

Equations that are linear in the coordinates are couplings (planner.model.couplings), which eliminate coordinates.
These eliminate none. Their forces f act, with J the derivative of phi:

    M qdd + h = tau + J'f,   J qdd + Jdot qd + 2 rate phidot + rate^2 phi = 0

The last two terms (Baumgarte stabilization, 1972) remove the drift of numerical integration; they vanish on phi = 0.

    phi of a LoopClosure         position of the second frame relative to the first, in the world's axes (3); of a weld
                                 also half the sum of the cross products of their axes, the rotation vector if small (3)
    phi of a PolynomialCoupling  q[follower] - offset - sum of coefficients[k] (q[leader] - offset)^k
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BAUMGARTE_RATE = 20.0
"""1/s, of the decay of a closure error: to 1 % within 0.33 s; stages of 0.1 s are still stable with RK4."""


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """Two frames that coincide."""

    name: str  # in a sentence, e.g. "equality 'coupler'"
    links: tuple[int, int]  # -1 for the world
    frames: np.ndarray  # (2, 4, 4) each in the frame of its link
    rigid: bool  # whether their orientations coincide too

    @property
    def rows(self) -> int:
        """Number of equations."""
        return 6 if self.rigid else 3


@dataclass(frozen=True)
class PolynomialCoupling:
    """A joint that follows another one by a polynomial."""

    name: str
    follower: int  # degrees of freedom
    leader: int
    offsets: tuple[float, float]  # of the follower and of the leader, rad or m
    coefficients: tuple[float, ...]  # (5,) of powers 0 to 4

    @property
    def dofs(self) -> tuple[int, int]:
        """Both degrees of freedom."""
        return self.follower, self.leader


def baumgarte_rate() -> float:
    """Rate of the Baumgarte stabilization in the kernels' tables, 1/s."""
    return BAUMGARTE_RATE
