"""Exact derivatives of the forces of contacts, stops and exponential torques that planner.dynamics.contacts has.

Kernels' derivatives are held to them. Between two bodies the normal rotates; the law is isotropic, so

    df = w x f + f_e de + f_v (dv - w x v),   w = n x dn.

The closest points of two axes solve g(s) = 0 (planner.dynamics.contact_kinematics), so with c = a_1'a_2

    G = dg/ds = (1 + b, -c; -c, 1 + b),   ds = -G^-1 dg

over the unclamped s, with dg at constant s. Then

    d|D| = n'dD,   dn = (dD - n d|D|)/|D|,   dp = (dx_1 + dx_2)/2 - (r_1 - r_2) dn/2.
"""

import numpy as np

from planner.dynamics import kinematics
from planner.dynamics.contact_kinematics import PlaneContactKinematics, contact_kinematics
from planner.dynamics.contacts import contact_force, stop_state, unilateral_force
from planner.model.mechanism import Frame
from planner.model.passive_forces import one_torque


def generalized_force_derivatives(mechanism, q, qd):
    """Derivatives (..., nv, nv) of generalized_forces with respect to q (tangent space) and qd."""
    single, q, qd = q.ndim == 1, np.atleast_2d(q), np.atleast_2d(qd)
    by_q = curve_torque_derivatives(mechanism, q)
    by_qd = np.zeros_like(by_q)
    for contact in (*mechanism.contacts, *mechanism.body_contacts):
        place = contact_kinematics(kinematics.LinkPlaces(mechanism, q), contact, qd)
        of_place = plane_derivatives if isinstance(place, PlaneContactKinematics) else body_derivatives
        J, (de, dn, dJ) = place.J, of_place(mechanism, place, q)
        f, f_e, f_v = contact_force(contact.law, place.n, place.e, place.v)
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


def curve_torque_derivatives(mechanism, q):
    """Derivative (K, nv, nv) of exponential_joint_torques with respect to q (tangent space)."""
    by_q = np.zeros((len(q), mechanism.nv, mechanism.nv))
    for curve in mechanism.curves:
        for j, slope in curve.slopes:
            by_q[:, curve.dof, j] += slope * one_torque(curve, mechanism.q_address, q)
    return by_q


def point_derivatives(mechanism, q, link, centre, arm, darm):
    """Derivative (K, 3, nv, nv) of the Jacobian of a link's point at `arm` (K, 3) from a centre of its own, m.

    darm (K, 3, nv) is the derivative of the arm.
    """
    T = np.eye(4)
    T[:3, 3] = centre
    frame = Frame(link, T)
    D, angular = kinematics.jacobian_derivatives(mechanism, q, frame), kinematics.jacobian(mechanism, q, frame)[:, 3:]
    moved = D[:, :3] + np.cross(D[:, 3:], arm[:, :, None, None], axis=1)
    return moved + np.cross(angular[:, :, :, None], darm[:, :, None, :], axis=1)


def plane_derivatives(mechanism, place, q):
    """Derivatives of e (K, nv), n (K, 3, nv) and J (K, 3, nv, nv) of a sphere and a plane with respect to q."""
    contact, n = place.contact, place.contact.plane.normal
    centres, J = kinematics.points_of(mechanism, q, np.array([contact.link]), contact.centre[None])
    de = -np.einsum("a,kaj->kj", n, J[:, 0])
    darm = 0.5 * n[:, None] * de[:, None, :]
    dJ = point_derivatives(mechanism, q, contact.link, contact.centre, place.p - centres[:, 0], darm)
    return de, np.zeros_like(darm), dJ


def body_derivatives(mechanism, place, q):
    """Derivatives of e (K, nv), n (K, 3, nv) and J (K, 3, nv, nv) of two bodies with respect to q."""
    parts, b = (place.contact.first, place.contact.second), place.contact.axis_regularization
    links, middles = np.array([part.link for part in parts]), np.array([part.middle for part in parts])
    m, at_middle = kinematics.points_of(mechanism, q, links, middles)
    jacobians = [kinematics.jacobian(mechanism, q, Frame(part.link, np.eye(4))) for part in parts]
    angular = [J[:, 3:] for J in jacobians]
    (a1, a2), (s, D) = place.axes, place.closest
    along_axis = [s[:, k, None] * place.axes[k] for k in range(2)]
    at_axis = [at_middle[:, k] + np.cross(angular[k], along_axis[k][:, :, None], axis=1) for k in range(2)]
    turned = [np.cross(angular[k], place.axes[k][:, :, None], axis=1) for k in range(2)]
    dD = at_axis[0] - at_axis[1]  # for constant s
    dg = np.stack([_rows(a1, dD) + _rows(D, turned[0]), -_rows(a2, dD) - _rows(D, turned[1])], axis=1)
    ds = -_inverse(place, a1, a2, [part.length for part in parts], b) @ dg
    along = [place.axes[k][:, :, None] * ds[:, k, None] for k in range(2)]
    dD = dD + along[0] - along[1]
    distance = np.linalg.norm(D, axis=1)
    ddistance = _rows(place.n, dD)
    dn = (dD - place.n[:, :, None] * ddistance[:, None]) / distance[:, None, None]
    dp = 0.5 * (at_axis[0] + along[0] + at_axis[1] + along[1]) - 0.5 * (parts[0].radius - parts[1].radius) * dn
    changes = [
        point_derivatives(mechanism, q, part.link, part.middle, place.p - m[:, k], dp - at_middle[:, k])
        for k, part in enumerate(parts)
    ]
    return -ddistance, dn, changes[0] - changes[1]


def _inverse(place, a1, a2, half, b):
    """(K, 2, 2) inverse of dg/ds, zero in the rows and columns of clamped s."""
    c = np.einsum("ka,ka->k", a1, a2)
    free1, free2 = (np.abs(place.closest.s) < half).T
    both, determinant = free1 & free2, np.sum(np.cross(a1, a2) ** 2, axis=1) + b * (2.0 + b)
    determinant = np.where(both, determinant, 1.0)
    inverse = np.zeros((len(c), 2, 2))
    inverse[:, 0, 0] = np.where(both, (1.0 + b) / determinant, free1 / (1.0 + b))
    inverse[:, 1, 1] = np.where(both, (1.0 + b) / determinant, free2 / (1.0 + b))
    inverse[:, 0, 1] = inverse[:, 1, 0] = np.where(both, c / determinant, 0.0)
    return inverse


def _rows(a, J):
    """(K, nv) the inner products of a (K, 3) with the columns of J (K, 3, nv)."""
    return np.einsum("ka,kaj->kj", a, J)
