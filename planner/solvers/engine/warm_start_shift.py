"""A trajectory with gains, moved on in time: the first guess of the next plan of a controller."""

from __future__ import annotations

import numpy as np

from planner.model.space import StateSpace

TrajectoryArrays = tuple[np.ndarray, np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu), K (N, nu, ndx)
Motion = tuple[np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu)

TIME_TOLERANCE = 1e-6  # of a stage: instants that are nearer are the same


def shift_trajectory(to: Motion, motion: Motion, stages: float, space: StateSpace) -> int:
    """Write states and controls, moved on by some stages, which need not be whole; beyond the end the last repeats.

    Args:
        to: Where to.
        motion: Of the same shapes.
        stages: At least 0.
        space: Of the states.

    Returns:
        The whole stages, by which gains move.
    """
    (xs, us), (own_xs, own_us) = to, motion
    m = int(stages + TIME_TOLERANCE)
    part, m = stages - m, min(m, len(us))
    if m == 0:
        xs[:], us[:] = own_xs, own_us
    else:
        left = len(us) - m
        xs[: left + 1], us[:left] = own_xs[m:], own_us[m:]
        xs[left + 1 :], us[left:] = own_xs[-1], own_us[-1]
    if part > TIME_TOLERANCE:
        xs[:-1] = space.integrate(xs[:-1], part * space.difference(xs[1:], xs[:-1]))
    return m
