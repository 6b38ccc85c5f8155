"""Couplings: equations that are linear in hinge and slide coordinates, and the coordinates that they leave free.

A gripper's second finger that mirrors the first, a joint that is locked, tendons whose lengths are in a fixed ratio:

    J q = c                     a row for each coupling, J constant
    q[dependent] = offset + G[dependent] q[independent],   qd = G qd[independent],   J G = 0
    qdd = G (G' M G)^-1 G' (tau - h)

Elimination chooses the dependent coordinates, so a row of G has a single 1 or the few numbers of an equation, and the
forces of the couplings, which do no work, fall out. States keep all coordinates: a motion that begins on J q = c and
J qd = 0 stays there in every integrator, because qdd does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from planner.base.errors import ModelError

CLOSED = 1e-6  # rad or m: a state that misses a coupling by more is not on it
_ROUNDING = 1e-12  # of a row's largest coefficient: what elimination leaves of nothing
_CONTRADICTION = 1e-9  # rad or m, of what redundant equations ask
_PIVOT_TOLERANCE = (
    1e-3  # of a row's largest coefficient: a coordinate with less is not solved for, whatever else speaks for it
)


@dataclass(frozen=True)
class Coupling:
    """sum of coefficients[k] q[dofs[k]] = constant, over degrees of freedom of hinges and slides.

    The first is the one that follows the others, where nothing speaks against it.
    """

    name: str  # in a sentence, e.g. "equality 'mimic'"
    dofs: tuple[int, ...]
    coefficients: tuple[float, ...]
    constant: float


@dataclass(frozen=True, eq=False)
class Reduction:
    """The coordinates that couplings leave free, nr of nv, and how the others follow them."""

    independent: np.ndarray  # (nr,) degrees of freedom
    dependent: np.ndarray  # (nv - nr,)
    G: np.ndarray  # (nv, nr)
    offset: np.ndarray  # (nv - nr,) of the dependent ones, rad or m

    def closed(self, q: np.ndarray, qd: np.ndarray, q_address: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copies of q (..., nq) and qd (..., nv) with the dependent coordinates where the independent ones put them."""
        q, qd, rows = q.copy(), qd.copy(), self.G[self.dependent].T
        q[..., q_address[self.dependent]] = self.offset + q[..., q_address[self.independent]] @ rows
        qd[..., self.dependent] = qd[..., self.independent] @ rows
        return q, qd


def reduce(couplings: Sequence[Coupling], nv: int, keep: np.ndarray) -> Reduction:
    """Solve the couplings for dependent coordinates, by elimination; redundant ones fall out.

    Args:
        couplings: At least one.
        nv: Degrees of freedom of the machine.
        keep: (nv,) True where a coordinate is to stay independent if it can: those with actuators, say.

    Raises:
        ModelError: Two couplings contradict each other, or they leave nothing free.
    """
    rows: list[np.ndarray] = []  # (nv + 1,) each with a 1 at its pivot and 0 at those of the others
    pivots: list[int] = []
    for coupling in couplings:
        row = np.zeros(nv + 1)
        np.add.at(row, list(coupling.dofs), coupling.coefficients)
        row[nv] = coupling.constant
        largest = float(np.abs(row[:nv]).max())
        for pivot, other in zip(pivots, rows, strict=True):
            row -= row[pivot] * other
        row[:nv][np.abs(row[:nv]) <= _ROUNDING * largest] = 0.0
        size = np.abs(row[:nv])
        if not size.any():
            if abs(row[nv]) > _CONTRADICTION * max(largest, 1.0):
                raise ModelError(
                    f"{coupling.name} contradicts the equalities before it by {abs(row[nv]):.3g} rad or m, expected "
                    'equations that hold together: active="false" switches one off.'
                )
            continue
        strong = np.flatnonzero(size >= _PIVOT_TOLERANCE * size.max())
        pivot = min(map(int, strong), key=partial(_preference, coupling, keep))
        row /= row[pivot]
        row[pivot] = 1.0
        for other in rows:
            other -= other[pivot] * row
            other[:nv][np.abs(other[:nv]) <= _ROUNDING] = 0.0
        rows.append(row)
        pivots.append(pivot)
    if len(pivots) == nv:
        raise ModelError("the equalities lock every joint, expected at least one that moves.")
    order = np.argsort(pivots)
    dependent = np.array(pivots, dtype=np.int64)[order]
    solved = np.array(rows).reshape(-1, nv + 1)[order]
    independent = np.setdiff1d(np.arange(nv), dependent)
    G = np.zeros((nv, len(independent)))
    G[independent, np.arange(len(independent))] = 1.0
    G[dependent] = 0.0 - solved[:, independent]  # and not -0.0
    return Reduction(independent, dependent, G, solved[:, nv].copy())


def _preference(coupling: Coupling, keep: np.ndarray, dof: int) -> tuple[bool, int]:
    """The least is solved for: what may follow, then what the coupling names first, and last what it does not name."""
    return bool(keep[dof]), coupling.dofs.index(dof) if dof in coupling.dofs else len(keep)
