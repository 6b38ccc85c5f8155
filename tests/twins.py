"""The kernels of a machine's passive forces beside the readable twin of its dynamics."""

import numpy as np
from trees import stepped

from planner.dynamics import algorithms, product_of_exponentials
from planner.proof.compare.rigid_parity import random_states


def assert_kernels_are_their_twin(m):
    """Derivatives by an imaginary step in the readable twin, exact to rounding: sums of some hundred terms."""
    rng = np.random.default_rng(0)
    xs, qdd = random_states(m, rng, 4), rng.normal(size=(4, m.nv))
    q, qd = xs[:, : m.nq], xs[:, m.nq : m.nq + m.nv]
    tau, derivatives = algorithms.rnea(m, q, qd, qdd), algorithms.rnea_derivatives(m, q, qd, qdd)
    np.testing.assert_allclose(algorithms.forward_dynamics(m, q, qd, tau), qdd, rtol=1e-8, atol=1e-9)
    for k in range(4):
        scale = np.abs(tau[k]).max()
        assert np.abs(product_of_exponentials.rnea(m, q[k], qd[k], qdd[k]) - tau[k]).max() < 1e-12 * scale
        assert np.abs(product_of_exponentials.forward_dynamics(m, q[k], qd[k], tau[k]) - qdd[k]).max() < 1e-8
        for j, e in enumerate(np.eye(m.nv)):
            by_qd = product_of_exponentials.rnea(m, q[k], qd[k] + 1e-30j * e, qdd[k]).imag / 1e-30
            assert np.abs(by_qd - derivatives.qd[k, :, j]).max() < 1e-12 * np.abs(derivatives.qd[k]).max()
            by_q = product_of_exponentials.rnea(m, stepped(m, q[k], e, 1e-30j), qd[k], qdd[k]).imag / 1e-30
            assert np.abs(by_q - derivatives.q[k, :, j]).max() < 1e-12 * np.abs(derivatives.q[k]).max()
