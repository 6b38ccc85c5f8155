"""Forces of contacts, stops and exponential torques on a mechanism, in NumPy.

Reference implementation of the kernels, used for equilibrium poses, pictures and proofs.

The contact law is that of model.contact.laws. A contact acts at p, halfway between the surfaces, which depends on the
penetration; its generalized force is J'f with J the (3, nv) Jacobian of the material point of the link at p.
Between two bodies J is the difference of both Jacobians.

A law with a lead depends on x = v + lead J qacc, the velocity that the contact has a lead later, relative to the
surface, and with spinning and rolling friction on the angular velocity, too: x has six components then, n three zeros,
and the force a torque behind it. With W = n n' + sqrt(impratio) (1 - n n') an elliptic cone's force is

    f = W P(y),   y = K depth n - B s W x,   df/dx = -B s W DP W

P the smoothed projection onto the cone |g_t| <= mu g_n / sqrt(impratio) and DP its derivative; W's rows of rotations
are times the arms of spinning and rolling.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array
from planner.dynamics.contact_kinematics import BodyContactKinematics, PlaneContactKinematics, contact_kinematics
from planner.dynamics.kinematics import LinkPlaces
from planner.model.contact.laws import ContactLaw, Law, Stop
from planner.model.mechanism import Mechanism
from planner.model.passive_forces import exponential_joint_torques

_MIN_BEND = 1e-9  # so that no number is divided by 0


class ContactForces(NamedTuple):
    """Points, depths and forces of all plane contacts, or all body contacts, at each state."""

    points: np.ndarray  # (..., contacts, 3) m, points of application in the world
    depths: np.ndarray  # (..., contacts) m, margin less the distance of the surfaces; negative apart
    forces: np.ndarray  # (..., contacts, 3) N, on the mechanism or the first body, in the world


def contact_forces(mechanism: Mechanism, q: Any, qd: Any) -> ContactForces:
    """Points, depths and forces of a mechanism's contacts with planes, in the order of its contacts.

    A law with a lead depends on the acceleration: its forces are those at none, which at rest are all there is. Torques
    of spinning and rolling friction are left out, and the sliding velocity that they share the cone with.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    q, qd, single = _states(mechanism, q, qd)
    contacts, at = mechanism.contacts, LinkPlaces(mechanism, q)
    centres, e = _penetrations(at)
    reaches, radii, normals = _numbers(mechanism)
    points = centres + (0.5 * (e - reaches) - radii)[..., None] * normals
    depths = e - np.array([one.law.surface_offset for one in contacts])
    forces = np.zeros_like(points)
    for k in np.flatnonzero((e > 0.0).any(axis=0)):  # skip contacts that are open at every state
        forces[:, k] = _force(PlaneContactKinematics(at, contacts[k], qd))
    return ContactForces(*(value[0] if single else value for value in (points, depths, forces)))


def _numbers(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reaches of the laws (P,), m, radii (P,), m, and normals (P, 3) of a mechanism's contacts with planes."""
    contacts = mechanism.contacts
    reaches, radii = ([one.law.reach for one in contacts], [one.radius for one in contacts])
    return np.array(reaches), np.array(radii), np.array([one.plane.normal for one in contacts]).reshape(-1, 3)


def _penetrations(places: LinkPlaces) -> tuple[np.ndarray, np.ndarray]:
    """Centres (K, P, 3), m, of contacts with planes, and penetrations (K, P), m, of the laws' offset surfaces."""
    contacts = places.mechanism.contacts
    if not contacts:
        return np.zeros((len(places.q), 0, 3)), np.zeros((len(places.q), 0))
    links, offsets = np.array([one.link for one in contacts]), np.array([one.centre for one in contacts])
    centres, _ = places.points(links, offsets, moving=False)
    reaches, radii, normals = _numbers(places.mechanism)
    levels = np.array([one.plane.offset for one in contacts])
    return centres, radii + reaches + levels - np.einsum("kpa,pa->kp", centres, normals)


def body_contact_forces(mechanism: Mechanism, q: Any, qd: Any) -> ContactForces:
    """Points, depths and forces of contacts between bodies, in the order of body_contacts; see contact_forces."""
    q, qd, single = _states(mechanism, q, qd)
    at = LinkPlaces(mechanism, q)
    places = [BodyContactKinematics(at, contact, qd) for contact in mechanism.body_contacts]
    K, n = len(q), len(places)
    points, depths, forces = np.zeros((K, n, 3)), np.zeros((K, n)), np.zeros((K, n, 3))
    for k, place in enumerate(places):
        points[:, k], depths[:, k] = place.p, place.e - place.contact.law.surface_offset
        forces[:, k] = _force(place)
    return ContactForces(*(value[0] if single else value for value in (points, depths, forces)))


def contact_jacobians(mechanism: Mechanism, q: Any, which: Any = None) -> np.ndarray:
    """Jacobians J (..., contacts, 3, nv) of contact points at q (..., nq): J'f is the generalized force of f.

    Of all contacts with planes, or of those with the indices `which`.
    """
    q = np.asarray(q, dtype=float)
    q, _, single = _states(mechanism, q, np.zeros((*q.shape[:-1], mechanism.nv)))
    contacts = mechanism.contacts if which is None else [mechanism.contacts[k] for k in which]
    at, still = LinkPlaces(mechanism, q), np.zeros((len(q), mechanism.nv))
    J = np.zeros((len(q), len(contacts), 3, mechanism.nv))
    for k, contact in enumerate(contacts):
        J[:, k] = PlaneContactKinematics(at, contact, still).J
    return J[0] if single else J


def generalized_forces(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Generalized force tau (..., nv) of all contacts, stops and exponential torques at q (..., nq), qd (..., nv).

    Laws with a lead depend on the acceleration: their forces are those at none, without torques of the contact.
    """
    q, qd, single = _states(mechanism, q, qd)
    tau = exponential_joint_torques(mechanism, q)
    for place in _places(mechanism, q, qd):
        tau += np.einsum("kaj,ka->kj", place.J, _force(place))
    for stop in mechanism.stops:
        e, opening = stop_state(mechanism, stop, q, qd)
        tau[:, stop.dof] -= stop.side * unilateral_force(stop.law, e, opening)
    return tau[0] if single else tau


def _states(mechanism: Mechanism, q: Any, qd: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    single = np.ndim(q) <= 1
    shape = () if single else ("K",)
    q, qd = array("q", q, (*shape, mechanism.nq)), array("qd", qd, (*shape, mechanism.nv))
    return np.atleast_2d(q), np.atleast_2d(qd), single


def _places(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray
) -> list[PlaneContactKinematics | BodyContactKinematics]:
    """Kinematics of all contacts, except plane contacts that are open at every state."""
    at = LinkPlaces(mechanism, q)
    touching = (_penetrations(at)[1] > 0.0).any(axis=0)
    near = [mechanism.contacts[k] for k in np.flatnonzero(touching)]
    return [contact_kinematics(at, contact, qd) for contact in (*near, *mechanism.body_contacts)]


def stop_state(mechanism: Mechanism, stop: Any, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Penetration (K,) of a joint stop, rad or m, and its opening velocity (K,), rad/s or m/s."""
    return stop_depth(mechanism, stop, q) + stop.law.surface_offset, -stop.side * qd[:, stop.dof]


def stop_depth(mechanism: Mechanism, stop: Stop, q: np.ndarray) -> np.ndarray:
    """How far (K,) a joint is beyond where its stop begins to press without smoothing, rad or m, at q (K, nq)."""
    return stop.side * (q[:, mechanism.q_address[stop.dof]] - stop.end) + stop.law.margin


def ramp(e: np.ndarray, a: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed max(0, e): 0, e^2 / 2a, e - a/2 for e < 0, 0..a, > a, and its derivative by e."""
    slope = np.clip(np.divide(e, a, out=np.where(e > 0.0, 1.0, 0.0), where=np.greater(a, 0.0)), 0.0, 1.0)
    return slope * (e - 0.5 * a * slope), slope


def smoothstep(e: np.ndarray, a: float) -> tuple[np.ndarray, np.ndarray]:
    """3 t^2 - 2 t^3 of t = e/a clipped to 0..1, and its derivative by e."""
    if a == 0.0:
        return np.where(e > 0.0, 1.0, 0.0), np.zeros_like(e)
    t = np.clip(e / a, 0.0, 1.0)
    return t**2 * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / a


def unilateral_force(law: Law, e: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """Nonnegative normal force of the law, N or N m, at penetration e and opening velocity v_n.

    Of a law with a lead v_n is the velocity a lead later.
    """
    spring, damping = _spring_and_damper(law, e)
    return ramp(spring - damping * opening, float(law.force_ramp or 0.0))[0]


def _force(place: PlaneContactKinematics | BodyContactKinematics) -> np.ndarray:
    """Contact force (K, 3), N."""
    return contact_force(place.contact.law, place.n, place.e, place.v)


def _spring_and_damper(law: Law, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force (K,) of the spring and damping (K,) at penetrations: K ramp(e) and B s(e) without a lead."""
    depth, _ = ramp(e, law.ramp)
    if not law.lead > 0.0:
        return law.stiffness * depth, law.damping * smoothstep(e, law.ramp)[0]
    d, last = law.impedance_at(e - 0.5 * law.ramp), law.impedance[1]
    w = smoothstep(e, 0.5 * law.ramp)[0] * ((1.0 - last) / last * d / (1.0 - d))
    return law.stiffness / last * d * w * depth, law.damping * w


def contact_force(law: ContactLaw, n: np.ndarray, e: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Contact force (K, 3), N.

    Args:
        law: Parameters of the contact law.
        n: (3,) or (K, 3) unit normal.
        e: (K,) penetration into the law's surface, m.
        v: (K, 3) velocity relative to the surface, m/s; of a law with a lead that which it has a lead later. What
            spinning and rolling friction resist is zero, see contact_wrench.
    """
    n = np.broadcast_to(n, v.shape)
    if law.lead > 0.0:
        return contact_wrench(law, n, e, v, np.zeros_like(v))[0][:, :3]
    mu, across = law.friction, np.eye(3) - n[:, :, None] * n[:, None]
    opening, vt = np.einsum("ka,ka->k", v, n), np.einsum("ka,kab->kb", v, across)
    speed = np.linalg.norm(vt, axis=1)
    d = vt / np.where(speed > 0.0, speed, 1.0)[:, None]  # direction of sliding
    slip = law.slip_damping * smoothstep(e, law.ramp)[0] * speed
    spring, damping = _spring_and_damper(law, e)
    g = spring - damping * opening
    share = 1.0 / (1.0 + mu**2 / law.impratio)
    h = np.where(slip > mu * g, share * (g + mu * slip / law.impratio), g)
    normal, _ = ramp(h, float(law.force_ramp or 0.0))
    limit, bend = mu * normal, law.bend
    t = ramp(slip - (1.0 - bend) * limit, 2.0 * bend * limit)[1]
    friction = (1.0 - t) * slip + t * (1.0 - bend + bend * t) * limit  # slip - ramp(...), without cancellation
    return normal[:, None] * n - friction[:, None] * d


def _contact_frames(n: np.ndarray) -> np.ndarray:
    """(K, 3, 3) MuJoCo's frames of contacts with normals n (K, 3): rows n, t1 and t2 (mju_makeFrame)."""
    start = np.where(np.abs(n[:, 1:2]) < 0.5, np.eye(3)[1], np.eye(3)[2])
    t1 = start - n * np.einsum("ka,ka->k", n, start)[:, None]
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    return np.stack([n, t1, np.cross(n, t1)], axis=1)


def _edges(law: ContactLaw, n: np.ndarray) -> np.ndarray:
    """(K, edges, 6) force and torque of each edge of a pyramidal cone; all are n without friction."""
    frames, mu, still = _contact_frames(n), law.friction, np.zeros_like(n)
    around = [np.hstack([n + side * mu * frames[:, k], still]) for k in (1, 2) for side in (1.0, -1.0)]
    arms = [law.spinning, law.rolling, law.rolling][: max(law.condim - 3, 0)]
    turning = [np.hstack([n, side * arm * frames[:, k]]) for k, arm in enumerate(arms) for side in (1.0, -1.0)]
    return np.stack([*around, *turning], axis=1)


def contact_wrench(
    law: ContactLaw, n: np.ndarray, e: np.ndarray, v: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque (K, 6) of a law with a lead, N and N m, and derivatives by (v, w) (K, 6, 6).

    Args:
        law: With a lead.
        n: (K, 3) unit normal.
        e: (K,) penetration into the law's surface, m.
        v: (K, 3) m/s, the velocity relative to the surface a lead later.
        w: (K, 3) rad/s, the angular velocity a lead later.
    """
    k, b = _spring_and_damper(law, e)
    x, across = np.hstack([v, w]), n[:, :, None] * n[:, None]
    if law.is_round:
        root, N = np.sqrt(law.impratio), np.hstack([n, np.zeros_like(n)])
        spin, roll = law.spinning / law.friction, law.rolling / law.friction
        W = np.zeros((len(n), 6, 6))
        W[:, :3, :3] = root * np.eye(3) + (1.0 - root) * across
        W[:, 3:, 3:] = root * (roll * np.eye(3) + (spin - roll) * across)
        Wx = np.einsum("kab,kb->ka", W, x)
        g, slope = _projection(law.friction / root, law.bend, N, k[:, None] * N - b[:, None] * Wx)
        return np.einsum("kab,kb->ka", W, g), -b[:, None, None] * (W @ slope @ W)
    d, share, f = _edges(law, n), 1.0 / law.edges, float(law.force_ramp or 0.0)
    along = np.einsum("kea,ka->ke", d, x)
    y = share * (k[:, None] - b[:, None] * along)
    slope = np.clip(y / f, 0.0, 1.0) if f > 0.0 else (y > 0.0).astype(float)
    by_x = -b[:, None, None] * np.einsum("ke,kea,keb->kab", share * slope, d, d)
    return np.einsum("ke,kea->ka", slope * (y - 0.5 * f * slope), d), by_x


def _projection(mu: float, bend: float, n: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of the cone |g_t| <= mu g_n nearest to y (K, m), smoothed by bend, and its derivative (K, m, m)."""
    y_n = np.einsum("ka,ka->k", y, n)
    y_t = y - y_n[:, None] * n
    slip = np.linalg.norm(y_t, axis=1)
    size = np.where(slip > 0.0, slip, 1.0)
    u, w, per = y_t / size[:, None], max(bend, _MIN_BEND) * mu, 1.0 / np.sqrt(1.0 + mu**2)
    p, c = per * (y_n + mu * slip), per * (mu * y_n - slip)
    presses = p > 0.0  # else y is in the polar cone
    t = np.divide(c, p, out=np.zeros_like(c), where=presses)
    z, beyond = np.clip((t + w) / (2.0 * w), 0.0, 1.0), np.maximum(t - w, 0.0)
    psi = w**2 * (2.0 / 3.0 * z**3 - 1.0 / 6.0) + beyond * (w + 0.5 * beyond)
    by_t = w * z**2 + beyond  # psi'; its own derivative is z
    along, across = presses * p * (1.0 + 2.0 * psi - t * by_t), presses * p * by_t
    g_n, g_t = per * (along + mu * across), per * (mu * along - across)
    H = [[1.0 + 2.0 * psi - 2.0 * t * by_t + t**2 * z, by_t - t * z], [by_t - t * z, z]]
    edge, inwards = per * (n + mu * u), per * (mu * n - u)
    slope = sum(
        H[i][j][:, None, None] * one[:, :, None] * other[:, None]
        for i, one in enumerate((edge, inwards)) for j, other in enumerate((edge, inwards))
    )  # fmt: skip
    turning = np.where(t >= w, 1.0, g_t / size)
    around = np.eye(n.shape[1]) - n[:, :, None] * n[:, None] - u[:, :, None] * u[:, None]
    slope = presses[:, None, None] * (slope + turning[:, None, None] * around)
    return g_n[:, None] * n + g_t[:, None] * u, slope
