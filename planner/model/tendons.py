"""FixedTendon: a weighted sum of joint coordinates with a spring, a damper and a range. Data, and its force in NumPy.

With length = coefficients q and rate = coefficients qd, the generalized force is coefficients' f,

    f = stiffness (nearer end of rest - length if outside of rest, else 0) - damping rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class FixedTendon:
    """A weighted sum of hinge and slide coordinates, with spring, damper and range.

    Attributes:
        name: "" if unnamed in the file.
        dofs: The degrees of freedom that it sums.
        coefficients: One per entry of dofs.
        stiffness: N/m, or N m/rad where the coefficients have no unit.
        rest: Lower and upper end of the interval of lengths in which the spring is slack; equal if it never is.
        damping: N s/m or N m s/rad.
        range: Lower and upper limit of the length, infinite if unlimited: data only, as joint ranges are.
    """

    name: str
    dofs: tuple[int, ...]
    coefficients: tuple[float, ...]
    stiffness: float = 0.0
    rest: tuple[float, float] = (0.0, 0.0)
    damping: float = 0.0
    range: tuple[float, float] = (-math.inf, math.inf)

    @property
    def acts(self) -> bool:
        """Whether it has stiffness or damping, not only a range."""
        return self.stiffness > 0.0 or self.damping > 0.0


def acting_tendons(mechanism: Any) -> tuple[FixedTendon, ...]:
    """The tendons of a mechanism with stiffness or damping."""
    return tuple(tendon for tendon in mechanism.tendons if tendon.acts)


def slack_tendons(mechanism: Any) -> Iterator[FixedTendon]:
    """The tendons with a slack interval, at whose ends the spring force is nonsmooth."""
    return (tendon for tendon in mechanism.tendons if tendon.stiffness > 0.0 and tendon.rest[0] < tendon.rest[1])


def tendon_forces(mechanism: Any, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Generalized force tau (..., nv) of all tendons at q (..., nq), qd (..., nv), which may be complex."""
    tau = np.zeros(np.shape(qd), dtype=np.result_type(q, qd))
    for tendon in acting_tendons(mechanism):
        dofs, c = list(tendon.dofs), np.array(tendon.coefficients)
        length, rate = q[..., mechanism.q_address[dofs]] @ c, qd[..., dofs] @ c
        low, high = tendon.rest
        pull = np.where(np.real(length) < low, low - length, np.where(np.real(length) > high, high - length, 0.0))
        tau[..., dofs] += (tendon.stiffness * pull - tendon.damping * rate)[..., None] * c
    return tau
