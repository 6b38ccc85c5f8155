"""The ends of a periodic motion: how a solved motion answers to its start and to the goal at its end, and both changed.

The motion of least cost that comes back, minimize L(x, U) subject to x(N) = x(0) over x(0) and U, has

    x(N) = x(0),     costate(0) = nu,        nu the multiplier of x(N) = x(0)

beside the gradient zero of Eq. 20. A solve from a start x0 with the final cost 1/2 |x(N) - r|^2_W has a zero gradient
and nu = W (x(N) - r). So two unknowns, x0 and r, are left for two equations, and the LQ problem (Eq. 31-35) at its end
tells how they answer, with Phi the product of the closed loop's A + B K and H = R + B'PB:

    d x(N)       = Phi dx0 + G W dr,         G = sum over n of Phi_n B H^-1 B' Phi_n',  Phi_n from n + 1 to N
    d costate(0) = P(0) dx0 - Phi' W dr

This is Newton's method with the Hessian of Gauss and Newton. What need not come back keeps its start and its goal.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner import cases, lq
from planner.closing import Periodic
from planner.cost import SumCost, TrackingCost, tracking_of
from planner.errors import PlannerError
from planner.finer import same_numbers
from planner.objective import plain, with_objective
from planner.plan import Plan
from planner.problem import Problem
from planner.space import space_of

PARAMETER = "ends"
"""Of a case that can be made with other ends: its start and its goal, (2, nx) as lists; None for its own."""


class Ends(NamedTuple):
    """Where a motion starts, and what its final cost draws it to: states (nx,)."""

    start: np.ndarray
    goal: np.ndarray


class Mismatch(NamedTuple):
    """What is left of the two equations over the m components that must come back, and how it answers to the ends.

    Attributes:
        values: (2m,) x(N) - x(0) and costate(0) - nu, in units that make both sqrt(J).
        jacobian: (2m, 2m) their derivatives by the start and the goal, in the same units.
        scale: (m,) of a component of the deviation: the root of its final weight.
    """

    values: np.ndarray
    jacobian: np.ndarray
    scale: np.ndarray

    @property
    def size(self) -> float:
        """Their norm; its square is of the size of what is left to gain of J."""
        return float(np.linalg.norm(self.values))


def tracking(problem: Problem) -> TrackingCost:
    """The cost whose last reference is the goal.

    Raises:
        PlannerError: There is none, or more than one.
    """
    found = tracking_of(plain(problem).cost)
    if found is None:
        raise PlannerError("the cost has no one TrackingCost with a final weight, which a periodic motion needs.")
    return found


def periodic_problem(plan: Plan) -> tuple[Problem, Periodic]:
    """The problem of a plan of a periodic motion, and what must come back."""
    assert plan.problem is not None  # solve gave the plan
    assert plan.problem.periodic is not None  # solve_periodic asked for it
    return plan.problem, plan.problem.periodic


def ends_of(problem: Problem) -> Ends:
    """The start and the goal of a problem."""
    return Ends(problem.x0, tracking(problem).x_ref[-1])


def with_ends(problem: Problem, ends: Ends, us: np.ndarray) -> Problem:
    """The problem with another start and goal, and first controls us (N, nu).

    A case that has a parameter for them is made anew from its parameters, so that plans of it can be stored.
    """
    old = plain(problem)
    table = old.parameters | {PARAMETER: [end.tolist() for end in ends]}
    if old.case in cases.CASES and PARAMETER in old.parameters and same_numbers(old, _case(old, old.parameters)):
        new = replace(_case(old, table), limits=old.limits, us=us)
    else:
        cost = tracking(old)
        moved = TrackingCost(cost.Q, cost.R, np.concatenate([cost.x_ref[:-1], [ends.goal]]), cost.u_ref, cost.space)
        terms = [moved if term is cost else term for term in getattr(old.cost, "costs", (old.cost,))]
        whole = moved if old.cost is cost else SumCost(*terms)
        new = replace(old, cost=whole, x0=ends.start, us=us, case=None, parameters={})
    return new if problem.objective is None else with_objective(new, problem.objective.weights)


def _case(problem: Problem, parameters: dict) -> Problem:
    assert problem.case is not None  # with_ends has looked
    return cases.build(problem.case, **parameters)


def mismatch(plan: Plan) -> Mismatch:
    """Of a solved problem with `periodic`.

    Raises:
        PlannerError: What must come back has no final weight.
    """
    problem, periodic = periodic_problem(plan)
    c = np.flatnonzero(periodic.closes)
    W = tracking(problem).Q[-1]
    if np.linalg.eigvalsh(W[np.ix_(c, c)]).min() <= 0.0:
        raise PlannerError("what must come back has no final weight in the cost, expected one above 0 on all of it.")
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    model = problem.cost.quadratize(plan.xs, plan.us)
    B = _free(problem, plan, A, B, lq.gradient(A, B, model))
    sweep = lq.riccati(A, B, model)
    if sweep is None:
        raise PlannerError("the LQ problem at the plan is not definite, expected a problem that solve() solves.")
    ndx = B.shape[1]
    Phi, G = np.eye(ndx), np.zeros((ndx, ndx))
    for n in reversed(range(len(A))):
        H = model.R[n] + B[n].T @ sweep.P[n + 1] @ B[n]
        reach = Phi @ B[n]
        G += reach @ np.linalg.solve(H, reach.T)
        Phi = Phi @ (A[n] + B[n] @ sweep.K[n])
    space = space_of(problem.dynamics)
    nu = W @ space.difference(plan.xs[-1], tracking(problem).x_ref[-1])
    costate = lq.costates(A, model)[0]
    WPhi = W @ Phi
    blocks = [[Phi - np.eye(ndx), G @ W], [sweep.P[0] - WPhi, W - WPhi.T - W @ G @ W]]
    scale = np.sqrt(np.diag(W)[c])
    rows, columns = np.r_[scale, 1.0 / scale], np.r_[1.0 / scale, 1.0 / scale]
    jacobian = rows[:, None] * np.block([[block[np.ix_(c, c)] for block in line] for line in blocks]) * columns
    gap = periodic.gap(space, plan.xs)[c]
    return Mismatch(rows * np.r_[gap, (costate - nu)[c]], jacobian, scale)


def _free(problem: Problem, plan: Plan, A: np.ndarray, B: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """B without the controls that their bounds hold."""
    if problem.bounds is None:
        return B
    lower, upper = problem.bounds
    held = lq.projected(gradient, (lower - plan.us, upper - plan.us)) != gradient
    return np.where(held[:, None, :], 0.0, B)


def newton(plan: Plan, left: Mismatch, part: float = 1.0) -> Ends:
    """The ends with which nothing would be left, were the problem quadratic.

    Args:
        plan: Of a problem with `periodic`.
        left: Its mismatch.
        part: Of the step to take.
    """
    problem, periodic = periodic_problem(plan)
    m = len(left.scale)
    step = -part * np.linalg.lstsq(left.jacobian, left.values, rcond=1e-12)[0]
    space, ends = space_of(problem.dynamics), ends_of(problem)
    moved = []
    for end, part in zip(ends, (step[:m], step[m:]), strict=True):
        dx = np.zeros(space.ndx)
        dx[periodic.closes] = part / left.scale
        moved.append(space.integrate(end, dx))
    return Ends(*moved)
