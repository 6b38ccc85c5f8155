"""A problem with another discretization, finer or of another duration; and whether a plan's steps resolve its motion.

A problem with a recipe is rebuilt from it, so that a plan's file can store it. Any other is made from its parts:
`dynamics.with_step(dt, integrator)`, `cost.resampled(parts, ratio)`, and a first guess that is constant over the parts
of each stage. A new cost or new dynamics need these two methods.

Steps resolve a motion by the local errors of its stages, carried along its closed loop:

    d(n)      error of stage n: two steps of half its length from its own knot, less the one step; by step doubling
              2^p / (2^p - 1) of that, p the integrator's order (Hairer, Norsett and Wanner, section II.4)
    e(n+1) = (A + B K)(n) e(n) + d(n)

Gains of multipliers and penalties may be so large that they amplify instead: where e(n+1) = A(n) e(n) + d(n) stays
smaller, the controls alone resolve the motion, and its error counts.

A plan with an error above UNRESOLVED (of a method without substeps COARSE) of a coordinate's range of motion moves as
its integrator does, not as its machine: its cost is no number of the machine either.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.protocol import integrator_of
from planner.dynamics.step_stability import MAX_RATE_STEP, fastest_mode, substeps_of
from planner.model.coordinates import coordinates_of
from planner.problem.costs.terms import call_if_supported
from planner.problem.objective import base_problem, with_objective
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.problem_parts import FOUND, MAX_STAGES

FINEST = "rk4"  # of explicit integrators
UNRESOLVED = 0.05  # of a range of motion: as the loosest bound of a path in a proof, whose replay measures
COARSE = 1.0  # the same for Euler's methods, whose steps are stages: an error as large as the motion itself
MIN_RANGE = 1e-3  # rad, m, rad/s, m/s, smallest range of motion, for a machine at rest
OF_LARGEST = 0.1  # smallest range of motion, as a share of the largest of its unit


def finer(problem: Problem, keep_substeps: bool = False) -> Problem:
    """A problem with the next finer discretization.

    An integrator of first order becomes the one of its kind that is finer at the same stage, which leaves the cost as
    it is. RK4 and the implicit method get stages of half the length: a stage weight becomes two of half its size, with
    the same reference, and the final weight stays, so that the cost still approximates the same integral.

    Args:
        problem: Any.
        keep_substeps: Whether a stage keeps its number of substeps. Else it has as many as make them no longer, where
            the planner chooses them: then half a stage may be integrated in steps that are hardly shorter.

    Raises:
        PlannerError: Parts without with_step and resampled, or more than 100 000 stages.
    """
    if problem.objective is not None:
        return with_objective(finer(base_problem(problem), keep_substeps), problem.objective.stored)
    known = integrator_of(problem.dynamics)
    parts, finest = 1 if known.order == 1 else 2, known.finer
    if parts * problem.N > MAX_STAGES:
        raise PlannerError(f"half the stage makes {parts * problem.N} stages, expected at most {MAX_STAGES}.")
    dt = problem.dynamics.dt / parts
    limits = None if problem.limits is None else problem.limits.repeated(parts)
    if problem.recipe is not None and "integrator" in problem.recipe.parameters:
        step = {"dt": dt} if "dt" in problem.recipe.parameters else {"horizon": parts * problem.N}
        if keep_substeps and parts > 1 and "substeps" in problem.recipe.parameters:
            step["substeps"] = getattr(problem.dynamics, "substeps", 1)
        return replace(base_problem(problem.recipe.rebuilt(integrator=finest, **step)), limits=limits)
    dynamics = _with_step(problem.dynamics, dt, finest)
    if keep_substeps and parts > 1 and type(dynamics) is RigidBodyDynamics:
        own = dynamics.mechanism, dt, finest, dynamics.prescribed
        dynamics = RigidBodyDynamics(*own, getattr(problem.dynamics, "substeps", 1))
    return replace(
        problem, dynamics=dynamics, horizon=parts * problem.N,
        us=np.repeat(problem.first_guess, parts, axis=0), limits=limits,
        constraints=[one.resampled(parts) for one in problem.constraints],
        cost=problem.cost if parts == 1 else call_if_supported(problem.cost, "resampled", parts, 1.0 / parts),
    )  # fmt: skip


def retimed(problem: Problem, duration: float) -> Problem:
    """The same task with the same number of stages in another duration (s); first guess of the controls unchanged.

    Where the objective has time, solve() seeks the duration again.

    Raises:
        PlannerError: Parts without with_step and resampled.
    """
    if problem.objective is not None:
        return with_objective(retimed(base_problem(problem), duration), problem.objective.stored | {FOUND: False})
    dt = duration / problem.N
    if problem.recipe is not None and "duration" in problem.recipe.parameters:
        names = problem.recipe.parameters
        guess = {"guess": names["guess"]} if "guess" in names else {}  # its own is not needed, and may take long
        changes = ({"dt": dt} if "dt" in names else {}) | dict.fromkeys(guess, "zero")
        new = base_problem(problem.recipe.rebuilt(duration=duration, **changes))
        recipe = new.recipe and replace(new.recipe, parameters=new.recipe.parameters | guess, _parts=())
        return replace(new, limits=problem.limits, us=problem.first_guess, twin=problem.twin, recipe=recipe)
    dynamics = _with_step(problem.dynamics, dt, getattr(problem.dynamics, "integrator", None))
    return replace(
        problem, dynamics=dynamics, cost=call_if_supported(problem.cost, "resampled", 1, dt / problem.dynamics.dt)
    )


def lengthened(problem: Problem, ratio: float) -> Problem:
    """The same task in about `ratio` times its duration, in stages of the same length where its recipe says so.

    The duration is rounded up to tenths of a second where that adds little.

    Raises:
        PlannerError: As retimed.
    """
    dt = problem.dynamics.dt
    duration = rounded_duration(problem, ratio)
    names = () if problem.recipe is None else problem.recipe.parameters
    if problem.objective is None and problem.recipe is not None and {"duration", "dt"} <= set(names):
        return replace(problem.recipe.rebuilt(duration=duration, dt=dt), limits=problem.limits)
    return retimed(problem, duration)


def rounded_duration(problem: Problem, ratio: float) -> float:
    """A duration at least `ratio` times as long, s: of whole stages, in tenths of a second where that adds little."""
    dt, N = problem.dynamics.dt, int(np.ceil(problem.N * ratio - 1e-9))
    tenth = round(0.1 / dt)
    if tenth and abs(tenth * dt - 0.1) < 1e-12 and tenth <= 0.1 * N:
        N = -(-N // tenth) * tenth
    return float(f"{N * dt:.6g}")


def stage_too_long(problem: Problem) -> str:
    """Message with a fix if the integration step is too long for the machine's fastest mode; else ""."""
    dynamics = problem.dynamics
    known = integrator_of(dynamics)
    if not isinstance(dynamics, RigidBodyDynamics) or dynamics.integrator == known.finer != FINEST:
        return ""
    states, step = [problem.x0, dynamics.mechanism.home], dynamics.dt / dynamics.substeps
    fastest = partial(fastest_mode, states=states, prescribed=dynamics.prescribed)
    found = fastest(dynamics.stepped_mechanism(dynamics.dt))
    if found.rate * step <= MAX_RATE_STEP:
        return ""
    try:
        wanted = f'integrator="{known.finer}"'
        if known.finer == FINEST:
            wanted += f", substeps={substeps_of(fastest(dynamics.mechanism), dynamics.dt)}"
    except PlannerError as error:
        return str(error)
    return f"{found.joint} has a rate of {found.rate:.4g} per s and a step takes {step:.3g} s, expected {wanted}."


def _with_step(dynamics: Any, dt: float, integrator: str | None) -> Any:
    if not callable(getattr(dynamics, "with_step", None)):
        raise PlannerError(
            f"the dynamics are of the type {type(dynamics).__name__}, expected dynamics with "
            "with_step(dt, integrator): nothing else can be given another stage."
        )
    return dynamics.with_step(dt, integrator)


def is_unresolved(plan: Plan) -> bool:
    """Whether the predicted error of a plan's steps is above its bound."""
    dynamics = None if plan.problem is None else plan.problem.dynamics
    return step_error(plan) > (UNRESOLVED if integrator_of(dynamics).has_substeps else COARSE)


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
