"""Whether a plan whose gradient vanishes is a minimum: derivatives that fit, curvature, and contacts never touched.

Own derivatives. A cost or dynamics of the user's own Python may have derivatives that are not those of its values. They
are compared with central differences along the last direction of SLQ and along seeded random ones. Where differences at
two lengths disagree, the function is not smooth there and says nothing.

Curvature. A stationary point may be a maximum or a saddle. With v(n) in u = us + v + K (x - xs), the gains of the last
sweep and H(n) = R + B'PB, the LQ problem's cost is 1/2 sum of v'H v, so in w = L' v with H = L L' its Hessian is the
identity, and the sign of the true Hessian's lowest eigenvalue is that in U (Sylvester's law of inertia). Lanczos'
method finds it from differences of the adjoint gradient (Nocedal & Wright, section 5.1 and 7.1), without controls that
an active bound holds. It counts only where the cost falls along its eigenvector. Constraints have their penalties: an
augmented Lagrangian has a minimum where the problem has one if these are stiff enough (N&W theorem 17.5), and those of
the last round need not be. So a negative curvature has to last with STIFFER ones of the same multipliers.

Contacts. The gradient by the controls is zero where they touch nothing: then a goal of the untouched body is no goal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.measured import Measurement
from planner.dynamics.function import FunctionDynamics
from planner.model.coordinates import coordinates_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.derivative_check import AGREES, DERIVATIVE_BOUND
from planner.problem.goals import goals_of, terms_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.error_scales import has_contacts, is_nonsmooth
from planner.solvers import lq

DIFFERENCE = 1e-4  # step of central differences, relative to the trajectory
SEEDS = 2  # random directions of the states, and of the controls
CURVATURE_BOUND = 0.01  # of the LQ problem's curvature: lower ones are rounding, or a valley
LANCZOS_STEPS = 8  # the spectrum is 1 but for a few eigenvalues: the lowest is found by then
STEPS = (1e-3, 1e-4, 1e-5, 1e-6)  # of a difference of gradients, as shares of the root of the cost
SMOOTH = 0.1  # relative: gradients' differences at a length and a quarter of it are further apart if not smooth
STIFFER = (10.0, 100.0)  # times the weights of the last round's penalties
FALLS = (1e-6, 1e-4, 1e-2, 0.1)  # of the cost, by which its curvature lets it fall at a length that is tried
UNREACHED = 1e-6  # of what the cost wants of a coordinate: all that the controls move it to first order
WANTED = 0.01  # of the cost: what moving a coordinate would gain

NOT_SMOOTH = "the motion is not smooth: curvature not checked"

Field = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (xs, us) -> values that are to be differenced


def stationarity(plan: Plan, problem: Problem, sweep: lq.Sweep, scale: float) -> list[Measurement]:
    """What a vanishing gradient does not show, of a plan with the sweep at its trajectory and the scale of its cost."""
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    measured = list(_derivatives(plan, problem, sweep, A, B))
    if has_contacts(plan):
        measured.append(_unreached(plan, problem, A, B, scale))
    if is_nonsmooth(plan):
        return [*measured, Measurement("negative_curvature", np.nan, "", None, NOT_SMOOTH)]
    return [*measured, _ReducedHessian(plan, problem, sweep, A, B, scale).measured()]


def _own_cost(problem: Problem) -> bool:
    return any(not type(term).__module__.startswith("planner.") for term in terms_of(problem.cost))


def _own_jacobian(problem: Problem) -> bool:
    dynamics = problem.dynamics
    if isinstance(dynamics, FunctionDynamics):
        return dynamics.has_own_jacobian
    return not type(dynamics).__module__.startswith("planner.")


def _derivatives(plan: Plan, problem: Problem, sweep: lq.Sweep, A: np.ndarray, B: np.ndarray) -> Iterator[Measurement]:
    """Errors of the derivatives that are the user's own, relative, the largest of several directions."""
    cost, dynamics, space = problem.cost, problem.dynamics, plan.space
    if not (_own_cost(problem) or _own_jacobian(problem)):
        return
    directions = list(_directions(plan, problem, sweep, A, B))
    if _own_cost(problem):
        model = cost.quadratize(plan.xs, plan.us)
        parts = [np.concatenate([(model.q * dx).ravel(), (model.r * du).ravel()]) for dx, du in directions]
        slopes = [(part.sum(), float(np.linalg.norm(part))) for part in parts]
        found = _largest_error(plan, lambda xs, us: np.array(cost.value(xs, us)), directions, slopes)
        note = "value() differenced against q and r of quadratize(), along the last and random directions, relative"
        yield Measurement("cost_derivative_error", found, "", DERIVATIVE_BOUND, note)
    if _own_jacobian(problem):
        slopes = []
        for dx, du in directions:
            by_x, by_u = np.einsum("nij,nj->ni", A, dx[:-1]), np.einsum("nij,nj->ni", B, du)
            slopes.append((by_x + by_u, np.sqrt(np.sum(by_x**2) + np.sum(by_u**2))))

        def ends(xs: np.ndarray, us: np.ndarray) -> np.ndarray:
            return space.difference(dynamics.step(xs[:-1], us), plan.xs[1:])

        found = _largest_error(plan, ends, directions, slopes)
        note = "step() differenced against A and B of linearize(), along the last and random directions, relative"
        yield Measurement("dynamics_derivative_error", found, "", DERIVATIVE_BOUND, note)


def _directions(
    plan: Plan, problem: Problem, sweep: lq.Sweep, A: np.ndarray, B: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Directions (N+1, ndx), (N, nu) of the size of the trajectory: random ones and the last of SLQ."""
    rng, none = np.random.default_rng(0), (np.zeros((plan.N + 1, plan.space.ndx)), np.zeros_like(plan.us))
    sizes = np.maximum(np.abs(plan.space.difference(plan.xs, plan.xs[0])).max(axis=0), 1e-2)
    efforts = np.maximum(np.abs(plan.us).max(axis=0), 1e-2)
    for _ in range(SEEDS):
        yield rng.normal(size=none[0].shape) * sizes, none[1]
        yield none[0], rng.normal(size=none[1].shape) * efforts
    moves = None if problem.bounds is None else problem.bounds.step_bounds(plan.xs, plan.us)
    dx, du = lq.direction(A, B, sweep, moves)
    size = max(np.max(np.abs(dx) / sizes), np.max(np.abs(du) / efforts))
    if np.isfinite(size) and size > 0.0:
        yield dx / size, du / size


def _largest_error(plan: Plan, of: Field, directions: list, slopes: list) -> float:
    """The largest error of slopes (value, size) along directions, relative; 0 where `of` is not smooth."""
    largest = 0.0
    for (dx, du), (slope, size) in zip(directions, slopes, strict=True):
        found = []
        for h in (DIFFERENCE, 0.5 * DIFFERENCE):
            ends = [of(plan.space.integrate(plan.xs, s * h * dx), plan.us + s * h * du) for s in (1.0, -1.0)]
            rounding = 1e-13 * max(float(np.abs(end).max(initial=0.0)) for end in ends) / h
            found.append((ends[0] - ends[1]) / (2.0 * h))
        error, apart = (float(np.linalg.norm(one)) for one in (found[1] - slope, found[1] - found[0]))
        if error > rounding and (apart <= AGREES * error or not np.isfinite(error)):
            scale = max(size, float(np.linalg.norm(found[1])), np.finfo(float).tiny)
            largest = max(largest, error / scale if np.isfinite(error) else np.inf)
    return largest


def _unreached(plan: Plan, problem: Problem, A: np.ndarray, B: np.ndarray, scale: float) -> Measurement:
    """The number of coordinates that the cost wants elsewhere and that no control moves, on a machine with contacts."""
    model = problem.cost.quadratize(plan.xs, plan.us)
    efforts = np.maximum(np.abs(plan.us).max(axis=0), 1e-3 * max(1.0, float(np.abs(plan.us).max(initial=0.0))))
    G = np.zeros((plan.space.ndx, plan.space.ndx))  # of the end, by controls of the plan's own size
    for n in range(plan.N):
        G = A[n] @ G @ A[n].T + (B[n] * efforts) @ (B[n] * efforts).T
    q = model.q[-1]
    wanted = np.abs(np.linalg.lstsq(model.Q[-1], q, rcond=1e-12)[0])  # together: weights couple coordinates
    gain = 0.5 * np.abs(q) * wanted
    lost = (
        (gain > WANTED * scale)
        & (wanted > _passing(plan, problem))
        & (np.sqrt(np.maximum(np.diag(G), 0.0)) < UNREACHED * wanted)
    )
    names = [one.name for one, out in zip(coordinates_of(problem.dynamics), lost, strict=True) if out]
    note = f"no control moves {', '.join(names[:3])}: nothing touches it along the plan" if names else "goals untouched"
    return Measurement("unreached_goals", float(len(names)), "", 0.0, note)


def _passing(plan: Plan, problem: Problem) -> np.ndarray:
    """(ndx,) the distance from a goal that passes whatever it is of: the smallest tolerance of its unit, 0 of none."""
    goals, units = goals_of(problem, plan.xs), [one.unit for one in coordinates_of(problem.dynamics)]
    found = {unit: min((one.tolerance for one in goals if one.unit == unit), default=0.0) for unit in set(units)}
    return np.array([found[unit] if np.isfinite(found[unit]) else 0.0 for unit in units])


class _ReducedHessian:
    """The Hessian of the cost by the free controls, in coordinates in which that of the LQ problem is the identity."""

    def __init__(self, plan: Plan, problem: Problem, sweep: lq.Sweep, A: np.ndarray, B: np.ndarray, scale: float):
        self.plan, self.problem, self.sweep = plan, problem, sweep
        self.size, self.B, self.F = float(np.sqrt(scale)), B, A + B @ sweep.K
        bounds = problem.bounds
        held = np.zeros(plan.us.shape, dtype=bool) if bounds is None else bounds.at_bound(plan.xs, plan.us)
        model = problem.penalized_quadratic(plan.bound_penalties, plan.xs, plan.us, A, B)
        H = model.R + np.swapaxes(B, 1, 2) @ sweep.P[1:] @ B
        H = np.where(held[:, :, None] | held[:, None, :], held[:, :, None] * np.eye(plan.us.shape[1]), H)
        self.inverse = np.linalg.inv(np.linalg.cholesky(H))  # L^-1 (N, nu, nu)
        self.free = ~held

    def _by_controls(self, ws: np.ndarray) -> np.ndarray:
        """Changes v (K, N, nu) of the controls beside the gains, of coordinates w (K, N, nu)."""
        return np.einsum("nij,kni->knj", self.inverse, np.where(self.free, ws, 0.0))

    def _moved(self, ws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (K, N+1, nx) and controls (K, N, nu) of coordinates w (K, N, nu)."""
        plan, K = self.plan, len(ws)
        vs = self._by_controls(ws)
        xs, us = np.empty((K, *plan.xs.shape)), np.empty((K, *plan.us.shape))
        xs[:, 0] = plan.xs[0]
        for n in range(plan.N):
            dx = plan.space.difference(xs[:, n], np.broadcast_to(plan.xs[n], xs[:, n].shape))
            us[:, n] = plan.us[n] + vs[:, n] + dx @ self.sweep.K[n].T
            xs[:, n + 1] = self.problem.dynamics.step(xs[:, n], us[:, n])
        return xs, us

    def _gradient(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N, nu) by w, by the adjoint equation of the closed loop (Eq. 16-18 with A + BK)."""
        A, B = self.problem.dynamics.linearize(xs, us)
        model, K = self.problem.penalized_quadratic(self.plan.bound_penalties, xs, us, A, B), self.sweep.K
        F, q = A + B @ K, model.q.copy()
        q[:-1] += np.einsum("nji,nj->ni", K, model.r)
        for n in reversed(range(len(us))):
            q[n] += q[n + 1] @ F[n]  # the costate
        found = model.r + np.einsum("nji,nj->ni", B, q[1:])
        return np.where(self.free, np.einsum("nij,nj->ni", self.inverse, np.where(self.free, found, 0.0)), 0.0)

    def times(self, w: np.ndarray, h: float) -> np.ndarray:
        """The Hessian times w (N, nu), by differences of length h.

        The states are moved by the linearized closed loop: what they lack is of second order, the same both ways.
        """
        plan, v = self.plan, self._by_controls(w[None])[0]
        dx, pushed = np.zeros((plan.N + 1, plan.space.ndx)), np.einsum("nij,nj->ni", self.B, v)
        for n in range(plan.N):
            dx[n + 1] = self.F[n] @ dx[n] + pushed[n]
        du = v + np.einsum("nij,nj->ni", self.sweep.K, dx[:-1])
        ways = [(plan.space.integrate(plan.xs, step * dx), plan.us + step * du) for step in (h, -h)]
        if not all(np.isfinite(xs).all() for xs, _ in ways):
            return np.full_like(w, np.nan)
        return (self._gradient(*ways[0]) - self._gradient(*ways[1])) / (2.0 * h)

    def lowest(self) -> tuple[float, np.ndarray]:
        """The lowest eigenvalue and its vector (N, nu), by Lanczos' method; NaN where the cost is not smooth."""
        w = np.where(self.free, np.random.default_rng(0).normal(size=self.free.shape), 0.0)
        basis, diagonal, beside = [w / np.linalg.norm(w)], list[float](), list[float]()
        h = self._length(basis[0])
        if np.isnan(h):
            return np.nan, w
        for k in range(min(LANCZOS_STEPS, int(self.free.sum()))):
            product = self.times(basis[k], h)
            diagonal.append(float(np.sum(product * basis[k])))
            for one in (*basis, *basis):  # twice is enough (Kahan and Parlett)
                product = product - np.sum(product * one) * one
            size = float(np.linalg.norm(product))
            if not size > 1e-6:
                break
            beside.append(size)
            basis.append(product / size)
        m = len(diagonal)
        T = np.diag(diagonal) + np.diag(beside[: m - 1], 1) + np.diag(beside[: m - 1], -1)
        values, vectors = np.linalg.eigh(T)
        return float(values[0]), np.tensordot(vectors[:, 0], np.array(basis[:m]), axes=1)

    def measured(self) -> Measurement:
        """The negative curvature that is left, along which the cost falls."""
        if not self.free.any():
            return Measurement("negative_curvature", 0.0, "", CURVATURE_BOUND, "all controls are at their bounds")
        (lowest, w), tested = self.lowest(), self
        if not np.isfinite(lowest):
            return Measurement("negative_curvature", np.nan, "", None, NOT_SMOOTH)
        note = "of the cost by the controls, relative to the LQ problem's: a minimum has none"
        for factor in STIFFER if self.plan.bound_penalties is not None else ():
            if lowest < -CURVATURE_BOUND:
                stiffer = self._with_penalties(factor)
                other = stiffer.lowest()
                if np.isfinite(other[0]):
                    (lowest, w), tested = other, stiffer
        if lowest < -CURVATURE_BOUND and not tested._falls(w, lowest):
            lowest, note = 0.0, f"{note}; the lowest found is {lowest:.2g}, and the cost does not fall along it"
        return Measurement("negative_curvature", max(0.0, -lowest), "", CURVATURE_BOUND, note)

    def _with_penalties(self, factor: float) -> _ReducedHessian:
        """The same with penalties of so many times the weights, whose forces along the plan are those of its own."""
        of, given, plan = self.problem.trajectory_constraints, self.plan.bound_penalties, self.plan
        assert of is not None  # which the penalties are of
        assert given is not None
        e, found = of.deviations(plan.xs, plan.us), copy(self)
        lower = np.where(e < given.lower, e + (given.lower - e) / factor, given.lower)
        upper = np.where(e > given.upper, e + (given.upper - e) / factor, given.upper)
        found.plan = replace(plan, bound_penalties=BoundPenalties(lower, upper, factor * given.weight))
        return found

    def _length(self, w: np.ndarray) -> float:
        """The largest length at which differences along w (N, nu) are those of a smooth cost; NaN for none."""
        for h in (self.size * step for step in STEPS):
            product, other = self.times(w, h), self.times(w, 0.25 * h)
            if np.linalg.norm(product - other) <= SMOOTH * np.linalg.norm(product):
                return h
        return np.nan

    def _falls(self, w: np.ndarray, curvature: float) -> bool:
        """Whether the mean of the cost both ways along w (N, nu) is lower somewhere, by more than rounding.

        The mean, since a slope that is left lowers it one way; differences of gradients may be rounding alone.
        """
        _, costs = self.along(w, curvature)
        means = 0.5 * (costs[1::2] + costs[2::2])
        return bool(np.nanmin(means) < costs[0] - 1e-9 * self.size**2)

    def along(self, w: np.ndarray, curvature: float) -> tuple[np.ndarray, np.ndarray]:
        """Controls (K, N, nu) and costs (K,) of the plan and of motions both ways along w (N, nu), ever longer."""
        lengths = [self.size * min(np.sqrt(2.0 * fall / -curvature), 1.0) for fall in FALLS]
        ways = [sign * length * w for length in lengths for sign in (1.0, -1.0)]
        xs, us = self._moved(np.stack([0.0 * w, *ways]))
        return us, np.array([self._cost(*one) for one in zip(xs, us, strict=True)])

    def _cost(self, xs: np.ndarray, us: np.ndarray) -> float:
        finite = np.isfinite(xs).all()
        return self.problem.penalized_cost(self.plan.bound_penalties, xs, us) if finite else np.nan


def cheaper_along_lowest_curvature(
    plan: Plan, problem: Problem, sweep: lq.Sweep
) -> tuple[np.ndarray, float] | None:  # fmt: skip
    """Controls (N, nu) of the cheapest motion along the lowest negative curvature, and its fall of the cost.

    None if none is cheaper.
    """
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    hessian = _ReducedHessian(plan, problem, sweep, A, B, max(abs(plan.cost), float(np.finfo(float).tiny)))
    lowest, w = hessian.lowest()
    if not lowest < -CURVATURE_BOUND:
        return None
    us, costs = hessian.along(w, lowest)
    best = int(np.nanargmin(costs))
    us = us if problem.bounds is None else problem.bounds.clip(slice(None), us, None)
    return (us[best], float(costs[0] - costs[best])) if best > 0 else None


def curvature_unknown(measured: Any) -> bool:
    """Whether measurements of optimality() leave the curvature unchecked."""
    return any(one.name == "negative_curvature" and one.bound is None for one in measured)
