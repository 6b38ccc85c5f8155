"""The minimum of a quadratic over a box, in NumPy: the twin of kernels.lq.box_qp.

minimize 1/2 k'H k + h'k   over   lower <= k <= upper,   where lower <= 0 <= upper
"""

from __future__ import annotations

import numpy as np

MAX_STEPS = 100
SHORTEST = 1e-10
SUFFICIENT = 0.1


def box_minimum(H: np.ndarray, h: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The minimum by projected Newton steps from 0 (Bertsekas 1982).

    Args:
        H: (nu, nu) symmetric.
        h: (nu,).
        lower: (nu,) at most 0.
        upper: (nu,) at least 0.

    Returns:
        k (nu,), and which of it is clamped (nu,).

    Raises:
        numpy.linalg.LinAlgError: H is not positive definite where k is free.
    """
    k, clamped, full = np.zeros_like(h), np.zeros(len(h), dtype=bool), False
    for _ in range(MAX_STEPS):
        g = h + H @ k
        before, clamped = clamped, ((k <= lower) & (g > 0.0)) | ((k >= upper) & (g < 0.0))
        if full and np.array_equal(before, clamped):
            break
        free, d = np.flatnonzero(~clamped), np.zeros_like(h)
        L = np.linalg.cholesky(H[np.ix_(free, free)])
        if np.isnan(L).any():  # NumPy lets a NaN through
            raise np.linalg.LinAlgError("a matrix that is not a number")
        d[free] = -np.linalg.solve(L.T, np.linalg.solve(L, g[free]))
        step = 1.0
        while True:
            wanted = k + step * d
            into = np.clip(wanted, lower, upper)
            full, moved = step == 1.0 and np.array_equal(into, wanted), into - k
            slope = float(g @ moved)
            if full or slope + 0.5 * float(moved @ H @ moved) <= SUFFICIENT * slope or step < SHORTEST:
                break
            step *= 0.5
        if step < SHORTEST:  # nothing left to gain but rounding
            break
        k = into
    return k, clamped
