"""Search for poses at rest near a pose, with the actuated joints fixed: minima and saddles of potential energy.

The gradient of the potential energy, that of contacts and stops too, is the force that is missing at rest. At a minimum
a machine stands by itself. At a saddle the forces balance as well, but it tips by itself: a machine on point feet or on
two wheels stands there as an inverted pendulum does, and actuators have to keep it.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.algorithms import bias
from planner.dynamics.contacts import contact_forces, generalized_forces
from planner.dynamics.kinematics import jacobian
from planner.dynamics.quasi_static import weight
from planner.model.mechanism import Frame, Mechanism

STEPS = 200  # largest number of iterations
FIRST_STEP, LONGEST_STEP = 0.02, 0.2  # m or rad, step lengths: contacts open and close within millimetres
SHORTEST_STEP = 1e-9  # m or rad: the search fails if no longer step lowers the energy
HALVINGS = 10  # largest number of halvings of a step to a saddle
DECREASE = 0.01  # of the force, per share of a step to a saddle: less of it is a step off the ground
MAX_SHIFT = 0.5  # m or rad, from the initial pose: a larger displacement counts as a fall
MAX_LEAN = 0.3  # m or rad, from the initial pose: a saddle farther away is another pose than the one asked for
AT_REST = 1e-9  # relative to the weight: largest residual force at convergence
RANK = 1e-6  # relative to the largest singular value: of lift and tilt along the ground
FLAT = 1e-8  # relative to the largest curvature: none
DIFFERENCE = 1e-6  # m or rad, of central differences of forces; affects only the number of iterations


def minimum_of_energy(mechanism: Mechanism, x: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, bool]:
    """Minimize the potential energy over the directions free (nv, n): the state (nx,), and whether it converged.

    Newton's method with the absolute eigenvalues of the Hessian and a limited step length: a step is accepted if the
    energy decreases (trapezoidal rule on the forces at both ends), or the largest force does.
    """
    space = mechanism.space
    enough, longest = AT_REST * weight(mechanism), FIRST_STEP
    start, uphill = x, _uphill(mechanism, free, x[None])[0]
    for _ in range(STEPS):
        if np.abs(uphill).max() < enough:
            return x, True
        ways = _across(mechanism, x[: mechanism.nq], free)
        by_q = ways @ ways.T @ _slopes(mechanism, free, x) @ ways @ ways.T
        while longest > SHORTEST_STEP:
            step = newton_step(by_q, ways @ (ways.T @ uphill), longest)
            there = space.integrate(x, extended(free @ step, space.ndx))
            further = _uphill(mechanism, free, there[None])[0]
            expected, found = step @ uphill + 0.5 * step @ by_q @ step, 0.5 * step @ (uphill + further)
            if found < 0.0 or np.abs(further).max() < np.abs(uphill).max():
                break
            longest = 0.25 * float(np.abs(step).max())
        else:
            return x, False
        right = abs(found - expected) < 0.3 * abs(expected)
        longest = min(LONGEST_STEP, 2.0 * longest) if right else max(0.5 * longest, 1e-3 * FIRST_STEP)
        x, uphill = there, further
        if np.abs(space.difference(x, start)).max() > MAX_SHIFT:
            break
    return x, False


def saddle_of_energy(mechanism: Mechanism, x: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, bool]:
    """Solve for zero force along the directions free (nv, n): the state (nx,), and whether it is one near x (nx,).

    Newton's method with the signed eigenvalues of the Hessian, damped by the norm of the force. All contacts that bear
    load at x still do, and so do all of the same sole: no flat foot is put on its edge.
    """
    space, enough = mechanism.space, AT_REST * weight(mechanism)
    start, uphill, loaded = x, _uphill(mechanism, free, x[None])[0], _bear_load(mechanism, x)
    for _ in range(STEPS):
        if np.abs(uphill).max() < enough:
            return x, bool(_bear_load(mechanism, x)[loaded].all() and not _is_on_an_edge(mechanism, x))
        ways = _across(mechanism, x[: mechanism.nq], free)
        by_q = ways @ ways.T @ _slopes(mechanism, free, x) @ ways @ ways.T
        step = newton_step(by_q, ways @ (ways.T @ uphill), LONGEST_STEP, signed=True)
        for share in 0.5 ** np.arange(HALVINGS):
            there = space.integrate(x, extended(share * free @ step, space.ndx))
            further = _uphill(mechanism, free, there[None])[0]
            if np.linalg.norm(further) < (1.0 - DECREASE * share) * np.linalg.norm(uphill):
                break
        else:
            break
        x, uphill = there, further
        if np.abs(space.difference(x, start)).max() > MAX_LEAN:
            break
    return x, False


def _is_on_an_edge(mechanism: Mechanism, x: np.ndarray) -> bool:
    """Whether a link bears load at a state (nx,) with a part of its sole: others lie beside it, off the ground.

    A sole that leans by at most MAX_LEAN is as far off the ground as that lean lifts it; the upper end of a leg is not.
    """
    ground, bear = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)), _bear_load(mechanism, x)
    links = np.array([one.link for one in mechanism.contacts])
    for k in np.flatnonzero(~bear):
        loaded = bear & (links == links[k])
        if loaded.any():
            beside = np.linalg.norm(ground.points[loaded] - ground.points[k], axis=1).max()
            if -ground.depths[k] <= MAX_LEAN * beside:
                return True
    return False


def _bear_load(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """(K,) bool, the contacts that push at a state x (nx,) at rest."""
    return np.any(contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).forces, axis=1)


def extended(part: np.ndarray, size: int) -> np.ndarray:
    """A vector with zeros behind it, up to a size."""
    return np.concatenate([part, np.zeros(size - len(part))])


def _across(mechanism: Mechanism, q: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(n, k) orthonormal combinations of the directions free (nv, n) that lift or tilt links with contacts.

    Displacements along level ground do not change the energy, but for a tilted machine away from equilibrium a yaw
    rotation mixes coordinates, so residual torques would cause spurious displacements along the ground.
    """
    links = sorted({contact.link for contact in mechanism.contacts})
    level = along_ground(mechanism, q, free, np.array(links))
    return np.linalg.svd(level)[0][:, level.shape[1] :] if level.shape[1] else np.eye(len(level))


def along_ground(mechanism: Mechanism, q: np.ndarray, free: np.ndarray, links: np.ndarray) -> np.ndarray:
    """(n, m) orthonormal combinations of the directions free (nv, n) that neither lift nor tilt the links."""
    if not np.any(mechanism.gravity):
        return np.zeros((free.shape[1], 0))
    return along_plane(mechanism, q, free, links, -mechanism.gravity / np.linalg.norm(mechanism.gravity))


def along_plane(
    mechanism: Mechanism, q: np.ndarray, free: np.ndarray, links: np.ndarray, normal: np.ndarray
) -> np.ndarray:  # fmt: skip
    """(n, m) orthonormal combinations of the directions free (nv, n) that move links along planes of a normal (3,)."""
    rows = []
    for link in links:
        J = jacobian(mechanism, q, Frame(int(link), np.eye(4)))
        rows += [normal[None] @ J[:3], J[3:] - np.outer(normal, normal @ J[3:])]
    _, sizes, directions = np.linalg.svd(np.vstack(rows) @ free)
    return directions[int(np.sum(sizes > RANK * sizes.max(initial=0.0))) :].T


def newton_step(by_q: np.ndarray, uphill: np.ndarray, longest: float, *, signed: bool = False) -> np.ndarray:
    """The step (n,) down an energy with gradient (n,) and Hessian (n, n), no component longer than `longest`.

    With `signed` eigenvalues it is the step to where the gradient vanishes, which goes up along negative curvature.
    """
    values, vectors = np.linalg.eigh(0.5 * (by_q + by_q.T))
    curved = np.abs(values) > FLAT * np.abs(values).max()  # no step where it is flat, e.g. along the ground
    along = (vectors.T @ uphill)[curved] / (values if signed else np.abs(values))[curved]
    step = -vectors[:, curved] @ along
    return step * min(1.0, longest / max(float(np.abs(step).max()), 1e-300))


def _uphill(mechanism: Mechanism, free: np.ndarray, xs: np.ndarray) -> np.ndarray:
    """Gradient (K, n) of potential energy, that of contacts and stops too, at states xs (K, nx) at rest, N and N m."""
    q, still = xs[:, : mechanism.nq], np.zeros((len(xs), mechanism.nv))
    return (bias(mechanism, q, still) - generalized_forces(mechanism, q, still)) @ free


def _slopes(mechanism: Mechanism, free: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Hessian (n, n) of potential energy at x (nx,) by central differences of _uphill."""
    n, space = free.shape[1], mechanism.space
    change = np.zeros((2 * n, space.ndx))
    change[:, : len(free)] = DIFFERENCE * np.concatenate([free.T, -free.T])
    uphill = _uphill(mechanism, free, space.integrate(np.tile(x, (2 * n, 1)), change))
    return (uphill[:n] - uphill[n:]).T / (2.0 * DIFFERENCE)
