"""Project states onto couplings and loop closures, or check that they satisfy them.

Couplings determine the dependent coordinates (planner.model.couplings). Loop closures are solved by Gauss-Newton with
minimum-norm steps, so the result is close to the given pose.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, number
from planner.base.errors import PlannerError
from planner.dynamics.loops import jacobian, misses
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.couplings import CLOSED, check_closed, closed_state
from planner.model.mechanism import BALL, Mechanism

_CLOSE = 1e-13  # m or rad, closure error at convergence
_STEPS = 100  # largest number of Gauss-Newton iterations; five suffice close to a solution
_HALVINGS = 20  # largest number of halvings of a step that increases the closure error
_LARGEST = 0.5  # rad or m, largest change of a coordinate in an iteration: longer steps end at distant poses
_CARRIED = 0.1  # rad or m, largest change of a coordinate in a continuation step: it stays on the assembly branch
_PREFERRED = 10.0  # weight of actuated coordinates in the choice of independent ones
_RANK_TOLERANCE = 1e-9  # relative to the largest singular value: rank of the constraint Jacobian


def assembled(mechanism: Mechanism, x: np.ndarray, given: Collection[int] = (), name: str = "the pose") -> np.ndarray:
    """A state (nx,) close to x (nx,) that satisfies couplings and loop closures, by Gauss-Newton.

    Positions of the degrees of freedom in `given` are unchanged; velocities are projected onto the constraints.

    Raises:
        PlannerError: The other joints cannot satisfy the loop closures; the message calls the state `name`.
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
    qd = x[mechanism.velocities]
    x[mechanism.velocities] = qd - free @ np.linalg.lstsq(J, jacobian(mechanism, x[:nq]) @ qd, rcond=_RANK_TOLERANCE)[0]
    return x


def assembled_along(
    mechanism: Mechanism, base: np.ndarray, x: np.ndarray, given: Collection[int], name: str = "the pose"
) -> np.ndarray:
    """The assembled state (nx,) reached by continuation from `base` (nx,), as the joints `given` move to those of x.

    Loop closures often have several solutions: small steps stay on the assembly branch of `base`. If they fail, or
    without loop closures, the result is that of `assembled`.

    Raises:
        PlannerError: See assembled.
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


def with_joints(name: str, table: Mapping[str, Any], mechanism: Mechanism, base: np.ndarray) -> np.ndarray:
    """The assembled state (nx,) of `base` (nx,) with the positions of some joints changed.

    Args:
        name: What it is, for messages.
        table: By joint, rad or m; four numbers of a ball joint, seven of a free one.
        mechanism: The machine.
        base: Where the other joints are.

    Raises:
        PlannerError: No such joint, another number of positions, or joints that the others cannot follow.
    """
    x, given = base.copy(), set()
    for joint, position in table.items():
        links = mechanism.joint(choice(f"a joint in {name}", joint, [n for n in mechanism.joint_names if n]))
        place = int(mechanism.q_address[links.start])
        size = 7 if links.stop - links.start == 6 else 4 if mechanism.kind[links.start] == BALL else 1
        label = f"{name} of {joint}"
        given.add(links.start)
        x[place : place + size] = array(label, position, (size,)) if size > 1 else number(label, position)
    x = assembled_along(mechanism, base, x, given, name)
    check_assembled(name, x, mechanism)
    return x


def _free(mechanism: Mechanism, given: Collection[int]) -> np.ndarray:
    """(nv, n) basis of the velocities that satisfy the couplings with the joints in `given` fixed."""
    G = mechanism.independent_directions
    stay = np.array([*given], dtype=int)
    return G[:, ~np.any(G[stay] != 0.0, axis=0)]


def closed_chains(mechanism: Mechanism) -> list[np.ndarray]:
    """(nv,) bool each: the degrees of freedom of every closed chain, of those that share some together.

    A chain is what moves one of two places that a loop holds together, and not the other, or a polynomial coupling.
    """
    chains = [{*coupling.dofs} for coupling in mechanism.polynomial_couplings]
    for loop in mechanism.loops:
        first, second = ({*chain_of(mechanism.parent, link)} for link in loop.links)
        chains.append(first ^ second)
    found: list[set[int]] = []
    for chain in chains:
        apart = [one for one in found if not one & chain]
        found = [*apart, chain.union(*(one for one in found if one & chain))]
    return [np.isin(np.arange(mechanism.nv), sorted(chain)) for chain in found]


def feasible_directions(mechanism: Mechanism, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Basis Z (nv, n) of the feasible velocities at q (nq,), and the indices (n,) of n independent coordinates.

    Z[leading] is the identity: a velocity that satisfies couplings and loop closures is Z qd[leading].
    """
    G, leading = mechanism.independent_directions, mechanism.independent_dofs
    if not mechanism.has_closed_chains:
        return G, leading
    from scipy.linalg import null_space, qr  # a fifth of a second that `import planner` does not pay

    N = null_space(jacobian(mechanism, q) @ G, rcond=_RANK_TOLERANCE)
    driven = mechanism.directly_actuated[leading]
    order = qr(N.T * np.where(driven, _PREFERRED, 1.0), mode="r", pivoting=True)[-1]
    chosen = np.sort(order[: N.shape[1]])
    return G @ N @ np.linalg.inv(N[chosen]), leading[chosen]


def relative_min_singular_value(mechanism: Mechanism, qs: np.ndarray) -> np.ndarray:
    """Distance of the loop closures from a singularity, (K,) for configurations qs (K, nq).

    Smallest nonredundant singular value of the constraint Jacobian over the largest. At zero, e.g. with a linkage
    stretched straight, assembly branches meet and rounding decides between them.
    """
    values = np.array([np.linalg.svd(jacobian(mechanism, q), compute_uv=False) for q in qs])
    shares = values / values[:, :1]
    return shares[:, int(np.count_nonzero(shares > _RANK_TOLERANCE, axis=1).max()) - 1]


def tangent_basis(mechanism: Mechanism, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Basis T (ndx, n) of the feasible deviations (dq, dv, dact) at x (nx,), and indices (n,) where T is the identity.

    A deviation dx that satisfies the constraints is T dx[indices].
    """
    Z, leading = feasible_directions(mechanism, x[: mechanism.nq])
    (nv, n), na = Z.shape, mechanism.na
    T = np.zeros((2 * nv + na, 2 * n + na))
    T[:nv, :n] = T[nv : 2 * nv, n : 2 * n] = Z
    T[2 * nv :, 2 * n :] = np.eye(na)
    return T, np.concatenate([leading, nv + leading, 2 * nv + np.arange(na)])


def check_assembled(name: str, x: np.ndarray, mechanism: Mechanism, most: float = CLOSED) -> None:
    """Raise a PlannerError if a state (nx,) violates a coupling or loop closure by more than `most`, rad or m (/s)."""
    check_closed(name, x, mechanism, most)
    if not mechanism.has_closed_chains:
        return
    q, qd = x[: mechanism.nq], x[mechanism.velocities]
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
    """Predicate of a message: the equality with the largest closure error, and that error."""
    rows = [(loop.name, "m" if k < 3 else "rad") for loop in mechanism.loops for k in range(loop.rows)]
    for cam in mechanism.polynomial_couplings:
        rows.append((cam.name, "rad" if np.any(mechanism.S[cam.follower, :3] != 0.0) else "m"))
    worst = int(np.argmax(np.abs(miss)))
    name, unit = rows[worst]
    return f"misses {name} by {abs(miss[worst]):.3g} {unit}"
