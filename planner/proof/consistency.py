"""Step 0 of a proof: whether a plan agrees with its own dynamics and cost, and whether its solve converged.

Everything is recomputed from the plan's states and controls, without MuJoCo. The effect of rounding depends on the
machine and its weights, so it is measured: the same is computed with relative errors of 1e-13 in states, controls and
Jacobians, and a value that these change by more than the usual bound is judged by that change.

At nonsmooth contacts the LQ model expects a decrease that no step achieves. There the remaining decrease is measured by
further steps of SLQ, as a solve ends by its actual reduction (actual_reduction_tolerance of planner.solve).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner.base.measured import Measurement, Section
from planner.dynamics.assembly import relative_min_singular_value
from planner.model.capabilities import capabilities_of
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.jerk import JerkCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.goals import terms_of
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.rediscretize import step_error
from planner.proof.error_scales import COST_BOUND, is_nonsmooth, judged_cost, limit_violations, planned_violations
from planner.proof.stationarity import stationarity
from planner.solvers import lq
from planner.solvers.gains import has_uncertain_ground, robust_gains
from planner.solvers.options import EXPECTED_REDUCTION_TOLERANCE

STEP_ERROR = "step_error"  # %, of the section "optimality"
BOUND = 1e-9  # relative; a plan and its file agree to rounding
_MANY = 0.3  # of the controls, at bounds
GAIN_BOUND = 1e-6  # relative; rounding error of a Riccati sweep over unstable stages
_LAST_DIGITS = 1e-13  # relative rounding errors of states and controls: sums over a tree of links leave 13 of 16 digits
_LAST_STEP = 1e-8  # rad, m: by how much the last step of a converged solve may move a state
_MARGIN = 30.0  # ratio of the largest of many rounding errors to a sampled one
_MAX_ROUNDING_SHARE = 1e-3  # upper limit of a bound from rounding, relative
_MAX_GAINS = 0.25  # upper limit of a gain bound, relative: half of an LQ regulator's margin, which is 1/2
SINGULAR = 0.02  # of the largest singular value of the closed chains' Jacobian: forces are some fifty times larger
_DRAWS = 3  # samples of rounding errors
_MIN_COST_SHARE = 1e-3  # of the cost of errors that pass: costs smaller than that are as good as zero


class Recomputed(NamedTuple):
    """Quantities recomputed from a plan's states and controls."""

    defects: np.ndarray  # (N, ndx) of each state from one stage of the last
    cost: float
    gradient_norm: float  # Eq. 19, projected where controls are at their bounds
    terms: float  # norm of the terms of which the gradient is the sum
    sweep: lq.Sweep | None  # None where R + B'PB is not positive definite
    gains: np.ndarray | None  # (N, nu, ndx), with controls held at bounds that depend on the state


def recomputed(
    plan: Plan, problem: Problem, xs: np.ndarray, us: np.ndarray, rng: np.random.Generator | None = None
) -> Recomputed:
    """At states xs (N+1, nx) and controls us (N, nu).

    With a rng, the sweep's Jacobians have random rounding errors, and bounds of states those of a last step: a
    state that lies on its bound without force may count as beyond it or not.
    """
    with np.errstate(all="ignore"):  # a plan may contain any numbers; a NaN passes no bound
        defects = plan.space.difference(problem.dynamics.step(xs[:-1], us), xs[1:])
        A, B = problem.dynamics.linearize(xs, us)
        penalties = plan.bound_penalties
        if penalties is not None and problem.trajectory_constraints is not None and rng is not None:
            shift = _LAST_STEP * rng.uniform(-1.0, 1.0, penalties.lower.shape)
            penalties = penalties._replace(lower=penalties.lower + shift, upper=penalties.upper + shift)
        quadratic = problem.penalized_quadratic(penalties, xs, us, A, B)
        moves = None if problem.bounds is None else problem.bounds.step_bounds(xs, us)
        norm = float(np.linalg.norm(lq.projected(lq.reduced_gradient(A, B, quadratic, moves), moves)))
        known = np.isfinite(A).all() and np.isfinite(B).all() and quadratic.finite
        rounded = (A, B) if rng is None else (_with_wrong_digits(rng, A), _with_wrong_digits(rng, B))
        sweep = held = lq.riccati(*rounded, quadratic, bounds=moves) if known else None
        if known and moves is not None and moves.lower_by_x is not None:
            held = lq.riccati(*rounded, quadratic, bounds=StepBounds(moves.lower, moves.upper))
        gains = None if held is None else held.K
        terms = float(np.linalg.norm(quadratic.r)) + norm
        if gains is not None and has_uncertain_ground(problem):
            gains = robust_gains(problem, xs, us, *rounded, quadratic, moves)
        return Recomputed(defects, problem.cost.value(xs, us), norm, terms, sweep, gains)


NOT_FINITE = "parts_not_finite"


def with_finite_parts(plan: Plan, problem: Problem) -> tuple[Plan, tuple[Measurement, ...]]:
    """The plan, or one at rest at its start in place of what a diverged solve left, which fails by the measurement."""
    parts = {"states": plan.xs, "controls": plan.us, "gains": plan.K}
    bad = [name for name, values in parts.items() if not np.isfinite(values).all()]
    if not bad:
        return plan, ()
    rest = np.tile(problem.x0, (plan.N + 1, 1))
    finite = replace(plan, xs=rest, us=np.zeros_like(plan.us), K=np.zeros_like(plan.K))
    note = f"its {', '.join(bad)} are not finite, so it is not replayed." + ("" if plan.success else f" {plan.message}")
    return finite, (Measurement(NOT_FINITE, float(len(bad)), "", 0.0, note),)


def consistency(plan: Plan, problem: Problem, now: Recomputed) -> Section:
    """Start, states, cost, gradient, gains and times recomputed from the plan's states and controls."""
    cost = judged_cost(problem)
    with np.errstate(all="ignore"):
        scale = max(abs(plan.cost), _MIN_COST_SHARE * cost.scale(plan, problem), np.finfo(float).tiny)
        size = max(now.terms, scale)
        largest = max(1.0, float(np.abs(plan.xs).max()))
        t = problem.dynamics.dt * np.arange(plan.N + 1)
        exact = {
            "start_state_error": (_largest(plan.xs[0] - problem.x0) / largest, "first state against the problem's x0"),
            "stage_error": (_largest(now.defects) / largest, "each state against one stage from the last"),
            "time_error": (_largest(plan.t - t) / problem.duration, "the knots against n dt"),
        }
        measured = [Measurement(n, float(e), "", BOUND, f"{note}, relative") for n, (e, note) in exact.items()]
        costs = abs(now.cost - plan.cost) / scale
        both = now.gradient_norm, plan.gradient_norm
        gradient = 0.0 if both == (np.inf, np.inf) else abs(both[0] - both[1]) / size  # open-loop costates overflow
        gains = _gain_errors(plan.K, now.gains)
        gains = 0.0 * plan.t[:-1] if plan.status is Status.GIVEN else gains  # given gains are not from a sweep
        known = costs <= BOUND and gradient <= BOUND and np.all(gains <= GAIN_BOUND)
        moved = (0.0, 0.0, np.zeros(plan.N)) if known else _moved(plan, problem, now, scale, size)
        by_stage = np.clip(_MARGIN * moved[2], GAIN_BOUND, _MAX_GAINS)
        worst = int(np.argmax(np.where(np.isfinite(gains), gains / by_stage, np.inf)))
    why, gain_bound = "; the bound is what rounding makes of it here", float(by_stage[worst])
    sums = (("cost_error", costs, "the cost recomputed"), ("gradient_error", gradient, "the norm of Eq. 19 recomputed"))
    for place, ((name, error, note), share) in enumerate(zip(sums, moved[:2], strict=True), 2):
        bound = max(BOUND, min(_MARGIN * share, _MAX_ROUNDING_SHARE))
        note += ", relative" + (why if bound > BOUND else "")
        measured.insert(place, Measurement(name, float(error), "", bound, note))
    note = "the gains against the last Riccati sweep (Eq. 31-33), relative to the largest"
    note += f"; of stage {worst}{why}" if gain_bound > GAIN_BOUND else ""
    if now.gains is None:
        note = "R + B'PB is not positive definite along the plan: its gains are those of a regularized model"
    measured.append(Measurement("gain_error", float(gains[worst]), "", gain_bound, note))
    note = f"changed after the file was written: {', '.join(plan.changed)}" if plan.changed else "of the plan's file"
    measured.append(Measurement("changed_parts", float(len(plan.changed)), "", 0.0, note))
    measured += limit_violations(problem, plan.xs, plan.us, "at the plan's knots")
    measured += planned_violations(plan, problem)
    measured += _nearest_to_singular(plan, problem)
    return Section("plan", tuple(measured))


def _nearest_to_singular(plan: Plan, problem: Problem) -> list[Measurement]:
    """Smallest ratio of extreme singular values of the loop closures' Jacobian along the plan."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not mechanism.loops or not np.isfinite(plan.xs).all():
        return []
    shares = relative_min_singular_value(mechanism, plan.xs[:, : mechanism.nq])
    worst = int(np.argmin(shares))
    note = f"least singular value of the closed chains' Jacobian over its largest, at {plan.t[worst]:.3g} s"
    if shares[worst] < SINGULAR:
        note += ": a chain lies nearly in line there, could go on in more than one way and takes large forces"
    return [Measurement("nearest_to_singular", float(shares[worst]), "", None, note)]


def optimality(plan: Plan, problem: Problem, now: Recomputed, repeated: bool = False) -> Section:
    """Whether the solve converged, and whether another iteration would still lower the cost.

    That the steps do not resolve the motion is a prediction, by their errors carried along the closed loop. It counts
    unless MuJoCo has `repeated` the plan at finer steps, which measures it.
    """
    done = plan.converged and (repeated or plan.status is not Status.UNRESOLVED)  # a missed goal is judged as one
    ended = 0.0 if done else 1.0
    measured = [Measurement("not_converged", ended, "", 0.0, plan.message, holds="converged")]
    note = "of a coordinate's range of motion, by halving each stage, carried along the closed loop"
    measured.append(Measurement(STEP_ERROR, 100.0 * step_error(plan), "%", None, note))
    if now.sweep is not None:
        scale = max(abs(plan.cost), judged_cost(problem).scale(plan, problem), _unseen(plan, problem))
        left = max(0.0, -now.sweep.value)
        note = "of the cost: what one more step of SLQ promises"
        if left <= EXPECTED_REDUCTION_TOLERANCE * max(1.0, abs(plan.cost)) and done:  # a light machine may cost 1e-10
            left, note = 0.0, f"{note}; {left:.3g} of {plan.cost:.3g} is less than what a solve goes on for"
        tries = is_nonsmooth(plan) or _approximate(problem) or _clamped(plan, problem)
        if tries and 100.0 * left > COST_BOUND * scale:
            note = f"of the cost: what {STEPS} more steps of SLQ gain; the next promises {100.0 * left / scale:.3g} %"
            left = remaining_decrease(plan, problem)
        left *= 100.0 / scale
        measured.append(Measurement("decrease_left", left, "%", COST_BOUND, note))
        if done and left <= COST_BOUND:
            measured += stationarity(plan, problem, now.sweep, scale)
    return Section("optimal", tuple(measured))


def _approximate(problem: Problem) -> bool:
    """Whether a cost term uses an approximate Hessian, so that the LQ model's expected reduction is not achieved."""
    return any(isinstance(term, JerkCost) for term in terms_of(problem.cost))


def _clamped(plan: Plan, problem: Problem) -> bool:
    """Whether so many controls are at bounds, as in least time, that a sweep promises what no step achieves.

    It clamps stage by stage, and with gains that are zero there.
    """
    return problem.bounds is not None and float(problem.bounds.at_bound(plan.xs, plan.us).mean()) > _MANY


def _unseen(plan: Plan, problem: Problem) -> float:
    """Cost of state and control errors within step 0's bounds: a plan that stays at its goal may cost less."""
    quadratic = problem.cost.quadratize(plan.xs, plan.us)
    parts = ((quadratic.Q, plan.xs), (quadratic.R, plan.us))
    return sum(
        0.5 * float(np.abs(np.trace(weights, axis1=1, axis2=2)).sum()) * (BOUND * max(1.0, _largest(values))) ** 2
        for weights, values in parts
    )


def _moved(plan: Plan, problem: Problem, now: Recomputed, scale: float, size: float) -> tuple[float, float, np.ndarray]:
    """Effect of rounding errors on cost and gradient's norm, over their sizes, and on the gains of each stage (N,).

    The errors are in states and controls, and in the sweep's Jacobians too, which may be constant.
    """
    rng, cost, gradient, gains = np.random.default_rng(0), 0.0, 0.0, np.zeros(plan.N)
    for _ in range(_DRAWS):
        xs, us = (_with_wrong_digits(rng, x) for x in (plan.xs, plan.us))
        if problem.bounds is not None:
            at_bound = problem.bounds.at_bound(plan.xs, plan.us)
            held = problem.bounds.shifted_with_bounds(plan.us, plan.xs, xs)
            us = np.where(at_bound, held, us)
        other = recomputed(plan, problem, xs, us, rng)
        cost = max(cost, abs(other.cost - now.cost) / scale, _rounding_of_sums(plan, problem) / scale)
        gradient = max(gradient, abs(other.gradient_norm - now.gradient_norm) / size)
        if now.gains is not None:
            lost = np.inf if other.gains is None else _gain_errors(now.gains, other.gains)
            gains = np.maximum(gains, lost)
    beside = np.pad(gains, 1)  # maximum over neighbouring stages, since a sample may miss a stage's error
    return cost, gradient, np.max([beside[:-2], gains, beside[2:]], axis=0)


def _rounding_of_sums(plan: Plan, problem: Problem) -> float:
    """Rounding of a cost whose terms cancel, as those of a weight on the sum of two angles do."""
    total = 0.0
    for term in terms_of(problem.cost):
        if isinstance(term, TrackingCost):
            e, eu = np.abs(plan.space.difference(plan.xs, term.x_ref)), np.abs(plan.us - term.u_ref)
            total += float(np.einsum("ni,nij,nj->", e, np.abs(term.Q), e))
            total += float(np.einsum("ni,nij,nj->", eu, np.abs(term.R), eu))
    return float(np.finfo(float).eps) * total


def _with_wrong_digits(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    return values * (1.0 + _LAST_DIGITS * rng.uniform(-1.0, 1.0, values.shape))


def _gain_errors(K: np.ndarray, expected: np.ndarray | None) -> np.ndarray:
    """(N,) errors of gains (N, nu, ndx), relative to the largest expected; without these 0 if finite, else inf."""
    if expected is None:
        return np.where(np.isfinite(K).all(axis=(1, 2)), 0.0, np.inf)
    return np.abs(K - expected).max(axis=(1, 2)) / max(_largest(expected), np.finfo(float).tiny)


def _largest(values: np.ndarray) -> float:
    """The largest magnitude; NaN if any value is."""
    return float(np.abs(values).max())


STEPS = 10
_HALVINGS = 12  # step lengths 1, 1/2, ... that are tried


@np.errstate(all="ignore")  # a long step may diverge: then it does not count
def remaining_decrease(plan: Plan, problem: Problem) -> float:
    """The decrease of a plan's cost in at most STEPS iterations, each with the best of several step lengths."""
    xs, us = plan.xs, plan.us
    first = cost = _cost(plan, problem, xs, us)
    for _ in range(STEPS):
        A, B = problem.dynamics.linearize(xs, us)
        quadratic = problem.penalized_quadratic(plan.bound_penalties, xs, us, A, B)
        moves = None if problem.bounds is None else problem.bounds.step_bounds(xs, us)
        sweep = lq.riccati(A, B, quadratic, bounds=moves)
        if sweep is None:
            break
        tried = _rolled(plan, problem, xs, us, sweep)
        costs = np.array([_cost(plan, problem, *one) for one in zip(*tried, strict=True)])
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if not costs[best] < cost:
            break
        xs, us, cost = tried[0][best], tried[1][best], float(costs[best])
    return first - cost


def _rolled(
    plan: Plan, problem: Problem, xs: np.ndarray, us: np.ndarray, sweep: lq.Sweep
) -> tuple[np.ndarray, np.ndarray]:
    """States (S, N+1, nx) and controls (S, N, nu) of S step lengths along a sweep's direction, with its gains."""
    lengths = 0.5 ** np.arange(_HALVINGS + 1)
    states = np.empty((len(lengths), *xs.shape))
    controls = np.empty((len(lengths), *us.shape))
    states[:, 0] = problem.x0
    for n in range(len(us)):
        dx = plan.space.difference(states[:, n], np.broadcast_to(xs[n], states[:, n].shape))
        wanted = us[n] + lengths[:, None] * sweep.k[n] + dx @ sweep.K[n].T
        controls[:, n] = wanted if problem.bounds is None else problem.bounds.clip(n, wanted, states[:, n])
        states[:, n + 1] = problem.dynamics.step(states[:, n], controls[:, n])
    return states, controls


def _cost(plan: Plan, problem: Problem, xs: np.ndarray, us: np.ndarray) -> float:
    """The cost, including penalties of trajectory constraints with the plan's last multipliers."""
    return problem.penalized_cost(plan.bound_penalties, xs, us) if np.isfinite(xs).all() else np.inf
