"""Loop closures: algebraic constraints phi(q) = 0 on a tree (section 1.2). Data only.

    LoopClosure         two frames of the machine, or one and the world, coincide in position (MuJoCo's connect) or
                        also in orientation (weld)
    PolynomialCoupling  a joint coordinate is a polynomial of another one (MuJoCo's nonlinear joint equality)

Equations that are linear in the coordinates are couplings (planner.model.couplings), which eliminate coordinates.
These eliminate none; they add constraint forces f, with J the derivative of phi:

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
"""Decay rate of a closure error, 1/s: to 1 % within 0.33 s; RK4 is stable with stages of up to 0.1 s."""


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """Two frames that coincide in position or, if rigid, in pose."""

    name: str  # for messages, e.g. "equality 'coupler'"
    links: tuple[int, int]  # -1 for the world
    frames: np.ndarray  # (2, 4, 4) poses, each in the frame of its link
    rigid: bool  # whether their orientations coincide too

    @property
    def rows(self) -> int:
        """Number of equations."""
        return 6 if self.rigid else 3


@dataclass(frozen=True)
class PolynomialCoupling:
    """A joint coordinate that is a polynomial of another one."""

    name: str
    follower: int  # index of the dependent degree of freedom
    leader: int  # index of the other
    offsets: tuple[float, float]  # of the follower and of the leader, rad or m
    coefficients: tuple[float, ...]  # (5,) of powers 0 to 4

    @property
    def dofs(self) -> tuple[int, int]:
        """Degrees of freedom of the follower and the leader."""
        return self.follower, self.leader


def baumgarte_rate() -> float:
    """Rate of the Baumgarte stabilization in the kernels' tables, 1/s."""
    return BAUMGARTE_RATE
