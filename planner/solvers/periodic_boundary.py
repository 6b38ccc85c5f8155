"""Newton's method for the boundary states of a periodic trajectory: start x(0) and terminal reference r.

The optimal periodic trajectory, minimize L(x, U) subject to x(N) = x(0) over x(0) and U, has

    x(N) = x(0),     costate(0) = nu,        nu the multiplier of x(N) = x(0)

(of a gait x(N) = image of x(0) and costate(0) = S' nu, S the derivative of the image, else S = I) and the zero gradient
of Eq. 20. A solve from a start x0 with the final cost 1/2 |x(N) - r|^2_W has a zero gradient and nu = W (x(N) - r).
This leaves two equations for two unknowns, x0 and r, and the LQ problem (Eq. 31-35) at the solution gives their
derivatives, with Phi_n = product of A + B K from n + 1 to N, Phi that from 0, H = R + B'PB:

    du(n)        = K dx(n) + F_n dr,         F_n = H^-1 (Phi_n B)' W
    d x(N)       = Phi dx0 + G W dr,         G = sum over n of Phi_n B H^-1 B' Phi_n'
    d costate(0) = P(0) dx0 - Phi' W dr

So the LQ problem's periodic trajectories satisfy (Phi - S) dx0 + G W dr = x(0) - x(N), on which L is a convex quadratic
in (dx0, dr). A step is the minimum-norm solution, which is well conditioned and small, plus Newton's step for L in the
null space, which may be large, since L depends weakly on some directions of the start. It is damped by mu until a
rollout lowers the merit, L + penalty |x(0) - x(N)| (N&W 18.3). Components that need not be periodic keep their start
and reference.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.protocol import rollout_states
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


SUFFICIENT = 0.1
"""Lower limit of the actual over the predicted reduction of the merit of an accepted step."""
CLOSED = 0.5
"""The same of the closure error, for a step that only closes it."""
_DAMPINGS = (0.0, *(10.0 ** (0.5 * np.arange(-4, 9))).tolist())  # mu, relative to the final weight
STEPS = (*((mu, 1.0) for mu in _DAMPINGS), *((np.inf, 0.5**k) for k in range(8)))
"""Damping, and fraction of the closure error that is closed, of the steps that are tried one after another."""
ONLY_CLOSING = len(_DAMPINGS)  # the first step that only closes
MERIT_FACTOR = 2.0  # of the largest multiplier: the weight of the closure error in the merit
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
    S: np.ndarray  # (ndx, ndx) derivative of where the start returns to by the start
    gap: np.ndarray  # (ndx,) closure error x(N) - x(0), zero for components that need not be periodic
    costate: np.ndarray  # (ndx,) at the start
    error: np.ndarray  # (ndx,) x(N) - r
    nu: np.ndarray  # (ndx,) W (x(N) - r)
    P: np.ndarray  # (ndx, ndx) Hessian of the cost-to-go at the start
    Phi: np.ndarray  # (ndx, ndx) d x(N) / d x(0) of the closed loop
    G: np.ndarray  # (ndx, ndx) sum over n of Phi_n B H^-1 B' Phi_n'
    K: np.ndarray  # (N, nu, ndx) d u / d x
    F: np.ndarray  # (N, nu, ndx) d u / d r

    def step(self, mu: float, part: float = 1.0) -> BoundaryStep:
        """The step damped by mu, inf for none in the null space, that closes a fraction `part` of the closure error."""
        c, m, I = self.closes, len(self.closes), np.eye(len(self.W))
        scale = self._scale  # scales steps to sqrt(unit of J)
        both = np.r_[c, len(I) + c]
        shrink = np.tile(1.0 / scale, 2)
        closing = (scale[:, None] * np.hstack([self.Phi - self.S, self.G @ self.W])[np.ix_(c, both)]) * shrink
        H, g = self._running()
        H, g = np.outer(shrink, shrink) * H[np.ix_(both, both)], shrink * g[both]
        U, s, Vt = np.linalg.svd(closing)
        if s[-1] < _SINGULAR * s[0]:
            raise PlannerError("no change of start and goal closes the gap, expected what must come back to be driven.")
        least = -Vt[:m].T @ ((U.T @ (part * scale * self.gap[c])) / s)
        Z = Vt[m:].T
        pull, along = Z.T @ (g + H @ least), Z.T @ H @ Z
        w = np.zeros(m)
        if np.isfinite(mu):
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

    def penalty(self, step: BoundaryStep, part: float) -> float:
        """A weight of the closure error, each component scaled by its final weight.

        It is above the multipliers, and such that a step that closes a fraction `part` of it is to lower the merit (N&W
        18.36).
        """
        multipliers = MERIT_FACTOR * float(np.max(np.abs(self.nu[self.closes]) / self._scale, initial=0.0))
        rise, closed = self._predicted_running_cost(step) - self.merit(0.0), part * self.size(self.gap)
        return max(multipliers, MERIT_FACTOR * rise / closed if closed > 0.0 else 0.0)

    def merit(self, penalty: float) -> float:
        """The cost without the terminal goal term and the weighed closure error (N&W 18.3, exact penalty)."""
        cost = self.plan.cost - terminal_goal_cost(self.plan)
        return cost + penalty * self.size(self.gap)

    def predicted_merit(self, step: BoundaryStep, part: float, penalty: float) -> float:
        """The merit of the LQ problem after a step that closes a fraction `part` of the closure error."""
        return self._predicted_running_cost(step) + penalty * (1.0 - part) * self.size(self.gap)

    def _predicted_running_cost(self, step: BoundaryStep) -> float:
        """The cost of the LQ problem after a step, without the terminal goal term."""
        to_goal = self.error + self.Phi @ step.dx + self.G @ self.W @ step.dr - step.dr
        return self.predicted_cost(step.dx, step.dr) - 0.5 * float(to_goal @ self.W @ to_goal)

    def size(self, gap: np.ndarray) -> float:
        """The sum of a closure error's (ndx,) components, each scaled by its final weight."""
        return float(self._scale @ np.abs(gap[self.closes]))

    @property
    def _scale(self) -> np.ndarray:
        """(m,) sqrt of the final weights of the periodic components."""
        return np.sqrt(np.diag(self.W)[self.closes])

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

    A problem whose recipe has the parameter PARAMETER keeps its recipe, with these ends, so that plans can be stored.
    """
    old = base_problem(problem)
    cost, recipe = tracking(old), old.recipe
    if recipe is not None and PARAMETER in recipe.parameters:
        recipe = recipe.changed(**{PARAMETER: [end.tolist() for end in ends]})
    terms = getattr(old.cost, "costs", (old.cost,))
    whole = [cost.with_goal(ends.goal) if term is cost else term for term in terms]
    new = replace(old, cost=whole[0] if len(whole) == 1 else SumCost(*whole), x0=ends.start, us=us, recipe=recipe)
    return new if problem.objective is None else with_objective(new, problem.objective.stored)


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
    error = space.difference(plan.xs[-1], tracking(problem).x_ref[-1])
    gap, costate = periodic.closure_error(space, plan.xs), lq.costates(A, model)[0]
    return BoundarySensitivity(
        plan, closes, W, periodic.matrix, gap, costate, error, W @ error, sweep.P[0], Phi, G, sweep.K, F
    )


def _free(problem: Problem, plan: Plan, B: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """B (N, ndx, nu) with zero columns for controls at active bounds."""
    if problem.bounds is None:
        return B
    at_bound = lq.projected(gradient, problem.bounds.step_bounds(plan.xs, plan.us)) != gradient
    return np.where(at_bound[:, None, :], 0.0, B)


class BoundaryTrial(NamedTuple):
    """A step of the boundary states whose rollout lowers the merit."""

    problem: Problem  # With the rollout's controls as first guess
    number: int  # Of STEPS
    penalty: float  # Of the merit
    decrease: float  # Expected reduction of L by the null-space part


def improved_boundary(found: BoundarySensitivity, first: int = 0) -> BoundaryTrial | None:
    """The first of STEPS whose rollout lowers the merit by SUFFICIENT of what the LQ problem predicts, or None.

    Of steps that only close the closure error also one that closes CLOSED of what it is to (a filter, N&W 15.4): of
    unresolved motions, costs of nearby rollouts are no guide.

    Args:
        found: The sensitivity at the last plan.
        first: The first of STEPS that is tried, from ONLY_CLOSING on only to close the closure error.
    """
    plan = found.plan
    problem, periodic = periodic_problem(plan)
    space, ends = space_of(problem.dynamics), ends_of(problem)
    for k in range(first, len(STEPS)):
        step, part = found.step(*STEPS[k]), STEPS[k][1]
        penalty = found.penalty(step, part)
        now = found.merit(penalty)
        there = BoundaryStates(space.integrate(ends.start, step.dx), space.integrate(ends.goal, step.dr))
        try:
            new = with_ends(problem, there, plan.us)
        except PlannerError:  # a start out of its range
            continue
        cost, us = feedback_rollout(new, plan.us + found.F @ step.dr, found.K, plan.xs)
        if not np.isfinite(cost):
            continue
        xs = rollout_states(new.dynamics, new.x0, us)
        size = found.size(periodic.closure_error(space, xs))
        merit = cost - tracking(new).final_cost(xs[-1]) + penalty * size
        enough = merit <= now + SUFFICIENT * min(found.predicted_merit(step, part, penalty) - now, 0.0)
        if enough or (k >= ONLY_CLOSING and size <= (1.0 - CLOSED * part) * found.size(found.gap)):
            return BoundaryTrial(replace(new, us=us), k, penalty, step.decrease)
    return None


def terminal_goal_cost(plan: Plan) -> float:
    """The terminal goal term of the plan's cost."""
    return tracking(periodic_problem(plan)[0]).final_cost(plan.xs[-1])
