"""Inverse kinematics: a configuration in which frames of a Mechanism reach target poses.

    minimize |r(q)|^2 + (POSTURE_WEIGHT |q - q_start|)^2   within the joint ranges

by SciPy's least_squares with our own Jacobian. r has a position error / metre_scale, a rotation vector log(R_ref' R) /
turn_scale or, for a direction, the difference of two unit vectors / turn_scale. The small posture term selects a
solution close to the start. The search begins at the start, then at random configurations. Where those that reach the
targets all fail a further criterion, it begins at random ones again and stays close to each of them. Closure errors
/ CLOSED are residuals too, and the result is projected onto the loop closures. A caller may add residuals (`missing`)
and a criterion (`short`) that ranks the configurations that reach all targets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, count
from planner.base.errors import PlannerError
from planner.dynamics import loops
from planner.dynamics.assembly import assembled
from planner.dynamics.kinematics import LinkPlaces
from planner.model.mechanism import SCREW, Frame, Mechanism
from planner.model.space import hat, log_jacobian

POSTURE_WEIGHT = 0.1  # 1/rad or 1/m; it displaces the frame by about 1e-4 of the tolerance
REACHED = 0.1  # scaled residual that ends the search
CLOSED = 1e-3  # m or rad, closure error of a residual of 1: a tenth of it makes the search slow
STARTS = 8
MORE_STARTS = 40  # default of `starts` with `short`


class Target(NamedTuple):
    """Target pose of a frame; None leaves a part unconstrained."""

    frame: str | Frame
    position: np.ndarray | None = None  # (3,) m, in the world
    orientation: np.ndarray | None = None  # (4,) unit quaternion, w first
    pointing: tuple[np.ndarray, np.ndarray] | None = None  # unit axis in the frame, target in the world
    metre_scale: float = 5e-3  # m, position error of a residual of 1
    turn_scale: float = 0.02  # rad, angle error of a residual of 1


class IKSolution(NamedTuple):
    """The configuration with the best rank."""

    q: np.ndarray  # (nq,)
    residual: float  # largest scaled residual
    short: float = 0.0  # violation of `missing` and `short`, 0 if satisfied
    distance: float = 0.0  # rad and m, of the deviation from q

    @property
    def rank(self) -> tuple[float, float, float, float]:
        """Sort key, minimum is best: residual (up to 1 equal), `short`, residual rounded to REACHED, distance.

        Of two ways to get there that are as good the one nearby is meant.
        """
        near = float(np.round(self.residual / REACHED)) if np.isfinite(self.residual) else np.inf
        return max(self.residual, 1.0), self.short, near, self.distance


def inverse_kinematics(
    mechanism: Mechanism, targets: Sequence[Target], q: Any, *, ranges: np.ndarray | None = None,
    free: np.ndarray | None = None, starts: int | None = None, seed: int = 0,
    short: Callable[[np.ndarray], float] | None = None,
    missing: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None,
) -> IKSolution:  # fmt: skip
    """A configuration with frames at target poses, close to q.

    Args:
        mechanism: The machine.
        targets: Target poses, to be reached simultaneously.
        q: (nq,) start of the search; it must satisfy the couplings.
        ranges: (nv, 2) of hinges and slides, rad or m; infinite if unlimited. By default those of the model.
        free: (nv,) bool, degrees of freedom that may change; all by default.
        starts: Largest number of starts: q, then random configurations within the ranges. By default STARTS, or
            MORE_STARTS with `short`.
        seed: Seed of the random configurations.
        short: Violation of a further criterion by a configuration (nq,), 0 if satisfied.
        missing: Further residuals of a configuration (nq,), over their tolerances: r (R,) and Jacobian (R, nv).

    Returns:
        The best configuration, whether it reaches the targets or not.

    Raises:
        PlannerError: A wrong shape, or an unknown frame.
    """
    q = array("q", q, (mechanism.nq,))
    starts = count("starts", starts if starts is not None else STARTS if short is None else MORE_STARTS)
    free = np.ones(mechanism.nv, dtype=bool) if free is None else np.asarray(free, dtype=bool)
    B, dofs = _directions(mechanism, free)
    low, high = (mechanism.joint_range if ranges is None else ranges).T
    closed = np.flatnonzero(~free) if mechanism.has_closed_chains else None

    def reached(begin: np.ndarray, near_begin: bool = False) -> IKSolution:
        found = _from(mechanism, targets, q, begin, B, dofs, (low, high), closed, missing, near_begin)
        lacks = 0.0 if missing is None else max(0.0, float(np.abs(missing(found.q)[0]).max(initial=0.0)) - 1.0)
        return found._replace(short=lacks + (0.0 if short is None else short(found.q)))

    found = reached(q)
    rng = np.random.default_rng(count("seed", seed, minimum=0))
    for near_begin in (False, True):
        for _ in range(starts - 1 if len(dofs) else 0):
            if found.residual < REACHED and found.short <= 0.0:
                return found
            begin = integrate_base(mechanism, q, B @ _random(mechanism, q, dofs, (low, high), rng))
            found = min(found, reached(begin, near_begin), key=lambda one: one.rank)
        if found.residual >= REACHED or found.short <= 0.0:
            break
    return found


def integrate_base(mechanism: Mechanism, q: np.ndarray, e: np.ndarray) -> np.ndarray:
    """The configuration q + e (nq,) on the group, of q (nq,) and a deviation e (nv,)."""
    x = np.concatenate([q, np.zeros(mechanism.space.nx - mechanism.nq)])
    return mechanism.space.integrate(x, np.concatenate([e, np.zeros(mechanism.space.ndx - mechanism.nv)]))[: len(q)]


def residuals(mechanism: Mechanism, q: np.ndarray, target: Target) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors r (n,), m or rad, of a target at q (nq,), their Jacobian (n, nv), and whether each is an angle (n,)."""
    at = LinkPlaces(mechanism, q)
    T, J = at.pose(target.frame)[0], at.jacobian(target.frame)[0]
    R, rows = T[:3, :3], []
    if target.position is not None:
        rows.append((T[:3, 3] - target.position, J[:3], False))
    if target.orientation is not None:
        from scipy.spatial.transform import Rotation  # 0.4 s that `planner run` need not pay

        reference = Rotation.from_quat(target.orientation[[1, 2, 3, 0]]).as_matrix()
        r = Rotation.from_matrix(reference.T @ R).as_rotvec()
        rows.append((r, log_jacobian(r) @ R.T @ J[3:], True))
    if target.pointing is not None:
        axis = R @ target.pointing[0]
        rows.append((axis - target.pointing[1], -hat(axis) @ J[3:], True))
    r, J = (np.concatenate([row[k] for row in rows]) for k in (0, 1))
    return r, J, np.repeat([row[2] for row in rows], 3)


def _directions(mechanism: Mechanism, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Basis B (nv, n) of the search directions, and the degree of freedom (n,) of each column."""
    kept = np.flatnonzero(free[mechanism.independent_dofs])
    return mechanism.independent_directions[:, kept], mechanism.independent_dofs[kept]


def _from(
    mechanism: Mechanism, targets: Sequence[Target], q: np.ndarray, begin: np.ndarray, B: np.ndarray, dofs: np.ndarray,
    ranges: tuple[np.ndarray, np.ndarray], closed: np.ndarray | None,
    missing: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None, near_begin: bool,
) -> IKSolution:  # fmt: skip
    """The minimum from `begin` (nq,), close to it or to q.

    `closed`: degrees of freedom fixed in loop closure, None without loops.
    """
    space, pad = mechanism.space, np.zeros(mechanism.space.ndx - mechanism.nv)

    def of_targets(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Errors of all targets, their Jacobian, and the errors of a residual of 1."""
        parts = [residuals(mechanism, at, target) for target in targets]
        size = [np.where(part[2], one.turn_scale, one.metre_scale) for part, one in zip(parts, targets, strict=True)]
        r, J = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        return r, J, np.concatenate(size)

    def stacked(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e = B @ y
        at = integrate_base(mechanism, q, e)
        r, J, size = of_targets(at)
        if closed is not None:
            r, J = np.append(r, loops.misses(mechanism, at)), np.vstack([J, loops.jacobian(mechanism, at)])
            size = np.append(size, np.full(len(r) - len(size), CLOSED))
        if missing is not None:
            lacks, by_e = missing(at)
            r, J, size = np.append(r, lacks), np.vstack([J, by_e]), np.append(size, np.ones(len(lacks)))
        own = np.linalg.inv(space.difference_jacobian(np.concatenate([e, pad]))[: mechanism.nv, : mechanism.nv])
        return r / size, (J @ own @ B) / size[:, None]

    def largest(y: np.ndarray) -> IKSolution:
        at = integrate_base(mechanism, q, B @ y)
        if closed is not None:
            try:
                at = assembled(mechanism, np.concatenate([at, pad, np.zeros(mechanism.nv)])[: space.nx], closed)
            except PlannerError:
                return IKSolution(at, np.inf)
        r, _, size = of_targets(at[: mechanism.nq])
        return IKSolution(at[: mechanism.nq], float(np.abs(r / size).max()))

    if not len(dofs):
        return largest(np.zeros(0))
    lean = POSTURE_WEIGHT * np.eye(len(dofs))
    low, high = _bounds(mechanism, q, dofs, ranges)
    x = np.concatenate([begin, np.zeros(space.nx - mechanism.nq)])
    x0 = np.concatenate([q, np.zeros(space.nx - mechanism.nq)])
    y = np.clip(space.difference(x, x0)[dofs], low, high)
    center = y if near_begin else np.zeros(len(dofs))
    last: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}  # SciPy evaluates the Jacobian where it evaluated r

    def both(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if y.tobytes() not in last:
            last.clear()
            last[y.tobytes()] = stacked(y)
        return last[y.tobytes()]

    from scipy.optimize import least_squares  # 0.4 s that `planner run` need not pay

    done = least_squares(
        lambda y: np.concatenate([both(y)[0], POSTURE_WEIGHT * (y - center)]), y,
        lambda y: np.concatenate([both(y)[1], lean]),  # pyright: ignore
        bounds=(low, high), xtol=1e-9, ftol=1e-9, gtol=1e-9, max_nfev=100,
    )  # fmt: skip
    return largest(done.x)._replace(distance=float(np.linalg.norm(done.x)))


def _bounds(
    mechanism: Mechanism, q: np.ndarray, dofs: np.ndarray, ranges: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds (n,) of deviations from q; a start outside of its range may stay there."""
    screw = mechanism.kind[dofs] == SCREW
    here = np.where(screw, q[mechanism.q_address[dofs]], 0.0)
    low, high = (np.where(screw, side[dofs] - here, end) for side, end in zip(ranges, (-np.inf, np.inf), strict=True))
    return np.minimum(low, -1e-9), np.maximum(high, 1e-9)


def _random(
    mechanism: Mechanism, q: np.ndarray, dofs: np.ndarray, ranges: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """A random deviation (n,) within the ranges, and within pi rad or 1 m."""
    turns = np.any(mechanism.S[dofs, :3] != 0.0, axis=1)
    reach = np.where(turns, np.pi, 1.0)
    low, high = _bounds(mechanism, q, dofs, ranges)
    return rng.uniform(np.maximum(low, -reach), np.minimum(high, reach))
