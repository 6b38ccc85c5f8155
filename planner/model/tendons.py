"""FixedTendon: a weighted sum of joint coordinates with a spring, a damper and a range. Data, and its force in NumPy.

With length = coefficients q and rate = coefficients qd, the joints feel coefficients' f of

    f = stiffness (rest - length, beyond either end of its rest) - damping rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class FixedTendon:
    """A weighted sum of hinges' and slides' coordinates, and what acts along it.

    Attributes:
        name: "" where the file gives none.
        dofs: The degrees of freedom that it sums.
        coefficients: One for each.
        stiffness: N/m, or N m/rad where the coefficients have no unit.
        rest: The lengths between which its spring is slack; both the same for one that never is.
        damping: N s/m or N m s/rad.
        range: Of the length, infinite where there is none: data only, as joint ranges are.
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
        """Whether it has a force, and not a range alone."""
        return self.stiffness > 0.0 or self.damping > 0.0


def acting_tendons(mechanism: Any) -> tuple[FixedTendon, ...]:
    """The tendons of a mechanism that have a force."""
    return tuple(tendon for tendon in mechanism.tendons if tendon.acts)


def slack_tendons(mechanism: Any) -> Iterator[FixedTendon]:
    """The tendons whose springs are slack between two lengths: their forces bend there."""
    return (tendon for tendon in mechanism.tendons if tendon.stiffness > 0.0 and tendon.rest[0] < tendon.rest[1])


def tendon_forces(mechanism: Any, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """The applied force tau (..., nv) of all tendons at q (..., nq), qd (..., nv), which may be complex."""
    tau = np.zeros(np.shape(qd), dtype=np.result_type(q, qd))
    for tendon in acting_tendons(mechanism):
        dofs, c = list(tendon.dofs), np.array(tendon.coefficients)
        length, rate = q[..., mechanism.q_address[dofs]] @ c, qd[..., dofs] @ c
        low, high = tendon.rest
        pull = np.where(np.real(length) < low, low - length, np.where(np.real(length) > high, high - length, 0.0))
        tau[..., dofs] += (tendon.stiffness * pull - tendon.damping * rate)[..., None] * c
    return tau
