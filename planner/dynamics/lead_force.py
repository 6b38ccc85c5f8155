"""Force of a contact law with a lead, in NumPy, with exact derivatives.

The law is that of model.contact.laws. It depends on x = v + lead J qacc, the velocity that the contact has a lead
later, relative to the surface. With W = n n' + sqrt(impratio) (1 - n n') an elliptic cone's force is

    f = W P(y),   y = K depth n - B s W x,   df/dx = -B s W DP W

P the smoothed projection onto the cone |g_t| <= mu g_n / sqrt(impratio) and DP its derivative.
"""

from __future__ import annotations

import numpy as np

from planner.model.contact.laws import ContactLaw

_MIN_BEND = 1e-9  # so that no number is divided by 0


def contact_frames(n: np.ndarray) -> np.ndarray:
    """(K, 3, 3) MuJoCo's frames of contacts with normals n (K, 3): rows n, t1 and t2 (mju_makeFrame)."""
    start = np.where(np.abs(n[:, 1:2]) < 0.5, np.eye(3)[1], np.eye(3)[2])
    t1 = start - n * np.einsum("ka,ka->k", n, start)[:, None]
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    return np.stack([n, t1, np.cross(n, t1)], axis=1)


def edges(law: ContactLaw, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 5, 3) directions of the force of a pyramidal cone, all n without friction, and their shares (5,)."""
    frames, mu, p = contact_frames(n), law.friction, law.normal_share
    around = [n + side * mu * frames[:, k] for k in (1, 2) for side in (1.0, -1.0)]
    return np.stack([*around, n], axis=1), np.append(np.full(4, 0.25 * (1.0 - p)), p)


def lead_force(
    law: ContactLaw, n: np.ndarray, spring: tuple[np.ndarray, np.ndarray], damping: tuple[np.ndarray, np.ndarray],
    x: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Contact force (K, 3), N, and its derivatives by penetration (K, 3) and by x (K, 3, 3).

    Args:
        law: With a lead.
        n: (K, 3) unit normal.
        spring: (K,) K depth, N, and its derivative by the penetration.
        damping: (K,) B s, N s/m, and its derivative by the penetration.
        x: (K, 3) m/s, the velocity relative to the surface a lead later.
    """
    (k, dk), (b, db) = spring, damping
    if law.is_round:
        root = np.sqrt(law.impratio)
        W = root * np.eye(3) + (1.0 - root) * n[:, :, None] * n[:, None]
        Wx = np.einsum("kab,kb->ka", W, x)
        g, slope = _projection(law.friction / root, law.bend, n, k[:, None] * n - b[:, None] * Wx)
        by = W @ slope
        by_e = np.einsum("kab,kb->ka", by, dk[:, None] * n - db[:, None] * Wx)
        return np.einsum("kab,kb->ka", W, g), by_e, -b[:, None, None] * (by @ W)
    d, share = edges(law, n)
    along = np.einsum("kea,ka->ke", d, x)
    y, f = share * (k[:, None] - b[:, None] * along), float(law.force_ramp or 0.0)
    slope = np.clip(y / f, 0.0, 1.0) if f > 0.0 else (y > 0.0).astype(float)
    force = slope * (y - 0.5 * f * slope)
    by_e = slope * share * (dk[:, None] - db[:, None] * along)
    by_x = -b[:, None, None] * np.einsum("ke,kea,keb->kab", share * slope, d, d)
    return np.einsum("ke,kea->ka", force, d), np.einsum("ke,kea->ka", by_e, d), by_x


def _projection(mu: float, bend: float, n: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of the cone |g_t| <= mu g_n nearest to y (K, 3), smoothed by bend, and its derivative (K, 3, 3)."""
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
    around = np.eye(3) - n[:, :, None] * n[:, None] - u[:, :, None] * u[:, None]
    slope = presses[:, None, None] * (slope + turning[:, None, None] * around)
    return g_n[:, None] * n + g_t[:, None] * u, slope
