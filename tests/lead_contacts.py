"""Accelerations of a mechanism whose contacts have laws with a lead, by Newton's method on dense matrices.

With a lead the force depends on the acceleration a. It is minus the gradient of a convex function of x = v + lead J a,
so a is where the convex function (a - a0)'M (a - a0)/2 + sum_k Phi_k(x_k)/lead_k is least, a0 the one without contacts.
"""

import numpy as np
from scipy.optimize import brentq

from planner.dynamics import bias, mass_matrix
from planner.dynamics.contact_kinematics import contact_kinematics
from planner.dynamics.contacts import contact_wrench
from planner.dynamics.kinematics import LinkPlaces

MAX_ITERATIONS = 100
ROUNDING = 1e-13  # of the accelerations, what a step may be at the end


def accelerations(mechanism, q, v, tau):
    """qacc (nv,) at q (nq,), v (nv,) and generalized forces tau (nv,); every contact's law has a lead."""
    M = mass_matrix(mechanism, q)
    free = tau - bias(mechanism, q, v)
    contacts = (*mechanism.contacts, *mechanism.body_contacts)
    places = [contact_kinematics(LinkPlaces(mechanism, q), one, v[None]) for one in contacts]
    places = [place for place in places if place.e[0] > 0.0]

    def residual(a):
        """M a - tau + bias - J'f, the function's gradient, and its derivative by a."""
        r, H = M @ a - free, M.copy()
        for place in places:
            law = place.contact.law
            J = np.vstack([place.J[0], turning(place)])
            x = np.append(place.v[0], J[3:] @ v) + law.lead * (J @ a)
            f, by_x = contact_wrench(law, place.n, place.e, x[None, :3], x[None, 3:])
            r -= J.T @ f[0]
            H -= law.lead * J.T @ by_x[0] @ J
        return r, H

    a = np.linalg.solve(M, free)
    for _ in range(MAX_ITERATIONS):
        r, H = residual(a)
        step = -np.linalg.solve(H, r)
        if np.abs(step).max() <= ROUNDING * (1.0 + np.abs(a).max()):
            return a + step
        a = a + _length(residual, a, step) * step
    raise AssertionError("Newton's method has not converged")


def turning(place):
    """The Jacobian (3, nv) of the angular velocity that friction resists; contacts with planes alone have it."""
    return getattr(place, "turning", np.zeros_like(place.J))[0]


def _length(residual, a, step):
    """The step length at which the convex function's slope along the step is 0; 1 where it is below."""

    def slope(length):
        return residual(a + length * step)[0] @ step

    return 1.0 if slope(1.0) <= 0.0 else float(brentq(slope, 0.0, 1.0))
