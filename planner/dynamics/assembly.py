"""States of machines whose joints depend on each other: put them together, or say by how much they are apart.

Couplings give some coordinates from others (planner.model.couplings). Closed chains are put together by least
squares: Gauss and Newton's steps are the smallest that close the chains to first order, so the pose that is found is
near the one that was given.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.loops import jacobian, misses
from planner.model.couplings import CLOSED, check_closed, closed_state
from planner.model.mechanism import Mechanism

_CLOSE = 1e-13  # m or rad, of what is left of a miss
_STEPS = 100  # from far away; near a closed pose five are enough
_HALVINGS = 20  # of a step that would open the chains further
_LARGEST = 0.5  # rad or m, of a step in one coordinate: longer ones lead to poses that are nowhere near
_CARRIED = 0.1  # rad or m, of a step along a way: it does not turn a chain over
_PREFERRED = 10.0  # coordinates with actuators lead where they move the chain at all
_RANK_TOLERANCE = 1e-9  # of the largest singular value: a direction that closes less closes nothing


def assembled(mechanism: Mechanism, x: np.ndarray, given: Collection[int] = (), name: str = "the pose") -> np.ndarray:
    """The state (nx,) nearest to x that couplings and closed chains allow, as Gauss and Newton's steps find it.

    Degrees of freedom that are `given` keep their positions.

    Raises:
        PlannerError: No motion of the other joints closes the chains; with the state's name.
    """
    x = closed_state(mechanism, x, given)
    if not mechanism.has_closed_chains:
        return x
    nq, nv, space = mechanism.nq, mechanism.nv, mechanism.space
    free = _free(mechanism, given)
    miss = misses(mechanism, x[:nq])
    for _ in range(_STEPS):
        if np.abs(miss).max() <= _CLOSE:
            break
        step = np.zeros(space.ndx)
        step[:nv] = -free @ np.linalg.lstsq(jacobian(mechanism, x[:nq]) @ free, miss, rcond=_RANK_TOLERANCE)[0]
        step *= _LARGEST / max(float(np.abs(step).max()), _LARGEST)
        for _ in range(_HALVINGS):
            candidate = space.integrate(x, step)
            left = misses(mechanism, candidate[:nq])
            if np.linalg.norm(left) < np.linalg.norm(miss):
                break
            step *= 0.5
        else:
            break
        x, miss = candidate, left
    if np.abs(miss).max() > CLOSED:
        raise PlannerError(
            f"{name} {_apart(mechanism, miss)}, and no motion of the joints that may move closes it, expected a pose "
            'that does, or active="false" for the equality in the file.'
        )
    J = jacobian(mechanism, x[:nq]) @ free
    qd = x[nq : nq + nv]
    x[nq : nq + nv] = qd - free @ np.linalg.lstsq(J, jacobian(mechanism, x[:nq]) @ qd, rcond=_RANK_TOLERANCE)[0]
    return x


def assembled_along(
    mechanism: Mechanism, base: np.ndarray, x: np.ndarray, given: Collection[int], name: str = "the pose"
) -> np.ndarray:
    """The state (nx,) to which a machine comes from `base` when the joints that are given move to where x has them.

    A chain can often be put together in more than one way: small steps keep to that of the base. Where they get stuck,
    and for machines without closed chains, it is what `assembled` finds.

    Raises:
        PlannerError: As assembled.
    """
    if mechanism.has_closed_chains:
        way = mechanism.space.difference(x, base)
        parts = int(np.ceil(np.abs(way).max() / _CARRIED))
        stay = np.setdiff1d(np.arange(mechanism.nv), [*given])
        try:
            at = assembled(mechanism, base)
            for k in range(1, parts):
                step = mechanism.space.difference(mechanism.space.integrate(base, k / parts * way), at)
                step[stay], step[mechanism.nv :] = 0.0, 0.0
                at = assembled(mechanism, mechanism.space.integrate(at, step), given)
            step = mechanism.space.difference(x, at)
            step[stay] = 0.0
            return assembled(mechanism, mechanism.space.integrate(at, step), given)
        except PlannerError:
            pass
    return assembled(mechanism, x, given, name)


def _free(mechanism: Mechanism, given: Collection[int]) -> np.ndarray:
    """(nv, n) the directions in which joints that are not given may move on the couplings."""
    G = np.eye(mechanism.nv) if mechanism.reduction is None else mechanism.reduction.G
    stay = np.array([*given], dtype=int)
    return G[:, ~np.any(G[stay] != 0.0, axis=0)]


def feasible_directions(mechanism: Mechanism, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Z (nv, n), the directions that couplings and closed chains leave at q (nq,), and n coordinates that lead them.

    In the leading coordinates Z is 1: a velocity on the constraints is Z qd[leading].
    """
    reduction = mechanism.reduction
    G = np.eye(mechanism.nv) if reduction is None else reduction.G
    leading = np.arange(mechanism.nv) if reduction is None else reduction.independent
    if not mechanism.has_closed_chains:
        return G, leading
    from scipy.linalg import null_space, qr  # a fifth of a second that `import planner` does not pay

    N = null_space(jacobian(mechanism, q) @ G, rcond=_RANK_TOLERANCE)
    driven = np.any(mechanism.actuators.moment[:, leading] != 0.0, axis=0)
    order = qr(N.T * np.where(driven, _PREFERRED, 1.0), mode="r", pivoting=True)[-1]
    chosen = np.sort(order[: N.shape[1]])
    return G @ N @ np.linalg.inv(N[chosen]), leading[chosen]


def relative_min_singular_value(mechanism: Mechanism, qs: np.ndarray) -> np.ndarray:
    """How far closed chains are from losing an equation, (K,) for configurations qs (K, nq).

    The least singular value of J that is not of a redundant equation, over the largest. At zero a chain
    lies in line, say: it could go on in more than one way, and rounding decides which.
    """
    values = np.array([np.linalg.svd(jacobian(mechanism, q), compute_uv=False) for q in qs])
    shares = values / values[:, :1]
    return shares[:, int(np.count_nonzero(shares > _RANK_TOLERANCE, axis=1).max()) - 1]


def tangent_basis(mechanism: Mechanism, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T (ndx, n), the directions of states (dq, dv, dact) on the constraints at x (nx,), and where T is 1.

    A deviation dx on the constraints is T dx[places].
    """
    Z, leading = feasible_directions(mechanism, x[: mechanism.nq])
    (nv, n), na = Z.shape, mechanism.na
    T = np.zeros((2 * nv + na, 2 * n + na))
    T[:nv, :n] = T[nv : 2 * nv, n : 2 * n] = Z
    T[2 * nv :, 2 * n :] = np.eye(na)
    return T, np.concatenate([leading, nv + leading, 2 * nv + np.arange(na)])


def check_assembled(name: str, x: np.ndarray, mechanism: Mechanism, most: float = CLOSED) -> None:
    """Raise a PlannerError unless a state (nx,) misses no coupling and no closed chain by more than `most`."""
    check_closed(name, x, mechanism, most)
    if not mechanism.has_closed_chains:
        return
    q, qd = x[: mechanism.nq], x[mechanism.nq : mechanism.nq + mechanism.nv]
    miss = misses(mechanism, q)
    if np.abs(miss).max() > most:
        raise PlannerError(
            f"{name} {_apart(mechanism, miss)}, expected a pose that closes the chains: planner.dynamics.assembled("
            "mechanism, x) gives the nearest one."
        )
    speed = jacobian(mechanism, q) @ qd
    if np.abs(speed).max() > most:
        raise PlannerError(
            f"{name} has velocities that open the chains by {np.abs(speed).max():.3g} m/s or rad/s, expected "
            "velocities that keep them closed: planner.dynamics.assembled(mechanism, x) gives the nearest ones."
        )


def _apart(mechanism: Mechanism, miss: np.ndarray) -> str:
    """Which equality misses most, and by how much, as the rest of a sentence."""
    owners = [loop.name for loop in mechanism.loops for _ in range(loop.rows)] + [
        cam.name for cam in mechanism.polynomial_couplings
    ]
    worst = int(np.argmax(np.abs(miss)))
    return f"misses {owners[worst]} by {abs(miss[worst]):.3g} {_unit(mechanism, worst)}"


def _unit(mechanism: Mechanism, row: int) -> str:
    """Of a row of what is to be zero."""
    for loop in mechanism.loops:
        if row < loop.rows:
            return "m" if row < 3 else "rad"
        row -= loop.rows
    return "rad" if np.any(mechanism.S[mechanism.polynomial_couplings[row].follower, :3] != 0.0) else "m"
