"""Newton's method for the boundary states of a periodic trajectory: start x(0) and terminal reference r.

The optimal periodic trajectory, minimize L(x, U) subject to x(N) = x(0) over x(0) and U, has

    x(N) = x(0),     costate(0) = nu,        nu the multiplier of x(N) = x(0)

and the zero gradient of Eq. 20. A solve from a start x0 with the final cost 1/2 |x(N) - r|^2_W has a zero gradient and
nu = W (x(N) - r). This leaves two equations for two unknowns, x0 and r, and the LQ problem (Eq. 31-35) at the solution
gives their derivatives, with Phi_n = product of A + B K from n + 1 to N, Phi that from 0, H = R + B'PB:

    du(n)        = K dx(n) + F_n dr,         F_n = H^-1 (Phi_n B)' W
    d x(N)       = Phi dx0 + G W dr,         G = sum over n of Phi_n B H^-1 B' Phi_n'
    d costate(0) = P(0) dx0 - Phi' W dr

So the LQ problem's periodic trajectories satisfy (Phi - I) dx0 + G W dr = x(0) - x(N), on which L is a convex
quadratic in (dx0, dr). A step is the minimum-norm solution, which is well conditioned and small, plus Newton's step for
L in the null space, damped by mu until the actual cost agrees with the expected one: this part may be large, since L
depends weakly on some directions of the start. Components that need not be periodic keep their start and reference.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.model.space import space_of
from planner.problem.costs.terms import SumCost
from planner.problem.costs.tracking import TrackingCost, tracking_of
from planner.problem.objective import base_problem, with_objective
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.problem_parts import Periodic
from planner.solvers import lq
from planner.solvers.gains import feedback_rollout

PARAMETER = "ends"
"""Parameter of a built-in problem: start and terminal reference (2, nx), as lists; None for its own."""


TRUST = 0.3
"""Upper limit of |actual - predicted cost| / L of an accepted step."""
_DAMPINGS = (0.0, *(10.0 ** (0.5 * np.arange(-4, 9))))  # mu, relative to the final weight
_PARTS = (0.5, 0.25, 0.125, 0.0625)  # fractions of the closure error to close if the full step is rejected
_SINGULAR = 1e-10  # smallest singular value, relative to the largest


class BoundaryStates(NamedTuple):
    """Start and terminal reference r of a trajectory: states (nx,)."""

    start: np.ndarray
    goal: np.ndarray


class BoundaryStep(NamedTuple):
    """Changes (ndx,) of start and reference, and the expected reduction of L by the null-space part."""

    dx: np.ndarray
    dr: np.ndarray
    decrease: float


class BoundarySensitivity(NamedTuple):
    """Residuals of the two equations at a plan, and their derivatives by its boundary states; see the module."""

    plan: Plan  # Solved, of a problem with `periodic`
    closes: np.ndarray  # (m,) indices of the periodic components
    W: np.ndarray  # (ndx, ndx) final weight of the TrackingCost
    gap: np.ndarray  # (ndx,) closure error x(N) - x(0), zero for components that need not be periodic
    costate: np.ndarray  # (ndx,) at the start
    nu: np.ndarray  # (ndx,) W (x(N) - r)
    P: np.ndarray  # (ndx, ndx) Hessian of the cost-to-go at the start
    Phi: np.ndarray  # (ndx, ndx) d x(N) / d x(0) of the closed loop
    G: np.ndarray  # (ndx, ndx) sum over n of Phi_n B H^-1 B' Phi_n'
    K: np.ndarray  # (N, nu, ndx) d u / d x
    F: np.ndarray  # (N, nu, ndx) d u / d r

    def step(self, mu: float, part: float = 1.0) -> BoundaryStep:
        """The step damped by mu, which closes a fraction `part` of the closure error."""
        c, m, I = self.closes, len(self.closes), np.eye(len(self.W))
        scale = np.sqrt(np.diag(self.W)[c])  # scales steps to sqrt(unit of J)
        both = np.r_[c, len(I) + c]
        shrink = np.tile(1.0 / scale, 2)
        closing = (scale[:, None] * np.hstack([self.Phi - I, self.G @ self.W])[np.ix_(c, both)]) * shrink
        H, g = self._running()
        H, g = np.outer(shrink, shrink) * H[np.ix_(both, both)], shrink * g[both]
        U, s, Vt = np.linalg.svd(closing)
        if s[-1] < _SINGULAR * s[0]:
            raise PlannerError("no change of start and goal closes the gap, expected what must come back to be driven.")
        least = -Vt[:m].T @ ((U.T @ (part * scale * self.gap[c])) / s)
        Z = Vt[m:].T
        pull, along = Z.T @ (g + H @ least), Z.T @ H @ Z
        w = -np.linalg.lstsq(along + mu * np.eye(m), pull, rcond=_SINGULAR)[0]
        change = np.zeros(2 * len(I))
        change[both] = shrink * (least + Z @ w)
        return BoundaryStep(change[: len(I)], change[len(I) :], float(-(pull @ w) - 0.5 * w @ along @ w))

    def _running(self) -> tuple[np.ndarray, np.ndarray]:
        """Hessian (2 ndx, 2 ndx) and gradient of L by (dx0, dr): the LQ problem's J without the terminal goal term."""
        WPhi, W = self.W @ self.Phi, self.W
        to_goal = np.hstack([self.Phi, self.G @ W - np.eye(len(W))])  # x(N) - r
        H = np.block([[self.P, -WPhi.T], [-WPhi, W - W @ self.G @ W]]) - to_goal.T @ W @ to_goal
        return H, np.concatenate([self.costate, -self.nu]) - to_goal.T @ self.nu

    def predicted_cost(self, dx: np.ndarray, dr: np.ndarray) -> float:
        """J of the LQ problem at changes dx, dr (ndx,) of start and reference."""
        Wdr = self.W @ dr
        slope = self.costate @ dx - self.nu @ dr
        return float(
            self.plan.cost + slope + 0.5 * (dx @ self.P @ dx + dr @ Wdr - Wdr @ self.G @ Wdr) - (self.Phi @ dx) @ Wdr
        )


def tracking(problem: Problem) -> TrackingCost:
    """The TrackingCost, whose last reference is r.

    Raises:
        PlannerError: There is none, or more than one.
    """
    goal_cost = tracking_of(base_problem(problem).cost)
    if goal_cost is None:
        raise PlannerError("the cost has no one TrackingCost with a final weight, which a periodic motion needs.")
    return goal_cost


def periodic_problem(plan: Plan) -> tuple[Problem, Periodic]:
    """The problem of a plan, and its Periodic."""
    assert plan.problem is not None  # solve gave the plan
    assert plan.problem.periodic is not None  # checked by solve_periodic
    return plan.problem, plan.problem.periodic


def ends_of(problem: Problem) -> BoundaryStates:
    """The start and the terminal reference of a problem."""
    return BoundaryStates(problem.x0, tracking(problem).x_ref[-1])


def with_ends(problem: Problem, ends: BoundaryStates, us: np.ndarray) -> Problem:
    """The problem with another start and terminal reference, and first controls us (N, nu).

    A built-in problem with the parameter PARAMETER is rebuilt from its recipe, so that its plans can be stored.
    """
    old = base_problem(problem)
    if old.recipe is not None and PARAMETER in old.recipe.parameters:
        built = old.recipe.rebuilt(**{PARAMETER: [end.tolist() for end in ends]})
        new = replace(built, limits=old.limits, us=us)
    else:
        cost = tracking(old)
        terms = getattr(old.cost, "costs", (old.cost,))
        whole = [cost.with_goal(ends.goal) if term is cost else term for term in terms]
        new = replace(old, cost=whole[0] if len(whole) == 1 else SumCost(*whole), x0=ends.start, us=us)
    return new if problem.objective is None else with_objective(new, problem.objective.weights)


def response(plan: Plan) -> BoundarySensitivity:
    """The BoundarySensitivity of a plan of a problem with `periodic`.

    Raises:
        PlannerError: The final weight is not positive definite on the periodic components, or the LQ problem is not.
    """
    problem, periodic = periodic_problem(plan)
    closes = np.flatnonzero(periodic.periodic_mask)
    W = tracking(problem).Q[-1]
    if np.linalg.eigvalsh(W[np.ix_(closes, closes)]).min() <= 0.0:
        raise PlannerError("what must come back has no final weight in the cost, expected one above 0 on all of it.")
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    model = problem.penalized_quadratic(plan.bound_penalties, plan.xs, plan.us, A, B)
    B = _free(problem, plan, B, lq.gradient(A, B, model))
    sweep = lq.riccati(A, B, model)
    if sweep is None:
        raise PlannerError("the LQ problem at the plan is not definite, expected a problem that solve() solves.")
    N, ndx, nu = B.shape
    Phi, G, F = np.eye(ndx), np.zeros((ndx, ndx)), np.empty((N, nu, ndx))
    for n in reversed(range(N)):
        reach = Phi @ B[n]
        answer = np.linalg.solve(model.R[n] + B[n].T @ sweep.P[n + 1] @ B[n], reach.T)
        F[n] = answer @ W
        G += reach @ answer
        Phi = Phi @ (A[n] + B[n] @ sweep.K[n])
    space = space_of(problem.dynamics)
    terminal_error = W @ space.difference(plan.xs[-1], tracking(problem).x_ref[-1])
    gap, costate = periodic.closure_error(space, plan.xs), lq.costates(A, model)[0]
    return BoundarySensitivity(plan, closes, W, gap, costate, terminal_error, sweep.P[0], Phi, G, sweep.K, F)


def _free(problem: Problem, plan: Plan, B: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """B (N, ndx, nu) with zero columns for controls at active bounds."""
    if problem.bounds is None:
        return B
    at_bound = lq.projected(gradient, problem.bounds.step_bounds(plan.xs, plan.us)) != gradient
    return np.where(at_bound[:, None, :], 0.0, B)


def improved_boundary(found: BoundarySensitivity, close: bool = False) -> Problem | None:
    """The problem after one step of the boundary states, with the tracking rollout's controls as first guess.

    The first step, by increasing damping, whose rollout cost agrees with the predicted one within TRUST; None if there
    is none.

    Args:
        found: The sensitivity at the last plan.
        close: Whether only to close the closure error, by maximum damping.
    """
    plan = found.plan
    problem, _ = periodic_problem(plan)
    space, ends = space_of(problem.dynamics), ends_of(problem)
    for mu, part in (
        *((mu, 1.0) for mu in (_DAMPINGS[-1:] if close else _DAMPINGS)),
        *((_DAMPINGS[-1], part) for part in _PARTS),
    ):
        step = found.step(mu, part)
        there = BoundaryStates(space.integrate(ends.start, step.dx), space.integrate(ends.goal, step.dr))
        new = with_ends(problem, there, plan.us)
        cost, us = feedback_rollout(new, plan.us + found.F @ step.dr, found.K, plan.xs)
        if abs(cost - found.predicted_cost(step.dx, step.dr)) <= TRUST * (plan.cost - terminal_goal_cost(plan)):
            return replace(new, us=us)
    return None


def terminal_goal_cost(plan: Plan) -> float:
    """The terminal goal term of the plan's cost."""
    return tracking(periodic_problem(plan)[0]).final_cost(plan.xs[-1])
