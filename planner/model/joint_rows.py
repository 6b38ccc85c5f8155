"""Forces along rows of joint coordinates: friction loss of joints, and the springs, dampers and friction of tendons.

A fixed tendon is a weighted sum of hinges' and slides' coordinates; a joint's friction acts along the row that holds
the joint alone. With length = coefficients q and rate = coefficients qd, the joints feel coefficients' f of

    f = stiffness (rest - length, beyond either end of its rest) - damping rate - loss s(slope rate / loss)

    s(x) = x up to 1 - b, 1 from 1 + b, a parabola between, and odd                                    (b = BEND)

MuJoCo's friction loss is a constraint, the force -clip(D (a + beta rate), loss) with the acceleration a along the row,
D = d / ((1 - d) w) and the inverse inertia w of the row at qpos0. A joint that nothing else pushes so decays at d beta
per s. The plan has the same decay, slope = d beta / w, and the same loss beyond it: see model.mjcf.rows. Within the
cut-off MuJoCo holds a pushed joint nearer to still, since its law knows the push through a.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

BEND = 0.5
"""As of friction in contacts (planner.model.contact.laws)."""


@dataclass(frozen=True)
class FixedTendon:
    """A weighted sum of hinges' and slides' coordinates, and what acts along it; as data also a row of one joint.

    Attributes:
        name: "" where the file gives none.
        dofs: The degrees of freedom that it sums.
        coefficients: One for each, m or none.
        stiffness: N/m or N m/rad.
        rest: The lengths between which its spring is slack; both the same for one that never is.
        damping: N s/m or N m s/rad.
        friction_loss: N or N m.
        friction_slope: Of friction before it is cut off at the loss, as damping.
        range: Of the length, infinite where there is none: data only, as joint ranges are.
    """

    name: str
    dofs: tuple[int, ...]
    coefficients: tuple[float, ...]
    stiffness: float = 0.0
    rest: tuple[float, float] = (0.0, 0.0)
    damping: float = 0.0
    friction_loss: float = 0.0
    friction_slope: float = 0.0
    range: tuple[float, float] = (-math.inf, math.inf)

    @property
    def acts(self) -> bool:
        """Whether it has a force, and not a range alone."""
        return self.stiffness > 0.0 or self.damping > 0.0 or self.friction_loss > 0.0


def acting_rows(mechanism: Any) -> tuple[FixedTendon, ...]:
    """The rows of a mechanism along which a force acts: a joint's friction, then the tendons'."""
    losses = zip(mechanism.friction_loss, mechanism.friction_slope, strict=True)
    joints = (
        FixedTendon("", (i,), (1.0,), friction_loss=float(loss), friction_slope=float(slope))
        for i, (loss, slope) in enumerate(losses)
        if loss > 0.0
    )
    return (*joints, *(tendon for tendon in mechanism.tendons if tendon.acts))


def row_force(row: FixedTendon, length: Any, rate: Any) -> Any:
    """The force along a row, N or N m; of complex numbers too, since it is analytic but for its bends."""
    pull = np.where(np.real(length) < row.rest[0], row.rest[0] - length, 0.0)
    pull = np.where(np.real(length) > row.rest[1], row.rest[1] - length, pull)
    force = row.stiffness * pull - row.damping * rate
    if row.friction_loss > 0.0:
        x = row.friction_slope * rate / row.friction_loss
        size = np.abs(np.real(x))
        x = np.where(size < 1.0 + BEND, x, (1.0 + BEND) * np.sign(np.real(x)))
        side = np.sign(np.real(x))
        bent = np.where(size > 1.0 - BEND, side * x - (1.0 - BEND), 0.0)
        force = force - row.friction_loss * (x - side * bent**2 / (4.0 * BEND))
    return force


def row_forces(mechanism: Any, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """The applied force tau (..., nv) of all rows of a mechanism at q (..., nq), qd (..., nv)."""
    tau = np.zeros(np.shape(qd), dtype=np.result_type(q, qd))
    for row in acting_rows(mechanism):
        dofs, c = list(row.dofs), np.array(row.coefficients)
        length = q[..., mechanism.q_address[dofs]] @ c if row.stiffness > 0.0 else 0.0
        tau[..., dofs] += row_force(row, length, qd[..., dofs] @ c)[..., None] * c
    return tau


def without_friction(mechanism: Any) -> Any:
    """The same machine without friction loss of joints and tendons."""
    tendons = tuple(replace(tendon, friction_loss=0.0) for tendon in mechanism.tendons)
    return replace(mechanism, friction_loss=np.zeros(mechanism.nv), tendons=tendons)


def without_springs(row: FixedTendon) -> FixedTendon:
    """A row with its friction alone."""
    return replace(row, stiffness=0.0, damping=0.0)


def has_friction(mechanism: Any) -> bool:
    """Whether a joint or tendon of a mechanism has friction loss."""
    return any(row.friction_loss > 0.0 for row in acting_rows(mechanism))


def bent_springs(mechanism: Any) -> Iterator[FixedTendon]:
    """The tendons whose springs are slack between two lengths, so that their forces bend."""
    return (tendon for tendon in mechanism.tendons if tendon.stiffness > 0.0 and tendon.rest[0] < tendon.rest[1])
