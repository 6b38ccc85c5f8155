"""Gradients and Hessians of a cost against differences of its value, derivatives of a step against those of its end."""

import numpy as np
import pytest


def spd(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def assert_gradients(cost, space, xs, us):
    """Every component of q and r against central differences of the value, through integrate."""
    model, h = cost.quadratize(xs, us), 1e-5
    scale = max(1.0, np.abs(model.q).max(), np.abs(model.r).max())
    for n, i in np.ndindex(len(xs), space.ndx):
        values = []
        for sign in (h, -h):
            moved = xs.copy()
            moved[n] = space.integrate(xs[n], sign * np.eye(space.ndx)[i])
            values.append(cost.value(moved, us))
        assert (values[0] - values[1]) / (2 * h) == pytest.approx(model.q[n, i], rel=1e-6, abs=1e-7 * scale)
    for n, i in np.ndindex(*us.shape):
        d = np.zeros_like(us)
        d[n, i] = h
        slope = (cost.value(xs, us + d) - cost.value(xs, us - d)) / (2 * h)
        assert slope == pytest.approx(model.r[n, i], rel=1e-6, abs=1e-7 * scale)
    return model


def hessian(cost, space, xs, us, n, h=1e-4):
    """Second differences of the value with respect to a deviation of x(n)."""
    d = h * np.eye(space.ndx)

    def value(dx):
        moved = xs.copy()
        moved[n] = space.integrate(xs[n], dx)
        return cost.value(moved, us)

    H = np.empty((space.ndx, space.ndx))
    for i, j in np.ndindex(*H.shape):
        terms = value(d[i] + d[j]) - value(d[i] - d[j]) - value(d[j] - d[i]) + value(-d[i] - d[j])
        H[i, j] = terms / (4 * h * h)
    return H


def assert_step_derivatives(dynamics, x, u):
    """A and B of one stage from x (nx,) with u (nu,) against central differences of its end, through integrate."""
    space, h = dynamics.space, 1e-6
    A, B = (part[0] for part in dynamics.linearize(np.stack([x, x]), u[None]))
    end = dynamics.step(x[None], u[None])[0]

    def slope(dx, du):
        ahead, back = (dynamics.step(space.integrate(x, s * dx)[None], (u + s * du)[None])[0] for s in (h, -h))
        return (space.difference(ahead, end) - space.difference(back, end)) / (2.0 * h)

    by_x = np.stack([slope(e, np.zeros(dynamics.nu)) for e in np.eye(space.ndx)], axis=1)
    by_u = np.stack([slope(np.zeros(space.ndx), e) for e in np.eye(dynamics.nu)], axis=1)
    # central differences: h^2 of the third derivatives and rounding over h, both about 1e-10 of entries of size 1
    np.testing.assert_allclose(A, by_x, atol=1e-7 * np.abs(A).max())
    np.testing.assert_allclose(B, by_u, atol=1e-7 * max(1.0, np.abs(B).max()))
