"""Couplings and loop closures: equations of the coordinates of a tree (section 1.2), linear ones and others.

Couplings are linear equations of hinge and slide coordinates, solved for dependent coordinates.

Examples: a gripper finger that mirrors the other, a locked joint, tendons with a fixed ratio of lengths.

    J q = c                     a row for each coupling, J constant
    q[dependent] = offset + G[dependent] q[independent],   qd = G qd[independent],   J G = 0
    qdd = G (G' M G)^-1 G' (tau - h)

Gaussian elimination chooses the dependent coordinates, so G is sparse; G' eliminates the coupling forces, which do no
work. States contain all coordinates: a trajectory that starts on J q = c, J qd = 0 satisfies both in every integrator,
since J qdd = 0.

Joint ranges: in a coupling sum c_k q_k = constant each coordinate is limited to the interval that the ranges of the
others allow, iterated to a fixed point. The intervals are never too narrow, and exact for two coordinates.

Other equations phi(q) = 0 close chains:

    LoopClosure         two frames of the machine, or one and the world, coincide in position (MuJoCo's connect) or
                        also in orientation (weld)
    PolynomialCoupling  a joint coordinate is a polynomial of another one (MuJoCo's nonlinear joint equality)

They eliminate no coordinate; they add constraint forces f, with J the derivative of phi:

    M qdd + h = tau + J'f,   J qdd + Jdot qd + 2 rate phidot + rate^2 phi = 0

The last two terms (Baumgarte stabilization, 1972) remove the drift of numerical integration; they vanish on phi = 0.

    phi of a LoopClosure         position of the second frame relative to the first, in the world's axes (3); of a weld
                                 also half the sum of the cross products of their axes, the rotation vector if small (3)
    phi of a PolynomialCoupling  q[follower] - offset - sum of coefficients[k] (q[leader] - offset)^k
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import ModelError, PlannerError

CLOSED = 1e-6  # rad or m, tolerance of the coupling equations
_ROUNDING = 1e-12  # relative to a row's largest coefficient: smaller entries are rounding errors of the elimination
_CONTRADICTION = 1e-9  # rad or m, largest difference of the constants of redundant equations
_PIVOT_TOLERANCE = 1e-3  # relative to a row's largest coefficient: smaller coefficients are not used as pivots
BAUMGARTE_RATE = 20.0
"""Decay rate of a closure error, 1/s: to 1 % within 0.33 s; RK4 is stable with stages of up to 0.1 s."""


def baumgarte_rate() -> float:
    """BAUMGARTE_RATE for the kernels' tables, 1/s: kernels import no constants from outside."""
    return BAUMGARTE_RATE


@dataclass(frozen=True)
class Coupling:
    """Linear equation sum_k coefficients[k] q[dofs[k]] = constant of hinge and slide coordinates.

    dofs[0] becomes the dependent coordinate, unless it is actuated or its coefficient is too small for a pivot.
    """

    name: str  # for messages, e.g. "equality 'mimic'"
    dofs: tuple[int, ...]
    coefficients: tuple[float, ...]
    constant: float


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


@dataclass(frozen=True, eq=False)
class Reduction:
    """The nr independent of nv coordinates, and the linear map to the dependent ones."""

    independent: np.ndarray  # (nr,) indices of degrees of freedom
    dependent: np.ndarray  # (nv - nr,) indices of degrees of freedom
    G: np.ndarray  # (nv, nr) qd = G qd[independent]
    offset: np.ndarray  # (nv - nr,) constants of the dependent coordinates, rad or m

    def closed(self, q: np.ndarray, qd: np.ndarray, q_address: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copies of q (..., nq) and qd (..., nv) with the dependent coordinates computed from the independent ones."""
        q, qd, rows = q.copy(), qd.copy(), self.G[self.dependent].T
        q[..., q_address[self.dependent]] = self.offset + q[..., q_address[self.independent]] @ rows
        qd[..., self.dependent] = qd[..., self.independent] @ rows
        return q, qd


def reduce(couplings: Sequence[Coupling], nv: int, keep: np.ndarray) -> Reduction:
    """Solve the couplings for dependent coordinates, by Gaussian elimination; redundant couplings are dropped.

    Args:
        couplings: At least one.
        nv: Degrees of freedom of the machine.
        keep: (nv,) bool, coordinates to leave independent if possible, e.g. actuated ones.

    Raises:
        ModelError: Couplings contradict each other, or leave no independent coordinate.
    """
    rows: list[np.ndarray] = []  # (nv + 1,) each with 1 at its own pivot and 0 at all other pivots
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
    G[dependent] = 0.0 - solved[:, independent]  # 0.0 - x avoids -0.0
    return Reduction(independent, dependent, G, solved[:, nv].copy())


def _preference(coupling: Coupling, keep: np.ndarray, dof: int) -> tuple[bool, int]:
    """Sort key of pivot candidates, minimum first: not in `keep`, then by position in coupling.dofs, others last."""
    return bool(keep[dof]), coupling.dofs.index(dof) if dof in coupling.dofs else len(keep)


_ROUNDS = 50
_SLIGHT = 1e-6  # rad or m, tolerance of a contradiction


def fixed_dofs(mechanism: Any, ranges: np.ndarray) -> np.ndarray:
    """(nv,) whether couplings and `ranges` (nv, 2) together leave a degree of freedom one value, and its range more."""
    return (np.ptp(narrowed(mechanism, ranges)[0], axis=1) < _SLIGHT) & (np.ptp(ranges, axis=1) > _SLIGHT)


class Contradiction(NamedTuple):
    """A coupling that no pose within the joint ranges satisfies."""

    cause: str  # sentence without a full stop
    fix: str  # text to write into the model file

    def __str__(self) -> str:
        return f"{self.cause}, expected ranges with a pose that keeps it: write {self.fix}."


def contradiction(mechanism: Any, ranges: np.ndarray) -> Contradiction | None:
    """A coupling that no pose within the ranges (nv, 2) satisfies, and its fix; None if there is none."""
    left, at = narrowed(mechanism, ranges)
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


def narrowed(mechanism: Any, ranges: np.ndarray) -> tuple[np.ndarray, int | None]:
    """The part (nv, 2) of `ranges` (nv, 2) that the couplings allow, rad or m, and the coupling that none allows."""
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
    """Interval of the k-th coordinate of a coupling, given the ranges (nv, 2) of its other coordinates."""
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
    """The state (nx,) with the dependent coordinates computed from the independent ones.

    Positions of the degrees of freedom in `given` are unchanged, even if they violate a coupling: see check_closed.
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
    """Raise a PlannerError with the expected value if a state (nx,) violates a coupling by more than `most`."""
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
    others = [
        mechanism.joint_of(int(i)) for i in mechanism.reduction.independent[np.flatnonzero(mechanism.reduction.G[dof])]
    ]
    turns = bool(np.any(mechanism.S[dof, :3] != 0.0))
    unit = ("rad" if turns else "m") + ("/s" if worst >= len(dependent) else "")
    what = "velocity" if worst >= len(dependent) else "position"
    why = f"follows {' and '.join(others)}" if others else "is locked"
    raise PlannerError(
        f"{name} has the {what} {given[worst]:.6g} {unit} of {mechanism.joint_of(dof)}, which {why}: expected "
        f"{wanted[worst]:.9g}, {missed[worst]:.3g} {unit} away."
    )
