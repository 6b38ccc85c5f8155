"""Couplings: equations that are linear in hinge and slide coordinates, and the coordinates that they leave free.

A gripper's second finger that mirrors the first, a joint that is locked, tendons whose lengths are in a fixed ratio:

    J q = c                     a row for each coupling, J constant
    q[dependent] = offset + G[dependent] q[independent],   qd = G qd[independent],   J G = 0
    qdd = G (G' M G)^-1 G' (tau - h)

Elimination chooses the dependent coordinates, so a row of G has a single 1 or the few numbers of an equation, and the
forces of the couplings, which do no work, fall out. States keep all coordinates: a motion that begins on J q = c and
J qd = 0 stays there in every integrator, because qdd does.

Ranges of joints: of a coupling sum c_k q_k = constant each coordinate keeps the interval that the ranges of the others
leave it. That is repeated until nothing changes: a bound that is never too narrow, and exact for two coordinates.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import ModelError, PlannerError

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


_ROUNDS = 50
_SLIGHT = 1e-6  # rad or m: a contradiction by less is none


def narrowed(mechanism: Any, ranges: np.ndarray) -> np.ndarray:
    """The ranges (nv, 2) that the couplings leave of `ranges`, lower ends first."""
    return _narrowed(mechanism, ranges)[0]


class Contradiction(NamedTuple):
    """A coupling that no pose within the ranges keeps."""

    cause: str  # a sentence without its full stop
    fix: str  # what to write in the file instead

    def __str__(self) -> str:
        return f"{self.cause}, expected ranges with a pose that keeps it: write {self.fix}."


def contradiction(mechanism: Any, ranges: np.ndarray) -> Contradiction | None:
    """The coupling that no pose within the ranges (nv, 2) keeps, and the range that would do; None where one does."""
    left, at = _narrowed(mechanism, ranges)
    if at is None:
        return None
    coupling = mechanism.couplings[at]
    low, high = _of_others(coupling, 0, left)
    terms = " + ".join(
        f"{c:g} {_name(mechanism, d)}" for c, d in zip(coupling.coefficients, coupling.dofs, strict=True)
    ).replace("+ -", "- ")
    own = ", ".join(f"{_name(mechanism, d)} {ranges[d, 0]:.6g} ... {ranges[d, 1]:.6g}" for d in coupling.dofs)
    fix = 'active="false" for the equality, or angle="radian" in <compiler> if radians are meant'
    if np.isfinite([low, high]).all():
        fix = f'range="{low:.6g} {high:.6g}" for {mechanism.joint_of(coupling.dofs[0])} in the file, {fix}'
    return Contradiction(
        f"the file contradicts itself: {coupling.name} asks {terms} = {coupling.constant:.6g}, which its ranges never "
        f"give ({own})",
        fix,
    )


def _narrowed(mechanism: Any, ranges: np.ndarray) -> tuple[np.ndarray, int | None]:
    left = np.array(ranges, dtype=float)
    for _ in range(_ROUNDS):
        before = left.copy()
        for at, coupling in enumerate(mechanism.couplings):
            for k, dof in enumerate(coupling.dofs):
                low, high = _of_others(coupling, k, left)
                if low > left[dof, 1] + _SLIGHT or high < left[dof, 0] - _SLIGHT:
                    return before, at
                ends = np.clip([low, high], *left[dof])
                left[dof] = ends
        if np.array_equal(before, left):
            break
    return left, None


def _of_others(coupling: Any, k: int, ranges: np.ndarray) -> tuple[float, float]:
    """What the others leave coordinate k of a coupling."""
    low = high = coupling.constant
    for j, (dof, c) in enumerate(zip(coupling.dofs, coupling.coefficients, strict=True)):
        if j != k:
            ends = sorted(float(c * end) for end in ranges[dof])
            low, high = low - ends[1], high - ends[0]
    first, last = sorted((low / coupling.coefficients[k], high / coupling.coefficients[k]))
    return first, last


def _name(mechanism: Any, dof: int) -> str:
    return mechanism.joint_of(dof).removeprefix("joint ").strip("'")


def closed_state(mechanism: Any, x: np.ndarray, given: Collection[int] = ()) -> np.ndarray:
    """The state (nx,) with the coordinates that follow others where these put them.

    Degrees of freedom that are `given` stay where they are, even if they contradict a coupling: see check_closed.
    """
    reduction = _reduction(mechanism, given)
    if reduction is None:
        return x.copy()
    closed, stay = _closed(mechanism, reduction, x), mechanism.q_address[np.array([*given], dtype=int)]
    closed[stay] = x[stay]
    return closed


def _reduction(mechanism: Any, given: Collection[int]) -> Reduction | None:
    if mechanism.reduction is None or not given:
        return mechanism.reduction
    keep = np.zeros(mechanism.nv, dtype=bool)
    keep[list(given)] = True
    return reduce(mechanism.couplings, mechanism.nv, keep)


def _closed(mechanism: Any, reduction: Reduction, x: np.ndarray) -> np.ndarray:
    q, qd, act = np.split(x, [mechanism.nq, mechanism.nq + mechanism.nv])
    return np.concatenate([*reduction.closed(q, qd, mechanism.q_address), act])


def check_closed(name: str, x: np.ndarray, mechanism: Any, most: float = CLOSED) -> None:
    """Raise a PlannerError with the value to write, unless a state (nx,) misses no coupling by more than `most`."""
    if mechanism.reduction is None:
        return
    dependent, nq = mechanism.reduction.dependent, mechanism.nq
    at = np.concatenate([mechanism.q_address[dependent], nq + dependent])
    wanted, given = _closed(mechanism, mechanism.reduction, x)[at], x[at]
    missed = np.abs(wanted - given)
    if np.all(missed <= most):
        return
    worst = int(np.nanargmax(missed))
    dof = int(dependent[worst % len(dependent)])
    others = [mechanism.joint_of(int(i)) for i in mechanism.reduction.independent[_followed(mechanism, dof)]]
    turns = bool(np.any(mechanism.S[dof, :3] != 0.0))
    unit = ("rad" if turns else "m") + ("/s" if worst >= len(dependent) else "")
    what = "velocity" if worst >= len(dependent) else "position"
    why = f"follows {' and '.join(others)}" if others else "is locked"
    raise PlannerError(
        f"{name} has the {what} {given[worst]:.6g} {unit} of {mechanism.joint_of(dof)}, which {why}: expected "
        f"{wanted[worst]:.9g}, {missed[worst]:.3g} {unit} away."
    )


def _followed(mechanism: Any, dof: int) -> np.ndarray:
    assert mechanism.reduction is not None  # who asks has couplings
    return np.flatnonzero(mechanism.reduction.G[dof])
