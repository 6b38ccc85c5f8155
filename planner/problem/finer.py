"""The same problem with a finer discretisation: first another integrator, then half the stage.

An integrator of first order (both of Euler's) becomes RK4 at the same stage, which leaves the cost as it is. RK4 gets
stages of half the length: a stage weight becomes two of half its size, with the same reference, and the final weight
stays, so that the cost still approximates the same integral.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner import cases
from planner.base.errors import PlannerError
from planner.cases import problem_file
from planner.dynamics import FunctionDynamics, HopperDynamics, RigidBodyDynamics
from planner.model.space import space_of
from planner.problem.costs.penalty import PenaltyCost
from planner.problem.costs.tracking import Cost, SumCost, TrackingCost
from planner.problem.objective import plain, with_objective
from planner.problem.problem import Problem

MOST_STAGES = 100_000
FINEST = "rk4"
FIRST_ORDER = ("euler", "semi-implicit-euler")


def finer(problem: Problem) -> Problem:
    """A problem with the next finer discretisation.

    A case of planner.cases and a problem file are made anew from their parameters, so that plans of them can be
    stored. Other problems are taken apart, and their first guess is held over the parts of each stage.

    Args:
        problem: Of RigidBodyDynamics, HopperDynamics or FunctionDynamics; for half a stage with a TrackingCost, or a
            sum of such and PenaltyCosts.

    Raises:
        PlannerError: Parts that cannot be made anew, or more than 100 000 stages.
    """
    if problem.objective is not None:
        return with_objective(finer(plain(problem)), problem.objective.weights)
    first_order = getattr(problem.dynamics, "integrator", None) in FIRST_ORDER
    parts = 1 if first_order else 2
    if parts * problem.N > MOST_STAGES:
        raise PlannerError(f"half the stage makes {parts * problem.N} stages, expected at most {MOST_STAGES}.")
    if is_its_case(problem):
        return _case(problem, parts, FINEST)
    return replace(
        problem, dynamics=_dynamics(problem.dynamics, parts), horizon=parts * problem.N,
        us=np.repeat(problem.first_guess, parts, axis=0), cost=problem.cost if parts == 1 else halved(problem.cost),
        case=None, parameters={}, limits=None if problem.limits is None else problem.limits.repeated(parts),
    )  # fmt: skip


def _case(problem: Problem, parts: int, integrator: str) -> Problem:
    """A case or a problem file from its parameters, with stages divided into parts."""
    assert problem.case is not None
    table = problem.parameters | {"integrator": integrator}
    if problem.case == problem_file.CASE:
        made = problem_file.rebuilt(table | {"dt": problem.dynamics.dt / parts}, problem.twin)
    else:
        made = cases.build(problem.case, **table | {"horizon": parts * problem.N})
    return replace(plain(made), limits=None if problem.limits is None else problem.limits.repeated(parts))


def is_its_case(problem: Problem) -> bool:
    """Whether a problem is still what its parameters say: dataclasses.replace may have changed its parts."""
    if problem.case not in (*cases.CASES, problem_file.CASE) or "integrator" not in problem.parameters:
        return False
    try:
        stored = _case(problem, 1, problem.parameters["integrator"])
    except PlannerError:
        return False
    return stored.parameters == problem.parameters and same_numbers(problem, stored)


def same_numbers(problem: Problem, stored: Problem) -> bool:
    """Whether two problems have the same start, dynamics and cost, as far as random motions tell."""
    if (problem.N, problem.dynamics.nx, problem.dynamics.nu) != (stored.N, stored.dynamics.nx, stored.dynamics.nu):
        return False
    rng, space = np.random.default_rng(0), space_of(problem.dynamics)
    xs = space.integrate(np.tile(problem.x0, (problem.N + 1, 1)), rng.normal(size=(problem.N + 1, space.ndx)))
    us = rng.normal(size=problem.first_guess.shape)
    mine, theirs = (
        (p.x0, p.dynamics.step(xs[:-1], us), p.cost.value(xs, us), p.dynamics.dt) for p in (problem, stored)
    )
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(mine, theirs, strict=True))


def _dynamics(dynamics: Any, parts: int) -> Any:
    """The same rates, integrated by RK4 over stages divided into parts."""
    dt = dynamics.dt / parts
    kind = type(dynamics)  # a subclass may take other arguments
    if kind is RigidBodyDynamics:
        return RigidBodyDynamics(dynamics.mechanism, dt, FINEST, dynamics.prescribed)
    if kind is HopperDynamics:
        d = dynamics
        return HopperDynamics(dt, FINEST, stiffness=d.stiffness, smoothing=d.smoothing, gravity=d.gravity)
    if kind is FunctionDynamics and dynamics.integrator != "discrete":
        return FunctionDynamics(dynamics._f, dynamics.nx, dynamics.nu, dt, FINEST, dynamics._jacobian)
    what = "a discrete map" if kind is FunctionDynamics else f"of the type {kind.__name__}"
    raise PlannerError(
        f"the dynamics are {what}, expected RigidBodyDynamics, HopperDynamics or rates in FunctionDynamics: "
        "nothing else can be given a shorter stage."
    )


def halved(cost: Cost) -> Cost:
    """A cost over twice as many stages of half the length.

    Raises:
        PlannerError: It is neither a TrackingCost nor a PenaltyCost nor a sum of such.
    """
    if type(cost) is SumCost:
        return SumCost(*(halved(term) for term in cost.costs))
    if type(cost) is PenaltyCost:
        return cost.spaced(0.5, parts=2)
    if type(cost) is TrackingCost:
        Q = np.concatenate([np.repeat(0.5 * cost.Q[:-1], 2, axis=0), cost.Q[-1:]])
        x_ref = np.concatenate([np.repeat(cost.x_ref[:-1], 2, axis=0), cost.x_ref[-1:]])
        return TrackingCost(Q, np.repeat(0.5 * cost.R, 2, axis=0), x_ref, np.repeat(cost.u_ref, 2, axis=0), cost.space)
    raise PlannerError(
        f"the cost is of the type {type(cost).__name__}, expected a TrackingCost, a PenaltyCost or a sum of "
        "such: the weights of nothing else can be halved."
    )
