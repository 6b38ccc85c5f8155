"""The mirror image of a machine in a vertical plane: which joint takes the place of which, and how.

A reflection R, about a plane through a point p, takes the screw (w, v) of a joint, v at p, to (-R w, R v). Joint a is
the image of joint b if the reflected screws of a are combinations of those of b, and the joints that a carries are
the images of those that b carries. A joint in the plane may be its own image; another one goes first, so that legs
that lie in the plane of a planar machine change places. An actuator's image has the reflected moments, and the same
force law and ranges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.joint_forces import actuator_moments
from planner.dynamics.kinematics import LinkPlaces
from planner.model.actuators import Actuators
from planner.model.mechanism import BALL, Mechanism
from planner.model.space import StateMap, conjugate, cross, exp_quaternion, product
from planner.problem.tasks.legs import shifted

MATCH = 5e-3  # m per rad, and rad: by which the screws of two sides may differ, as files are written
COMPARED, SPEED, PUSH = 5, 0.3, 0.05  # states at which sides are compared; rad/s and m/s; share of the controls' ranges
HIGH = 10.0  # m, where sides are compared: on the ground a contact counts that a rounding opens
ALIKE, UNLIKE = 1e-6, 0.05  # of the largest change in a stage: what is not told, and what another problem is told for


class Mirror(NamedTuple):
    """The mirror image of a machine."""

    image: StateMap
    links: np.ndarray  # (nv,) the link that each one takes the place of


def mirror_of(mechanism: Mechanism, x: np.ndarray, normal: np.ndarray) -> Mirror:
    """The mirror image about a plane through the base of a state (nx,), its joints as in the file's qpos0.

    Args:
        mechanism: The machine.
        x: The base is where it is here.
        normal: (3,) of the plane, horizontal. A base whose own axis leans a little is set upright: a machine whose mass
            lies to one side stands so.

    Raises:
        PlannerError: A joint or an actuator has no image.
    """
    nv, na = mechanism.nv, mechanism.na
    origin, joints = mechanism.at_rest(x), base_coordinates(mechanism)
    origin[joints : mechanism.nq] = mechanism.qpos0[joints:]
    at = quaternion_of_base(mechanism)
    if at is not None:
        origin[at : at + 4] = _upright(origin[at : at + 4], normal)
    origin[mechanism.nq + nv :] = 0.0
    places = LinkPlaces(mechanism, origin[None, : mechanism.nq])
    angular, linear = places.screws[0, :, :3], places.screws[0, :, 3:]
    root = next(k for k, links in enumerate(mechanism.joint_links) if mechanism.parent[links.start] < 0)
    point = places.T[0, mechanism.joint_links[root].stop - 1, :3, 3]
    screws = np.hstack([angular, linear + cross(angular, point - places.origin[0])])
    R = np.eye(3) - 2.0 * np.outer(normal, normal)
    reflected = np.hstack([-screws[:, :3] @ R, screws[:, 3:] @ R])
    S, links = np.zeros((nv, nv)), np.full(nv, -1)
    carried = _carried(mechanism)
    for a in carried[-1]:
        if not _matched(mechanism, carried, screws, reflected, a, a, S, links):
            name = _first_unmatched(mechanism, carried, links) or mechanism.joint_names[a]
            raise PlannerError(
                f"mirror is true, and joint {name!r} has no mirror image in the machine's other half: expected a "
                "machine with two equal sides, or no mirror and a whole cycle."
            )
    moments = actuator_moments(mechanism, origin[: mechanism.nq])
    images, C = moments @ S.T, np.zeros((mechanism.nu, mechanism.nu))
    for k, image in enumerate(images):
        pairs = ((j, sign) for sign in (1.0, -1.0) for j in np.flatnonzero(~C.any(axis=1)))
        alike = ((j, s) for j, s in pairs if np.abs(image - s * moments[j]).max() <= MATCH * np.abs(image).max())
        found = next(((j, s) for j, s in alike if _laws_are_equal(mechanism.actuators, k, int(j), s)), None)
        if found is None:
            name = mechanism.actuators.names[k] or f"actuator {k}"
            raise PlannerError(
                f"mirror is true, and actuator {name!r} has no mirror image: expected a "
                "machine with two equal sides, or no mirror and a whole cycle."
            )
        C[found[0], k] = found[1]
    act = mechanism.actuators.activation
    A = np.zeros((na, na))
    for j, k in np.argwhere(C != 0.0):
        if act[k] >= 0:
            A[act[j], act[k]] = C[j, k]
    whole = np.zeros((2 * nv + na, 2 * nv + na))
    whole[:nv, :nv] = whole[nv : 2 * nv, nv : 2 * nv] = S
    whole[2 * nv :, 2 * nv :] = A
    return Mirror(StateMap(origin, origin, whole, C), links)


def asymmetry(dynamics: RigidBodyDynamics, mirror: Mirror, xs: np.ndarray, us: np.ndarray) -> float:
    """How differently the machine and its image move from states (K, nx) with controls (K, nu): share of the change.

    In the air it tells masses, damping and actuators; on the ground a contact that a rounding opens counts, too.
    """
    space = dynamics.space
    ends = mirror.image.apply(space, dynamics.step(xs, us))
    starts = mirror.image.apply(space, xs)
    images = dynamics.step(starts, mirror.image.images_of_controls(us))
    change = np.abs(space.difference(ends, starts)).max()
    return float(np.abs(space.difference(ends, images)).max() / max(change, 1e-12))


def _laws_are_equal(actuators: Actuators, k: int, j: int, sign: float) -> bool:
    """Whether actuators k and j exert the same forces with controls that are the same, or opposite with sign -1."""

    def ranges(one: np.ndarray, turned: float) -> np.ndarray:
        return one if turned > 0.0 else -one[::-1]

    laws = [
        np.concatenate([
            [actuators.gain[i], turned * actuators.bias[i, 0], *actuators.bias[i, 1:], actuators.time_constant[i]],
            [actuators.dynamics[i]], ranges(actuators.control_range[i], turned),
            ranges(actuators.force_range[i], turned), ranges(actuators.activation_range[i], turned),
        ])
        for i, turned in ((k, sign), (j, 1.0))
    ]  # fmt: skip
    return bool(np.allclose(*laws, rtol=MATCH, atol=1e-9, equal_nan=True))


def compared_sides(dynamics: RigidBodyDynamics, mirror: Mirror, x0: np.ndarray, up: np.ndarray) -> str:
    """A sentence about how unlike the sides are, in the air at random speeds; "" where they are alike.

    Identified masses and frictions of a robot's file differ from side to side. Half a cycle is none the worse for it,
    but the other half is not quite its image.

    Args:
        dynamics: The machine.
        mirror: Its mirror image.
        x0: (nx,) how it stands.
        up: (3,) from the ground, where contacts that a rounding opens would count.
    """
    m, rng = dynamics.mechanism, np.random.default_rng(0)
    xs = np.tile(x0, (COMPARED, 1))
    xs[:, : m.nq] = shifted(m, xs[:, : m.nq], np.tile(HIGH * up, (COMPARED, 1)))
    xs[:, m.velocities] = rng.normal(0.0, SPEED, (COMPARED, m.nv))
    low, high = m.actuators.control_range.T
    low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
    us = low + rng.uniform(0.5 - PUSH, 0.5 + PUSH, (COMPARED, m.nu)) * (high - low)
    with np.errstate(all="ignore"):  # a light link may run away
        unlike = asymmetry(dynamics, mirror, xs, us)
    if not unlike > ALIKE:
        return ""
    advice = ": without mirror a whole cycle is planned, which counts it" if unlike > UNLIKE else ""
    return f" The machine's sides differ by {100 * unlike:.2g} % in how they move{advice}."


def quaternion_of_base(mechanism: Mechanism) -> int | None:
    """Where the configuration of a free base has its quaternion; None of another base."""
    floats = base_dofs(mechanism) >= 6 and mechanism.kind[3] == BALL
    return int(mechanism.q_address[3]) if floats else None


def _upright(quaternion: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A base's quaternion (4,), turned the short way until its axis nearest to a direction (3,) is along it."""
    axes = product(product(quaternion, np.hstack([np.zeros((3, 1)), np.eye(3)])), conjugate(quaternion))[:, 1:]
    k = int(np.argmax(np.abs(axes @ normal)))
    axis = axes[k] * np.sign(axes[k] @ normal)
    turn = np.cross(axis, normal)
    sine = float(np.linalg.norm(turn))
    angle = float(np.arctan2(sine, axis @ normal))
    return quaternion if sine < 1e-12 else product(exp_quaternion(angle / sine * turn), quaternion)


def base_dofs(mechanism: Mechanism) -> int:
    """How many of the first degrees of freedom carry all of the others, without an actuator: those of the base."""
    parent, driven = np.asarray(mechanism.parent), mechanism.directly_actuated
    k = 0
    while k < mechanism.nv and not driven[k] and parent[k] == k - 1 and np.all(parent[k + 1 :] >= k):
        k += 1
    return k


def base_coordinates(mechanism: Mechanism) -> int:
    """How many of the first coordinates of qpos are those of the base."""
    last = base_dofs(mechanism) - 1
    return 0 if last < 0 else int(mechanism.q_address[last]) + (4 if mechanism.kind[last] else 1)


def _carried(mechanism: Mechanism) -> dict[int, list[int]]:
    """The joints that each joint carries, and -1 the world."""
    of_link = {i: k for k, links in enumerate(mechanism.joint_links) for i in range(links.start, links.stop)}
    found: dict[int, list[int]] = {k: [] for k in range(-1, len(mechanism.joint_links))}
    for k, links in enumerate(mechanism.joint_links):
        parent = int(mechanism.parent[links.start])
        found[-1 if parent < 0 else of_link[parent]].append(k)
    return found


def _matched(
    mechanism: Mechanism, carried: dict[int, list[int]], screws: np.ndarray, reflected: np.ndarray, a: int, b: int,
    S: np.ndarray, links: np.ndarray,
) -> bool:  # fmt: skip
    """Whether joint b is the image of joint a, with all that they carry; fills S (nv, nv) and links (nv,)."""
    of, at = mechanism.joint_links[a], mechanism.joint_links[b]
    if of.stop - of.start != at.stop - at.start:
        return False
    B = np.linalg.lstsq(screws[at].T, reflected[of].T, rcond=None)[0]  # columns: of a, in those of b
    if np.abs(screws[at].T @ B - reflected[of].T).max() > MATCH:
        return False
    U, _, Vt = np.linalg.svd(B)
    S[at, of], links[of] = U @ Vt, np.arange(at.start, at.stop)
    left = list(carried[b])
    for c in carried[a]:
        for d in sorted(left, key=lambda d: d == c):
            if _matched(mechanism, carried, screws, reflected, c, d, S, links):
                left.remove(d)
                break
        else:
            links[of] = -1
            S[:, of] = 0.0
            return False
    return not left


def _first_unmatched(mechanism: Mechanism, carried: dict[int, list[int]], links: np.ndarray) -> str:
    """The name of a joint without an image."""
    lost = [k for k, at in enumerate(mechanism.joint_links) if links[at.start] < 0 and not carried[k]]
    return mechanism.joint_names[lost[0]] if lost else ""
