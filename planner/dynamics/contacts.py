"""Forces of contacts, stops and exponential torques on a mechanism, in NumPy.

Reference implementation of the kernels, used for equilibrium poses, pictures and proofs.

The contact law is that of model.contact.laws. A contact acts at p, halfway between the surfaces, which depends on the
penetration; its generalized force is J'f with J the (3, nv) Jacobian of the material point of the link at p.
Between two bodies J is the difference of both Jacobians and the normal rotates; the law is isotropic, so

    df = w x f + f_e de + f_v (dv - w x v),   w = n x dn.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array
from planner.dynamics import kinematics
from planner.dynamics.contact_kinematics import BodyContactKinematics
from planner.dynamics.lead_force import lead_force
from planner.model.contact.body_contact import BodyContact
from planner.model.contact.laws import Contact, ContactLaw, Law, slide_direction
from planner.model.exponential_torques import curve_torque_derivatives, exponential_joint_torques
from planner.model.mechanism import Frame, Mechanism

_Sloped = tuple[np.ndarray, np.ndarray]  # a value and its derivative by the penetration


class ContactForces(NamedTuple):
    """Points, depths and forces of all plane contacts, or all body contacts, at each state."""

    points: np.ndarray  # (..., contacts, 3) m, points of application in the world
    depths: np.ndarray  # (..., contacts) m, margin less the distance of the surfaces; negative apart
    forces: np.ndarray  # (..., contacts, 3) N, on the mechanism or the first body, in the world


def contact_forces(mechanism: Mechanism, q: Any, qd: Any) -> ContactForces:
    """Points, depths and forces of a mechanism's contacts with planes, in the order of its contacts.

    A law with a lead depends on the acceleration: its forces are those at none, which at rest are all there is.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    q, qd, single = _states(mechanism, q, qd)
    contacts = mechanism.contacts
    centres, e = _penetrations(mechanism, q)
    reaches, radii, normals = _numbers(mechanism)
    points = centres + (0.5 * (e - reaches) - radii)[..., None] * normals
    depths = e - np.array([one.law.surface_offset for one in contacts])
    forces = np.zeros_like(points)
    for k in np.flatnonzero((e > 0.0).any(axis=0)):  # skip contacts that are open at every state
        forces[:, k] = _force(PlaneContactKinematics(mechanism, contacts[k], q, qd))[0]
    return ContactForces(*(value[0] if single else value for value in (points, depths, forces)))


def _numbers(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reaches of the laws (P,), m, radii (P,), m, and normals (P, 3) of a mechanism's contacts with planes."""
    contacts = mechanism.contacts
    reaches, radii = ([one.law.reach for one in contacts], [one.radius for one in contacts])
    return np.array(reaches), np.array(radii), np.array([one.plane.normal for one in contacts]).reshape(-1, 3)


def _penetrations(mechanism: Mechanism, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (K, P, 3), m, of contacts with planes, and penetrations (K, P), m, of the laws' offset surfaces."""
    contacts = mechanism.contacts
    if not contacts:
        return np.zeros((len(q), 0, 3)), np.zeros((len(q), 0))
    links, offsets = np.array([one.link for one in contacts]), np.array([one.centre for one in contacts])
    centres, _ = kinematics.points_of(mechanism, q, links, offsets, moving=False)
    reaches, radii, normals = _numbers(mechanism)
    levels = np.array([one.plane.offset for one in contacts])
    return centres, radii + reaches + levels - np.einsum("kpa,pa->kp", centres, normals)


def body_contact_forces(mechanism: Mechanism, q: Any, qd: Any) -> ContactForces:
    """Points, depths and forces of contacts between bodies, in the order of body_contacts; see contact_forces."""
    q, qd, single = _states(mechanism, q, qd)
    places = [BodyContactKinematics(mechanism, contact, q, qd) for contact in mechanism.body_contacts]
    K, n = len(q), len(places)
    points, depths, forces = np.zeros((K, n, 3)), np.zeros((K, n)), np.zeros((K, n, 3))
    for k, place in enumerate(places):
        points[:, k], depths[:, k] = place.p, place.e - place.contact.law.surface_offset
        forces[:, k] = _force(place)[0]
    return ContactForces(*(value[0] if single else value for value in (points, depths, forces)))


def contact_jacobians(mechanism: Mechanism, q: Any, which: Any = None) -> np.ndarray:
    """Jacobians J (..., contacts, 3, nv) of contact points at q (..., nq): J'f is the generalized force of f.

    Of all contacts with planes, or of those with the indices `which`.
    """
    q = np.asarray(q, dtype=float)
    q, _, single = _states(mechanism, q, np.zeros((*q.shape[:-1], mechanism.nv)))
    contacts = mechanism.contacts if which is None else [mechanism.contacts[k] for k in which]
    J = np.zeros((len(q), len(contacts), 3, mechanism.nv))
    for k, contact in enumerate(contacts):
        J[:, k] = PlaneContactKinematics(mechanism, contact, q, np.zeros((len(q), mechanism.nv))).J
    return J[0] if single else J


def generalized_forces(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Generalized force tau (..., nv) of all contacts, stops and exponential torques at q (..., nq), qd (..., nv)."""
    q, qd, single = _states(mechanism, q, qd)
    tau = exponential_joint_torques(mechanism, q)
    for place in _places(mechanism, q, qd):
        tau += np.einsum("kaj,ka->kj", place.J, _force(place)[0])
    for stop in mechanism.stops:
        e, opening = stop_state(mechanism, stop, q, qd)
        tau[:, stop.dof] -= stop.side * unilateral_force(stop.law, e, opening)[0]
    return tau[0] if single else tau


def generalized_force_derivatives(mechanism: Mechanism, q: Any, qd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Exact derivatives (..., nv, nv) of generalized_forces with respect to q (tangent space) and qd."""
    q, qd, single = _states(mechanism, q, qd)
    by_q = curve_torque_derivatives(mechanism, q)
    by_qd = np.zeros_like(by_q)
    for place in _places(mechanism, q, qd):
        J, (de, dn, dJ) = place.J, place.derivatives(q)
        f, f_e, f_v = _force(place)
        turn = np.cross(place.n[:, :, None], dn, axis=1)
        dv = np.einsum("kaji,kj->kai", dJ, qd) - np.cross(turn, place.v[:, :, None], axis=1)
        df = np.cross(turn, f[:, :, None], axis=1) + f_e[:, :, None] * de[:, None] + f_v @ dv
        by_q += np.einsum("kaji,ka->kji", dJ, f) + np.swapaxes(J, 1, 2) @ df
        by_qd += np.swapaxes(J, 1, 2) @ f_v @ J
    for stop in mechanism.stops:
        e, opening = stop_state(mechanism, stop, q, qd)
        _, by_e, by_opening = unilateral_force(stop.law, e, opening)
        by_q[:, stop.dof, stop.dof] -= by_e
        by_qd[:, stop.dof, stop.dof] += by_opening
    return (by_q[0], by_qd[0]) if single else (by_q, by_qd)


def _states(mechanism: Mechanism, q: Any, qd: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    single = np.ndim(q) <= 1
    shape = () if single else ("K",)
    q, qd = array("q", q, (*shape, mechanism.nq)), array("qd", qd, (*shape, mechanism.nv))
    return np.atleast_2d(q), np.atleast_2d(qd), single


def _places(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray
) -> list[PlaneContactKinematics | BodyContactKinematics]:
    """Kinematics of all contacts, except plane contacts that are open at every state."""
    touching = (_penetrations(mechanism, q)[1] > 0.0).any(axis=0)
    near = [mechanism.contacts[k] for k in np.flatnonzero(touching)]
    return [contact_kinematics(mechanism, contact, q, qd) for contact in (*near, *mechanism.body_contacts)]


def contact_kinematics(
    mechanism: Mechanism, contact: Contact | BodyContact, q: np.ndarray, qd: np.ndarray
) -> PlaneContactKinematics | BodyContactKinematics:
    """Kinematics of a contact at K states, q (K, nq) and qd (K, nv)."""
    kind = PlaneContactKinematics if isinstance(contact, Contact) else BodyContactKinematics
    return kind(mechanism, contact, q, qd)  # type: ignore[arg-type]


class PlaneContactKinematics:
    """Contact geometry and relative velocity of a sphere and a plane at K states; see BodyContactKinematics."""

    def __init__(self, mechanism: Mechanism, contact: Contact, q: np.ndarray, qd: np.ndarray) -> None:
        T = np.eye(4)
        T[:3, 3] = contact.centre
        self.mechanism, self.contact, self.frame = mechanism, contact, Frame(contact.link, T)
        n, law = contact.plane.normal, contact.law
        centre = kinematics.frame_pose(mechanism, q, self.frame)[:, :3, 3]
        self.e = contact.radius + law.reach + contact.plane.offset - centre @ n
        self.arm = (0.5 * self.e - contact.radius - 0.5 * law.reach)[:, None] * n  # from the centre
        self.p = centre + self.arm
        J = kinematics.jacobian(mechanism, q, self.frame)
        self.at_centre, self.angular = J[:, :3], J[:, 3:]
        self.J = self.at_centre + np.cross(self.angular, self.arm[:, :, None], axis=1)
        if contact.plane.slide >= 0:  # relative to a plane on a slide joint
            self.J[:, :, contact.plane.slide] -= slide_direction(mechanism, contact.plane)
        self.n = np.broadcast_to(n, centre.shape)
        self.v = np.einsum("kaj,kj->ka", self.J, qd) - contact.plane.velocity

    def derivatives(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives with respect to q of e (K, nv), n (K, 3, nv) and J (K, 3, nv, nv)."""
        D, n = kinematics.jacobian_derivatives(self.mechanism, q, self.frame), self.contact.plane.normal
        de = -np.einsum("a,kaj->kj", n, self.at_centre)
        darm = 0.5 * n[:, None] * de[:, None, :]  # (K, 3, nv)
        dJ = D[:, :3] + np.cross(D[:, 3:], self.arm[:, :, None, None], axis=1)
        return de, np.zeros_like(darm), dJ + np.cross(self.angular[:, :, :, None], darm[:, :, None, :], axis=1)


def stop_state(mechanism: Mechanism, stop: Any, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Violation (K,) of a joint stop, rad or m, and its opening velocity (K,), rad/s or m/s."""
    e = stop.side * (q[:, mechanism.q_address[stop.dof]] - stop.end) + stop.law.surface_offset
    return e, -stop.side * qd[:, stop.dof]


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


def _unclamped_force(law: Law, e: np.ndarray, opening: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force K ramp(e) - B s(e) v_n, which may be negative, and its derivatives by e and v_n."""
    (r, dr), (s, ds) = ramp(e, law.ramp), smoothstep(e, law.ramp)
    return (
        law.stiffness * r - law.damping * s * opening,
        law.stiffness * dr - law.damping * ds * opening,
        -law.damping * s,
    )


def unilateral_force(law: Law, e: np.ndarray, opening: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nonnegative normal force of the law, N or N m, and its derivatives by penetration e and opening velocity v_n."""
    g, by_e, by_opening = _unclamped_force(law, e, opening)
    force, slope = ramp(g, float(law.force_ramp or 0.0))
    return force, slope * by_e, slope * by_opening


def _force(place: PlaneContactKinematics | BodyContactKinematics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contact force (K, 3), N, and its derivatives by penetration (K, 3) and relative velocity (K, 3, 3)."""
    return contact_force(place.contact.law, place.n, place.e, place.v)


def _spring_and_damper(law: ContactLaw, e: np.ndarray) -> tuple[_Sloped, _Sloped]:
    """Force of the spring and damping of a law with a lead, each (K,) with its derivative by the penetration."""
    (depth, t), (s, ds) = ramp(e, law.ramp), smoothstep(e, 0.5 * law.ramp)
    (d, dd), last = law.impedance_at(e - 0.5 * law.ramp), law.impedance[1]
    scale = (1.0 - last) / last
    w, dw = scale * d / (1.0 - d), scale * dd / (1.0 - d) ** 2
    w, dw, K = s * w, ds * w + s * dw, law.stiffness / last
    spring = K * d * w * depth, K * (dd * w * depth + d * dw * depth + d * w * t)
    return spring, (law.damping * w, law.damping * dw)


def contact_force(
    law: ContactLaw, n: np.ndarray, e: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contact force (K, 3), N, and its derivatives by penetration (K, 3) and velocity (K, 3, 3).

    Args:
        law: Parameters of the contact law.
        n: (3,) or (K, 3) unit normal.
        e: (K,) penetration into the law's surface, m.
        v: (K, 3) velocity relative to the surface, m/s; of a law with a lead that which it has a lead later.
    """
    n = np.broadcast_to(n, v.shape)
    if law.lead > 0.0:
        return lead_force(law, n, *_spring_and_damper(law, e), v)
    mu, across = law.friction, np.eye(3) - n[:, :, None] * n[:, None]
    opening, vt = np.einsum("ka,ka->k", v, n), np.einsum("ka,kab->kb", v, across)
    speed = np.linalg.norm(vt, axis=1)
    d = vt / np.where(speed > 0.0, speed, 1.0)[:, None]  # direction of sliding
    s, ds = smoothstep(e, law.ramp)
    c, dc = law.slip_damping * s, law.slip_damping * ds
    slip = c * speed
    g, g_e, g_n = _unclamped_force(law, e, opening)
    # gradients with respect to (e, v) of the slip force, the normal force and friction
    e_axis = np.array([1.0, 0.0, 0.0, 0.0])
    dslip = (dc * speed)[:, None] * e_axis + np.hstack([np.zeros_like(e)[:, None], c[:, None] * d])
    dg = g_e[:, None] * e_axis + np.hstack([np.zeros_like(e)[:, None], g_n[:, None] * n])
    slips = slip > mu * g
    share = 1.0 / (1.0 + mu**2 / law.impratio)
    h = np.where(slips, share * (g + mu * slip / law.impratio), g)
    dh = np.where(slips[:, None], share * (dg + mu / law.impratio * dslip), dg)
    normal, slope = ramp(h, float(law.force_ramp or 0.0))
    dnormal = slope[:, None] * dh
    limit, dlimit = mu * normal, mu * dnormal
    bend = law.bend
    t = ramp(slip - (1.0 - bend) * limit, 2.0 * bend * limit)[1]
    by_limit = t * (1.0 - bend + bend * t)
    friction = (1.0 - t) * slip + by_limit * limit  # slip - ramp(...), without cancellation
    dfriction = (1.0 - t)[:, None] * dslip + by_limit[:, None] * dlimit
    force = normal[:, None] * n - friction[:, None] * d
    turning = np.where(speed > 0.0, friction / np.where(speed > 0.0, speed, 1.0), np.where(limit > 0.0, c, 0.0))
    by = dnormal[:, None, :] * n[:, :, None] - dfriction[:, None, :] * d[:, :, None]  # (K, 3, 4)
    along = across - d[:, :, None] * d[:, None, :]  # derivative of the direction d, except at zero speed
    by[:, :, 1:] -= turning[:, None, None] * along
    return force, by[:, :, 0], by[:, :, 1:]
