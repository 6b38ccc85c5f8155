"""Gradients and Hessians of a cost against differences of its value, derivatives of a step against those of its end."""

import numpy as np
import pytest

from planner.model.space import space_of


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


def step_derivatives(dynamics, xs, us, h=1e-6):
    """A (K, ndx, ndx) and B (K, ndx, nu) of stages from xs (K, nx), us (K, nu): central differences of their ends."""
    space, ends = space_of(dynamics), dynamics.step(xs, us)

    def slope(dx, du):
        sides = [dynamics.step(space.integrate(xs, np.tile(s * dx, (len(xs), 1))), us + s * du) for s in (h, -h)]
        ahead, back = (space.difference(side, ends) for side in sides)
        return (ahead - back) / (2.0 * h)

    by_x = np.stack([slope(e, np.zeros(dynamics.nu)) for e in np.eye(space.ndx)], axis=2)
    return by_x, np.stack([slope(np.zeros(space.ndx), e) for e in np.eye(dynamics.nu)], axis=2)


def assert_step_derivatives(dynamics, xs, us, h=1e-6, within=1e-7):
    """A and B of stages from a state or several with as many controls, `within` the largest entry of each stage.

    Central differences err by h^2 times the third derivatives and by rounding over h, both about 1e-10 at 1e-6.
    """
    xs, us = np.atleast_2d(xs), np.atleast_2d(us)
    found = dynamics.linearize(np.concatenate([xs, xs[-1:]]), us)
    for least, exact, differenced in zip((0.0, 1.0), found, step_derivatives(dynamics, xs, us, h), strict=True):
        scale = np.maximum(least, np.abs(exact).max(axis=(1, 2), keepdims=True))
        np.testing.assert_array_less(np.abs(exact - differenced) / scale, within)


def assert_step_derivatives_near_kinks(dynamics, xs, us, h=1e-7, within=1e-6):
    """The same where forces may have kinks: differences at h and h / 2 tell their own error, which is small mostly."""
    xs, us = np.atleast_2d(xs), np.atleast_2d(us)
    found = dynamics.linearize(np.concatenate([xs, xs[-1:]]), us)
    both = (step_derivatives(dynamics, xs, us, size) for size in (h, 0.5 * h))
    for exact, far, near in zip(found, *both, strict=True):
        size, apart = max(1.0, np.abs(exact).max()), np.abs(near - far)
        np.testing.assert_array_less(np.abs(exact - near), within * size + 2.0 * apart)
        assert np.median(apart) < within * size


def second_order_differences(dynamics, xs, us, costates, h=1e-5):
    """T (N, nx+nu, nx+nu) in z = (x, u), by central differences of A and B: h^2 and 1e-16 / h are equal at 1e-5."""
    nx = xs.shape[1]

    def gradient(dz):
        A, B = dynamics.linearize(xs + dz[:nx], us + dz[nx:])
        return np.einsum("nij,ni->nj", np.concatenate([A, B], axis=2), costates[1:])

    return np.stack([(gradient(dz) - gradient(-dz)) / (2.0 * h) for dz in h * np.eye(nx + us.shape[1])], axis=1)
