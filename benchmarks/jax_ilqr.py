"""A peer written here: iLQR in JAX, as a user would write it for speed. It must not be slow by neglect.

Everything is one jitted while loop in float64: no trip to Python between iterations, the rollouts of all step
lengths in one batch, derivatives by forward mode, the one control's Hessian inverted by a division.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from problems import DECREASE, MAX_ITERATIONS, Hopper

jax.config.update("jax_enable_x64", True)

SUFFICIENT = 1e-4
STEPS = 10
MU_LEAST, MU_MOST = 1e-8, 1e8


def compiled(h: Hopper) -> tuple[Callable[[jax.Array], Any], jax.Array]:
    """The compiled solve us (N,) -> (us, cost, iterations, converged), and the first guess."""
    dt, alphas = h.dt, 0.5 ** jnp.arange(STEPS)

    def f(x, u):
        e = jnp.maximum(x[2] - x[0], 0.0)
        soft = jnp.minimum(e, h.smoothing)
        force = h.stiffness * (0.5 / h.smoothing * soft * soft + e - soft)
        return x + dt * jnp.array([x[1], force - h.gravity, u])

    def running(x, u):
        return 0.5 * dt * (h.piston_weight * x[2] ** 2 + h.flow_weight * u**2)

    def final(x):
        return 0.5 * h.final_weight * (x[0] - h.height) ** 2 + x[1] ** 2

    # The cost is quadratic: its Hessians are constants.
    Q, R = jnp.diag(jnp.array([0.0, 0.0, dt * h.piston_weight])), dt * h.flow_weight
    Q_end = jnp.diag(jnp.array([h.final_weight, 2.0, 0.0]))

    def rollout(xs, us, k, K, alpha):
        def stage(carry, ref):
            x, J = carry
            x_ref, u_ref, k, K = ref
            u = u_ref + alpha * k + K @ (x - x_ref)
            return (f(x, u), J + running(x, u)), (x, u)

        (x, J), (xs_new, us_new) = lax.scan(stage, (jnp.zeros(3), 0.0), (xs[:-1], us, k, K))
        return jnp.concatenate([xs_new, x[None]]), us_new, J + final(x)

    def sweep(xs, us, mu):
        A, B = jax.vmap(jax.jacfwd(f, (0, 1)))(xs[:-1], us)

        def stage(carry, z):
            P, s, slope = carry
            A, B, x, u = z
            PA, PB = P @ A, P @ B
            pivot = R + B @ PB + mu
            gradient = R * u + B @ s
            k, K = -gradient / pivot, -(B @ PA) / pivot
            P = Q + A.T @ PA - pivot * jnp.outer(K, K)
            s = Q @ x + A.T @ s - pivot * K * k
            return (0.5 * (P + P.T), s, slope + gradient * k), (k, K)

        end = (Q_end, jax.grad(final)(xs[-1]), 0.0)
        (_, _, slope), (k, K) = lax.scan(stage, end, (A, B, xs[:-1], us), reverse=True)
        return k, K, slope

    def iteration(state):
        xs, us, J, mu, count, _ = state
        k, K, slope = sweep(xs, us, mu)
        xs_all, us_all, J_all = jax.vmap(rollout, (None, None, None, None, 0))(xs, us, k, K, alphas)
        passes = J_all <= J + SUFFICIENT * alphas * slope  # False where J is NaN
        # Only a model without regularization may say that nothing is left to gain.
        done = (-0.5 * slope <= DECREASE) & (mu == 0.0)
        take, i = jnp.any(passes) & ~done, jnp.argmax(passes)
        xs, us = jnp.where(take, xs_all[i], xs), jnp.where(take, us_all[i], us)
        easier = jnp.where(mu > MU_LEAST, 0.1 * mu, 0.0)
        kept = jnp.where(alphas[i] == 1.0, easier, mu)
        mu = jnp.where(done, mu, jnp.where(take, kept, jnp.maximum(10.0 * mu, MU_LEAST)))
        return xs, us, jnp.where(take, J_all[i], J), mu, count + ~done, done

    @jax.jit
    def solve(us):
        zero = jnp.zeros((h.N, 3))
        xs, us, J = rollout(jnp.zeros((h.N + 1, 3)), us, jnp.zeros(h.N), zero, 1.0)
        state = (xs, us, J, 0.0, 0, False)
        _, us, J, _, count, done = lax.while_loop(
            lambda s: ~s[5] & (s[4] < MAX_ITERATIONS) & (s[3] < MU_MOST), iteration, state
        )
        return us, J, count, done

    first = jnp.zeros(h.N)
    return solve.lower(first).compile(), first
