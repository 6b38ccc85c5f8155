"""A problem with another discretization: finer, after a failed proof, or with another duration.

A problem with a recipe is rebuilt from it, so that a plan's file can store it. Any other is made from its parts:
`dynamics.with_step(dt, integrator)`, `cost.resampled(parts, ratio)`, and a first guess that is constant over the parts
of each stage. A new cost or new dynamics need these two methods.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.protocol import integrator_of
from planner.dynamics.step_stability import MAX_RATE_STEP, fastest_mode, reason, substeps_of
from planner.model.passive_forces import damped_implicitly
from planner.problem.costs.terms import call_if_supported
from planner.problem.costs.tracking import tracking_of
from planner.problem.objective_problem import base_problem, with_objective
from planner.problem.problem import Problem

MAX_STAGES = 100_000
FINEST = "rk4"  # of explicit integrators


def finer(problem: Problem) -> Problem:
    """A problem with the next finer discretization.

    An integrator of first order becomes the one of its kind that is finer at the same stage, which leaves the cost as
    it is. RK4 and the implicit method get stages of half the length: a stage weight becomes two of half its size, with
    the same reference, and the final weight stays, so that the cost still approximates the same integral.

    Raises:
        PlannerError: Parts without with_step and resampled, or more than 100 000 stages.
    """
    if problem.objective is not None:
        return with_objective(finer(base_problem(problem)), problem.objective.weights)
    known = integrator_of(problem.dynamics)
    parts, finest = 1 if known.order == 1 else 2, known.finer
    if parts * problem.N > MAX_STAGES:
        raise PlannerError(f"half the stage makes {parts * problem.N} stages, expected at most {MAX_STAGES}.")
    dt = problem.dynamics.dt / parts
    limits = None if problem.limits is None else problem.limits.repeated(parts)
    if problem.recipe is not None and "integrator" in problem.recipe.parameters:
        step = {"dt": dt} if "dt" in problem.recipe.parameters else {"horizon": parts * problem.N}
        return replace(base_problem(problem.recipe.rebuilt(integrator=finest, **step)), limits=limits)
    return replace(
        problem, dynamics=_with_step(problem.dynamics, dt, finest), horizon=parts * problem.N,
        us=np.repeat(problem.first_guess, parts, axis=0), limits=limits,
        constraints=[one.resampled(parts) for one in problem.constraints],
        cost=problem.cost if parts == 1 else call_if_supported(problem.cost, "resampled", parts, 1.0 / parts),
    )  # fmt: skip


def retimed(problem: Problem, duration: float) -> Problem:
    """The same task with the same number of stages in another duration (s); first guess of the controls unchanged.

    Raises:
        PlannerError: Parts without with_step and resampled.
    """
    if problem.objective is not None:
        return with_objective(retimed(base_problem(problem), duration), problem.objective.weights)
    dt = duration / problem.N
    if problem.recipe is not None and "duration" in problem.recipe.parameters:
        step = {"dt": dt} if "dt" in problem.recipe.parameters else {}
        new = base_problem(problem.recipe.rebuilt(duration=duration, **step))
        return replace(new, limits=problem.limits, us=problem.first_guess, twin=problem.twin)
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


def substeps_reason(problem: Problem) -> str:
    """Message with the reason for the number of substeps; "" for dynamics without a mechanism or without RK4."""
    dynamics, goal = problem.dynamics, tracking_of(problem.cost)
    if not isinstance(dynamics, RigidBodyDynamics) or dynamics.integrator != "rk4":
        return ""
    states = [problem.x0, dynamics.mechanism.home, *([] if goal is None else [goal.x_ref[-1]])]
    return reason(fastest_mode(dynamics.mechanism, states, dynamics.prescribed), dynamics.substeps)


def stage_too_long(problem: Problem) -> str:
    """Message with a fix if the integration step is too long for the machine's fastest mode; else ""."""
    dynamics = problem.dynamics
    known = integrator_of(dynamics)
    if not isinstance(dynamics, RigidBodyDynamics) or dynamics.integrator == known.finer != FINEST:
        return ""
    machine = damped_implicitly(dynamics.mechanism, dynamics.dt) if known.implicit else dynamics.mechanism
    found = fastest_mode(machine, [problem.x0, machine.home], dynamics.prescribed)
    step = dynamics.dt / dynamics.substeps
    if found.rate * step <= MAX_RATE_STEP:
        return ""
    try:
        wanted = f'integrator="{known.finer}"'
        if known.finer == FINEST:
            wanted += f", substeps={substeps_of(found, dynamics.dt)}"
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
