"""The largest payload of the weightlifter (reference [20]): of a slow lift in closed form, of a swing by bisection.

Held still, an arm needs the torques of gravity, and these are linear in the payload m:

    g(q, m) = g0(q) + m g1(q),     |g0 + m g1| <= limit    for every joint and every pose of the way,

so the largest m is a minimum of quotients. A swing has no such formula. A payload counts as lifted when a plan was
found that converged, ends at its goal and keeps every torque within its limit; then a larger one is tried. The last
payload's motion, followed with gains, is the best first guess: heavy loads are hardly ever lifted from another. What
comes out is a lower bound: SLQ finds local minima, and what was not lifted from these guesses may be from others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from planner.base.arguments import array, count, number
from planner.base.errors import PlannerError
from planner.cases.puma import (
    HEAVIEST,
    JOINTS,
    LIGHTEST,
    RATED,
    ROUNDING,
    TOLERANCE,
    Style,
    puma,
    puma_mechanism,
    straight_lift,
)
from planner.cases.puma import torque_limits as puma_limits
from planner.dynamics.algorithms import bias
from planner.problem.plan import Plan, Status
from planner.solvers.gains import warm_start
from planner.solvers.slq import solve

FOLLOWED = "followed"  # the guess of an attempt that follows the last payload's motion
_STRIDE = 1.3  # from one payload to the next while all are lifted
_STAGES = 50  # a second, while searching: a plan for a proof has twice as many
_ITERATIONS = {False: 400, True: 1500}  # of one attempt, without and with limits of joint speeds; most need a third


@dataclass(frozen=True)
class StaticLimit:
    """The largest payload that can be held still in every one of some poses.

    Attributes:
        payload: kg; 0 where not even the empty hand can be held.
        joint: The first to reach its limit.
        pose: (6,) rad, where.
    """

    payload: float
    joint: str
    pose: np.ndarray


@dataclass(frozen=True)
class Attempt:
    """One plan on the way to the largest payload.

    Attributes:
        payload: kg.
        guess: The first guess: a style of the case, or "followed" for the motion of the last payload lifted.
        status: Of the solve.
        iterations: It took.
        cost: Of the plan.
        torque_share: Largest torque over its limit.
        miss: Largest distance from the goal, rad or rad/s.
        lifted: Whether it counts.
    """

    payload: float
    guess: str
    status: Status
    iterations: int
    cost: float
    torque_share: float
    miss: float
    lifted: bool

    def __str__(self) -> str:
        verdict = "lifted" if self.lifted else f"not lifted ({self.status.name})"
        return (
            f"{self.payload:7.2f} kg  {self.guess:12s}  {self.iterations:4d} iterations  "
            f"torque {self.torque_share:6.3f} of the limit  miss {self.miss:.1e}  {verdict}"
        )


@dataclass(frozen=True)
class LargestPayload:
    """Result of largest_payload().

    Attributes:
        payload: The largest that was lifted, kg.
        failed: The smallest above it that was not, kg: the bracket.
        static: Limit of a slow lift along the straight line.
        held: Limit of holding still everywhere on the plan's way: where it is less than the payload, no slow motion on
            the same way could lift as much.
        plan: Of the largest payload.
        attempts: All, in order.
    """

    payload: float
    failed: float
    static: StaticLimit
    held: StaticLimit
    plan: Plan
    attempts: tuple[Attempt, ...]

    @property
    def ratio(self) -> float:
        """The payload over the static limit."""
        return self.payload / self.static.payload


def static_limit(path: Any = None, limits: Any = None) -> StaticLimit:
    """The largest payload that motors can hold still in every pose of a way; exact, pose by pose.

    Args:
        path: (P, 6) joint angles, rad; the straight lift by default.
        limits: (6,) N m; those of the case by default.

    Raises:
        PlannerError: A wrong shape, or numbers that are not finite.
    """
    path = straight_lift() if path is None else array("path", path, ("P", 6))
    limits = puma_limits() if limits is None else array("limits", limits, (6,))
    still = np.zeros_like(path)
    light, heavy = (bias(puma_mechanism(m), path, still) for m in (RATED, 2.0 * RATED))
    g1 = (heavy - light) / RATED
    g0 = light - RATED * g1
    with np.errstate(divide="ignore", invalid="ignore"):  # a joint that does not feel the payload: no bound from it
        most = np.where(np.abs(g0) > limits, 0.0, (limits - np.sign(g1) * g0) / np.abs(g1))
    most = np.where(np.isnan(most), np.inf, most)
    pose, joint = np.unravel_index(int(np.argmin(most)), most.shape)
    return StaticLimit(float(most[pose, joint]), JOINTS[joint], path[pose].copy())


def largest_payload(
    *, duration: float = 2.5, resolution: float = 0.5, most: float = HEAVIEST, horizon: int | None = None,
    callback: Callable[[Attempt], object] | None = None, **parameters: Any,
) -> LargestPayload:  # fmt: skip
    """The largest payload for which a swing within the torque limits is found, by bisection with warm starts.

    Args:
        duration: Of the lift, s.
        resolution: The bracket at the end, kg.
        most: Where the search stops, kg.
        horizon: Stages; by default 50 a second.
        callback: Called with each Attempt; print makes a table.
        parameters: Others of the case, e.g. rated=20.

    Raises:
        PlannerError: A parameter out of range, or no swing for the payload that a slow lift can do.
    """
    duration = number("duration", duration, greater_than=0.0)
    resolution = number("resolution", resolution, greater_than=0.0)
    most = number("most", most, minimum=LIGHTEST, maximum=HEAVIEST)
    horizon = max(1, round(_STAGES * duration)) if horizon is None else count("horizon", horizon)
    for name in ("payload", "guess"):
        if name in parameters:
            raise PlannerError(f"{name} is given, expected other parameters of the case: this one is searched for.")
    limits = puma_limits(parameters.get("rated", RATED))
    static = static_limit(None, limits)
    attempts: list[Attempt] = []

    def lift(payload: float, last: Plan | None, guesses: tuple[str, ...]) -> Plan | None:
        """A plan that lifts the payload, from the first guess that leads to one."""
        for guess in guesses:
            styled = {} if guess == FOLLOWED else {"guess": guess}
            problem = puma(payload, duration, horizon, **styled, **parameters)
            if guess == FOLLOWED and last is not None:
                problem = replace(problem, us=warm_start(last, problem))
            plan = solve(problem, max_iterations=_ITERATIONS[parameters.get("speed_limit") is not None])
            attempts.append(_judged(plan, payload, guess, limits))
            if callback is not None:
                callback(attempts[-1])
            if attempts[-1].lifted:
                return plan
        return None

    low, high, tried = 0.0, np.inf, min(static.payload, most)
    best: Plan | None = None
    styles: tuple[str, ...] = get_args(Style)
    while high - low > resolution and low < most:
        if np.isfinite(high):  # between two payloads only what has lifted one
            styles = tuple(style for style in styles if any(a.lifted and a.guess == style for a in attempts))
        plan = lift(tried, best, styles if best is None else (FOLLOWED, *styles))
        if plan is not None:
            low, best = tried, plan
        else:
            high = tried
        if best is None:
            raise PlannerError(f"no swing of {duration:g} s was found for {tried:g} kg, expected a longer duration.")
        tried = min(_STRIDE * low, most) if np.isinf(high) else 0.5 * (low + high)
    assert best is not None
    held = static_limit(best.xs[:, :6], limits)
    return LargestPayload(low, float(high), static, held, best, tuple(attempts))


def _judged(plan: Plan, payload: float, guess: str, limits: np.ndarray) -> Attempt:
    assert plan.problem is not None
    with np.errstate(invalid="ignore"):
        share = float(np.max(np.abs(plan.us) / limits))
        miss = float(np.max(np.abs(plan.xs[-1] - plan.problem.cost.x_ref[-1])))  # type: ignore[attr-defined]
    lifted = plan.success and share <= 1.0 + ROUNDING and miss <= TOLERANCE
    return Attempt(payload, guess, plan.status, plan.nit, plan.cost, share, miss, lifted)
