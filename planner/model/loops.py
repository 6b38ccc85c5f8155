"""Closed chains: algebraic constraints on a tree (section 1.2). Data only.

    Loop    two frames of the machine, or of the machine and the world, stay in one place (MuJoCo's connect) or also
            keep their rotation to each other (weld)
    Cam     a joint follows another one by a polynomial (MuJoCo's equality of joints that is not linear)

Equations that are linear in the coordinates are couplings (planner.model.couplings), which take coordinates away. These
take none away: their forces f act, J the derivative of what is to be zero, phi(q):

    M qdd + h = tau + J'f,   J qdd + Jdot qd + 2 rate phidot + rate^2 phi = 0

The last two terms (Baumgarte, 1972) pull a state that integration has carried off back onto phi = 0. On it they are
zero.

    phi of a Loop   the second frame's place to the first one's, in the world's axes (3); of a weld also half the sum of
                    the cross products of their axes, which is their rotation for small ones (3)
    phi of a Cam    q[follower] - offset - sum of coefficients[k] (q[leader] - offset)^k
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BAUMGARTE_RATE = (
    20.0  # 1/s: a miss falls to a hundredth within a third of a second, and a stage of 0.1 s is still stable by RK4
)


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """Two frames that are held together."""

    name: str  # in a sentence, e.g. "equality 'coupler'"
    links: tuple[int, int]  # -1 for the world
    frames: np.ndarray  # (2, 4, 4) each in the frame of its link
    rigid: bool  # whether their rotation is held too

    @property
    def rows(self) -> int:
        """How many equations."""
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
    """The rate, 1/s, by which kernels pull states back onto the constraints; a number of their tables."""
    return BAUMGARTE_RATE
