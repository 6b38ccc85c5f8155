"""Whether the steps of a plan resolve its motion: the local errors of its stages, carried along its closed loop.

    d(n)      error of stage n: two steps of half its length from its own knot, less the one step; by step doubling
              2^p / (2^p - 1) of that, p the integrator's order (Hairer, Norsett and Wanner, section II.4)
    e(n+1) = (A + B K)(n) e(n) + d(n)

Gains of multipliers and penalties may be so large that they amplify instead: where e(n+1) = A(n) e(n) + d(n) stays
smaller, the controls alone resolve the motion, and its error counts.

A plan with an error above UNRESOLVED (of Euler's methods COARSE) of a coordinate's range of motion is a motion of its
integrator, not of its machine: its cost is no number of the machine either.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.protocol import integrator_of
from planner.model.coordinates import coordinates_of
from planner.problem.plan import Plan

UNRESOLVED = 0.05  # of a range of motion: the loosest bound of a path in a proof, so no replay of such a plan passes
COARSE = 1.0  # the same for methods of first order, which a proof judges: an error as large as the motion itself
MIN_RANGE = 1e-3  # rad, m, rad/s, m/s, smallest range of motion, for a machine at rest
OF_LARGEST = 0.1  # smallest range of motion, as a share of the largest of its unit


def is_unresolved(plan: Plan) -> bool:
    """Whether the predicted error of a plan's steps is above its bound."""
    dynamics = None if plan.problem is None else plan.problem.dynamics
    return step_error(plan) > (COARSE if integrator_of(dynamics).order == 1 else UNRESOLVED)


@np.errstate(all="ignore")  # of a linear prediction that overflows: infinite
def step_error(plan: Plan) -> float:
    """The largest predicted error of a coordinate over its range of motion; NaN where no stage can be halved."""
    assert plan.problem is not None  # its dynamics step
    dynamics, space = plan.problem.dynamics, plan.space
    order = integrator_of(dynamics).order
    if order is None or not np.isfinite(plan.xs).all() or not np.isfinite(plan.K).all():
        return np.nan
    half = np.full(plan.N, 0.5 * dynamics.dt)
    middle = dynamics.step(plan.xs[:-1], plan.us, half)
    ends = dynamics.step(middle, plan.us, half)
    errors = space.difference(ends, plan.xs[1:]) * 2.0**order / (2.0**order - 1.0)
    A, B = dynamics.linearize(plan.xs, plan.us)
    own = np.ptp(space.difference(plan.xs, plan.xs[0]), axis=0)
    units = np.array([one.unit for one in coordinates_of(dynamics)])
    ranges = np.maximum(own, OF_LARGEST * np.array([own[units == unit].max() for unit in units]))
    ranges = np.maximum(ranges, MIN_RANGE)
    return min(_propagated(F, errors / ranges, ranges) for F in (A + B @ plan.K, A))


def _propagated(F: np.ndarray, shares: np.ndarray, ranges: np.ndarray) -> float:
    """The largest share of the ranges (ndx,) that errors become by stage matrices F (N, ndx, ndx)."""
    e, largest = np.zeros(len(ranges)), 0.0
    for matrix, error in zip(F * ranges / ranges[:, None], shares, strict=True):
        e = matrix @ e + error
        worst = float(np.abs(e).max())
        largest = max(largest, worst) if np.isfinite(worst) else np.inf
    return largest
