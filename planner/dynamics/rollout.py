"""Rollouts: simulated states of open-loop controls or feedback."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from planner.dynamics.protocol import Dynamics
from planner.model.space import space_of

Control = Callable[[int, np.ndarray], np.ndarray]  # (stage, state (nx,)) -> control (nu,)


def rollout(
    dynamics: Dynamics, x0: np.ndarray, us: np.ndarray, control: Control | None = None, *,
    bounds: Any = None, limit: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """States (N+1, nx) and controls (N, nu) of a trajectory from x0 (nx,).

    Args:
        dynamics: Any dynamics.
        x0: (nx,) initial state.
        us: (N, nu) controls.
        control: Feedback law that replaces us.
        bounds: The ControlBounds that clip each control; None for none.
        limit: Magnitude of a state component at which the rollout ends: the states from there on are NaN, the
            controls unchanged.
    """
    xs, us = np.full((len(us) + 1, dynamics.nx), np.nan), us.copy()
    xs[0] = x0
    for n in range(len(us)):
        if control is not None:
            us[n] = control(n, xs[n])
        if bounds is not None:
            us[n] = bounds.clip(n, us[n], xs[n])
        x = dynamics.step(xs[n : n + 1], us[n : n + 1])[0]
        if not np.all(np.abs(x) < limit):
            break
        xs[n + 1] = x
    return xs, us


def rollout_states(dynamics: Dynamics, x0: np.ndarray, us: np.ndarray) -> np.ndarray:
    """The states (N+1, nx) of controls (N, nu) from x0 (nx,); NaN from the first that is not finite."""
    return rollout(dynamics, x0, us)[0]


def feedback_control(dynamics: Dynamics, xs: np.ndarray, us: np.ndarray, K: np.ndarray) -> Control:
    """Feedback law u = us[n] + K[n] (x - xs[n]) of states (N+1, nx), controls (N, nu) and gains (N, nu, ndx)."""
    space = space_of(dynamics)
    return lambda n, x: us[n] + K[n] @ space.difference(x, xs[n])
