"""Ranges of fixed tendons as a plan keeps them: constraints that are linear in the coordinates.

    low <= c'q <= high    at every knot, with low and high off the ends by a margin, as joint ranges are

c'q is divided by the largest |c|, so that margins and tolerances in rad or m mean of a tendon what they mean of its
joints. A tendon whose range the ranges of its joints keep already has none; nor has one whose length equalities hold
within its range, often at its very end: MuJoCo's equalities give way a little, and no motion can help that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.model.coordinates import ANGLE, LENGTH, Coordinate
from planner.model.mechanism import Mechanism
from planner.model.space import space_of
from planner.model.tendons import FixedTendon
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.quantities import machine_of
from planner.problem.joint_limits import Range, margin_of

_ROUNDING = 1e-9  # rad or m


def tendon_ranges(
    mechanism: Mechanism, margin: Any, given: Mapping[str, Range], of_joints: Mapping[int, Range]
) -> list[tuple[TendonLength, Range]]:
    """The ranges of tendons that bound a plan, less the margin.

    Args:
        mechanism: Of the plan.
        margin: Of the limits: a number, a table by joints and tendons, or None.
        given: Ranges by the names of tendons that take the place of the model's.
        of_joints: Ranges of joints by degree of freedom, which the plan keeps.
    """
    found = []
    for tendon in mechanism.tendons:
        length = TendonLength(tendon, mechanism)
        if _is_held(length):
            continue
        kept = given.get(tendon.name) or _of_model(length, margin)
        ends = [[(one.low, one.high) if (one := of_joints.get(i)) else (-np.inf, np.inf)] for i in tendon.dofs]
        reached = np.sort(length.coefficients[:, None] * np.concatenate(ends), axis=1).sum(axis=0)
        if reached[0] < kept.low or reached[1] > kept.high:
            found.append((length, kept))
    return found


def _is_held(length: TendonLength) -> bool:
    """Whether equalities alone hold a tendon, at a length within its own range."""
    reduction = length.mechanism.reduction
    if reduction is None:
        return False
    c = np.zeros(length.mechanism.nv)
    np.add.at(c, list(length.tendon.dofs), length.coefficients)
    if np.any(np.abs(c @ reduction.G) > _ROUNDING):
        return False
    low, high = np.array(length.tendon.range) / length.scale
    return bool(low - _ROUNDING <= c[reduction.dependent] @ reduction.offset <= high + _ROUNDING)


def kept_tendon(length: TendonLength, kept: Range, start: np.ndarray, goal: np.ndarray | None, tolerance: float) -> Any:
    """The constraint of a tendon, with a bound that a start or a goal within the margin moves out to it.

    Raises:
        PlannerError: A start, or a goal (nx,) if there is one, outside of the range.
    """
    for what, x in (("start", start), ("goal", goal)):
        if x is None:
            continue
        value = float(length.of(x[None])[0])
        room = kept.widened_to(value)
        if room is None:
            scaled = Range(*(end * length.scale for end in kept[:4]), of_model=kept.of_model)
            own, said = value * length.scale, f"the {what} has {length} at {value * length.scale:.6g}"
            raise PlannerError(said + scaled.refusal(Coordinate(length.tendon.name, ""), own))
        kept = room
    lower, upper = (end if np.isfinite(end) else None for end in (kept.low, kept.high))
    return Constraint(length, lower=lower, upper=upper, tolerance=tolerance, name=f"range of {length}")


def _of_model(length: TendonLength, margin: Any) -> Range:
    low, high = np.array(length.tendon.range) / length.scale
    given = margin.get(length.tendon.name) if isinstance(margin, Mapping) else margin
    keep = min(margin_of(high - low, length.unit, given), 0.5 * (high - low))
    return Range(low + keep, high - keep, low, high, of_model=True)


@dataclass(frozen=True, eq=False)
class TendonLength:
    """The length of a fixed tendon over its largest coefficient: a row for a constraint."""

    tendon: FixedTendon
    mechanism: Mechanism

    def __str__(self) -> str:
        return f"tendon {self.tendon.name!r}"

    @property
    def scale(self) -> float:
        """The largest of its |coefficients|."""
        return float(np.abs(self.tendon.coefficients).max())

    @property
    def coefficients(self) -> np.ndarray:
        """(k,) of its degrees of freedom, the largest 1 or -1."""
        return np.array(self.tendon.coefficients) / self.scale

    @property
    def unit(self) -> str:
        """Of the joint with the largest coefficient."""
        dof = self.tendon.dofs[int(np.argmax(np.abs(self.tendon.coefficients)))]
        return ANGLE if np.any(self.mechanism.S[dof, :3]) else LENGTH

    def of(self, xs: np.ndarray) -> np.ndarray:
        """(K,) of states (K, nx)."""
        return xs[:, self.mechanism.q_address[list(self.tendon.dofs)]] @ self.coefficients

    def measure(self, dynamics: Dynamics, N: int) -> TendonMeasure:
        """Of a machine."""
        machine_of(dynamics, self)
        return TendonMeasure(self, dynamics)


class TendonMeasure:
    """The row of a TendonLength: the same derivative everywhere."""

    rows, of_controls = 1, False

    def __init__(self, length: TendonLength, dynamics: Dynamics) -> None:
        self._length, self.same = length, id(length)
        self._ndx, self._nu = space_of(dynamics).ndx, dynamics.nu

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, 1)."""
        return self._length.of(xs)[:, None]

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and zeros (K, 1, nu)."""
        by_x = np.zeros((len(xs), 1, self._ndx))
        by_x[:, 0, list(self._length.tendon.dofs)] = self._length.coefficients
        return by_x, np.zeros((len(xs), 1, self._nu))
