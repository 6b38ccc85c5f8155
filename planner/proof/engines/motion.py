"""A plan's motion by any equation of motion, with SciPy's DOP853 from stage to stage.

Controls are held over a stage, so each stage is integrated by itself: within it the equation is smooth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import product, unit
from planner.problem.plan import Plan

PARTS = 4  # places of a stage at which the motion is compared
RELATIVE, ABSOLUTE = 1e-10, 1e-12  # tolerances of the integrator
RUNAWAY = 1e10  # beyond it there is no motion, as for MuJoCo
_MAX_EVALUATIONS = 500  # evaluations per stage, on the average; a stage of a hundredth of a second takes about twenty

Rates = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(qvel, qacc, d act/dt), (2 nv + na,), at one state x (nx,) with the controls u (nu,)."""


class _RanAway(Exception):
    """The motion has left all bounds."""


def motion(plan: Plan, mechanism: Mechanism, x0: np.ndarray, rates: Rates, feedback: bool) -> np.ndarray:
    """States (N * PARTS + 1, nx) from x0 under a plan's controls; NaN from where they ran away.

    With `feedback` the plan's gains act at every evaluation, on the deviation from the plan at that instant, between
    knots too.
    """
    from scipy.integrate import solve_ivp

    assert plan.problem is not None  # its dynamics are asked
    dynamics, space, evaluations = plan.problem.dynamics, plan.space, 0
    xs = np.full((plan.N * PARTS + 1, len(x0)), np.nan)
    xs[0] = x = x0
    dt = float(dynamics.dt)
    times = dt / PARTS * np.arange(1, PARTS + 1)

    def rate(t: float, x: np.ndarray, n: int) -> np.ndarray:
        nonlocal evaluations
        evaluations += 1
        if evaluations > _MAX_EVALUATIONS * plan.N or not np.all(np.abs(x) < RUNAWAY):
            raise _RanAway
        x, u = normalized(mechanism, x), plan.us[n]
        if feedback:
            wanted = dynamics.step(plan.xs[n : n + 1], plan.us[n : n + 1], np.array([t]))[0]
            u = plan.within_bounds(n, u + plan.K[n] @ space.difference(x, wanted), x)
        return _lifted(mechanism, x, rates(x, u))

    for n in range(plan.N):
        try:
            found = solve_ivp(
                rate, (0.0, dt), x, method="DOP853", t_eval=times, args=(n,), rtol=RELATIVE, atol=ABSOLUTE
            )
        except _RanAway:
            break
        if not found.success or found.y.shape[1] != PARTS:
            break
        rows = normalized(mechanism, found.y.T)
        xs[n * PARTS + 1 : (n + 1) * PARTS + 1], x = rows, rows[-1]
    return xs


def normalized(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """States (..., nx) with quaternions of length one."""
    if not mechanism.quaternions:
        return x
    x = np.array(x)
    for address, _ in mechanism.quaternions:
        x[..., address : address + 4] = unit(x[..., address : address + 4])
    return x


def _lifted(mechanism: Mechanism, x: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """dx/dt (nx,) of rates (2 nv + na,): quaternions turn with the velocity in the body's frame."""
    nq, nv = mechanism.nq, mechanism.nv
    result = np.empty(len(x))
    result[nq:] = rates[nv:]
    screws = mechanism.kind == SCREW
    result[mechanism.q_address[screws]] = rates[:nv][screws]
    for address, dof in mechanism.quaternions:
        turning = np.concatenate([[0.0], rates[dof : dof + 3]])
        result[address : address + 4] = 0.5 * product(x[address : address + 4], turning)
    return result
