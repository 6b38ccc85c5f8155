"""Gains that track a plan: LQR, warm starts by tracking, and gains for contacts whose stiffness is not known exactly.

A warm start has first controls from a plan of another discretization. Along an unstable trajectory, the rollout of a
plan's controls with another integrator diverges within a second, and SLQ from there ends in another local minimum, if
at all. So the plan is tracked in the new dynamics, u = us + K (x - xs), with its own gains or with those of a Riccati
sweep along its states in the new dynamics. The rollout of lowest cost is the first guess.

A foot that stands lightly on stiff ground tells by its depth how hard it presses. The LQ problem uses this: gains of an
ankle may have the wrong sign for a foot in the air, since the ground holds it. Where the file's contact is softer than
the plan's law, as MuJoCo's is under light bodies, such gains run away within a few stages. So the ground's part in the
dynamics is taken for random: with the stiffness K of every contact with a plane divided by its law's uncertainty,

    A + w dA,   B + w dB,   dA = A(K / uncertainty) - A(K),   dB alike,   w white noise of variance s,

along the same trajectory. What is wrong about a ground stays wrong: a floor that lies higher than in the plan presses
harder stage after stage. Over many stages noise of variance s = PERSISTENCE / dt adds up to as much as an error of
variance 1 that lasts for PERSISTENCE. The expected cost-to-go of the next stage adds to the stage's Hessians (Wonham
1967; de Koning 1982)

    Q + s dA' P dA,   R + s dB' P dB,   S + s dB' P dA

P of the LQ problem without noise. With P of the one with it, by fixed-point iteration, the gains differ little. The
plan's states and controls are those of the plan's own law; the gains alone change.

In the stage in which a foot lands the LQ problem knows to the millisecond when: its gains there are up to a hundred
times those before and after (a G1 that walks; 1 to 4 times for other machines), and throw a machine whose foot lands a
little earlier or later. So they are the mean of these two (problem.touch_downs); where feet land in stages that follow
each other, on a line between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics.protocol import feedback_control, rollout
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Quadratic
from planner.problem.initial_guess import Trajectory
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.touch_downs import landings
from planner.solvers import lq

PERSISTENCE = 0.1  # s; with 0.05 to 0.2 bipeds on floors 5 mm too high or low end alike, with 0.025 up to a third fall
_WEAKEST = 1e-6  # smallest tracking weight of a state, relative to the largest


def tracking_gains(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray | None:
    """Gains K (N, nu, ndx) of u = K[n] x for the sum of x'Qx/2 + u'Ru/2 over N stages and x'Qx/2 at the end.

    Args:
        A: (N, ndx, ndx).
        B: (N, ndx, nu).
        Q: (N+1, ndx, ndx).
        R: (N, nu, nu).

    Returns:
        None where R + B'PB is not positive definite, or gains are not finite.
    """
    sweep = lq.riccati(A, B, Quadratic(Q, np.zeros(Q.shape[:2]), R, np.zeros(R.shape[:2])))
    return sweep.K if sweep is not None and np.isfinite(sweep.K).all() else None


def regulator_gains(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray | None:
    """Gains K (nu, ndx) of u = K x over infinitely many stages, by the discrete algebraic Riccati equation.

    Returns:
        None where no gains make A + BK stable.
    """
    from scipy.linalg import LinAlgError, solve_discrete_are  # 0.2 s of import, only when needed

    try:
        P = solve_discrete_are(A, B, Q, R)
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        stable = np.abs(np.linalg.eigvals(A + B @ K)).max() < 1.0
    except (LinAlgError, ValueError):
        return None
    return K if stable else None


def has_uncertain_ground(problem: Problem) -> bool:
    """Whether a contact's stiffness is not known exactly."""
    dynamics = problem.dynamics
    return isinstance(dynamics, RigidBodyDynamics) and any(
        contact.law.uncertainty > 1.0 for contact in dynamics.mechanism.contacts
    )


def with_robust_gains(plan: Plan) -> Plan:
    """The plan with gains for contacts of uncertain stiffness; as it is where none is, or a sweep is not definite."""
    problem, xs, us = plan.problem, plan.xs, plan.us
    if problem is None or not has_uncertain_ground(problem) or not np.isfinite(plan.K).all():
        return plan
    with np.errstate(all="ignore"):  # a diverged trajectory may contain any numbers
        A, B = problem.dynamics.linearize(xs, us)
        quadratic = problem.penalized_quadratic(plan.bound_penalties, xs, us, A, B)
        bounds = None if problem.bounds is None else problem.bounds.step_bounds(xs, us)
        if not (np.isfinite(A).all() and np.isfinite(B).all() and quadratic.finite):
            return plan
        K = robust_gains(problem, xs, us, A, B, quadratic, bounds)
    return plan if K is None or not np.isfinite(K).all() else replace(plan, K=K)


def robust_gains(
    problem: Problem, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray, quadratic: Quadratic,
    bounds: StepBounds | None,
) -> np.ndarray | None:  # fmt: skip
    """Gains (N, nu, ndx) for contacts of uncertain stiffness; None where a sweep is not positive definite.

    Args:
        problem: With uncertain ground.
        xs: States (N+1, nx).
        us: Controls (N, nu).
        A: (N, ndx, ndx) along them.
        B: (N, ndx, nu).
        quadratic: Quadratic model of the cost along them, with active penalties.
        bounds: Of the control steps; those that depend on the state are taken for constant.
    """
    constant = None if bounds is None else StepBounds(bounds.lower, bounds.upper)
    sweep = lq.riccati(A, B, quadratic, bounds=constant)
    if sweep is None:
        return None
    P, S = sweep.P[1:], quadratic.S
    Q, R, S = quadratic.Q.copy(), quadratic.R.copy(), np.zeros(sweep.K.shape) if S is None else S.copy()
    softer_A, softer_B = _on_softer_ground(problem.dynamics).linearize(xs, us)
    stages = PERSISTENCE / problem.dynamics.dt
    dA, dB = math.sqrt(stages) * (softer_A - A), math.sqrt(stages) * (softer_B - B)
    P_dA, dB_T = P @ dA, dB.transpose(0, 2, 1)
    Q[:-1] += dA.transpose(0, 2, 1) @ P_dA
    R += dB_T @ P @ dB
    S += dB_T @ P_dA
    sweep = lq.riccati(A, B, quadratic._replace(Q=Q, R=R, S=S), bounds=constant)
    return None if sweep is None else across_landings(
        sweep.K, [one.stage - 1 for one in landings(problem.dynamics, xs)]
    )  # fmt: skip


def across_landings(K: np.ndarray, stages: Collection[int]) -> np.ndarray:
    """Gains (N, nu, ndx) that lie on a line between those before and after in the stages in which feet land."""
    result = K.copy()
    for first in (n for n in stages if n - 1 not in stages and n > 0):
        end = next(n for n in range(first, len(K) + 1) if n not in stages)
        if end < len(K):
            shares = (np.arange(first, end) - (first - 1.0)) / (end - (first - 1.0))
            result[first:end] = K[first - 1] + shares[:, None, None] * (K[end] - K[first - 1])
    return result


def _on_softer_ground(dynamics: Any) -> RigidBodyDynamics:
    """The dynamics with each contact as soft as its law's uncertainty allows."""

    def softer(contact: Any) -> Any:
        return replace(contact, law=replace(contact.law, stiffness=contact.law.stiffness / contact.law.uncertainty))

    return with_contacts(dynamics, softer)


def with_contacts(
    dynamics: Any, plane: Callable[[Any], Any], pair: Callable[[Any], Any] = lambda pair: pair
) -> RigidBodyDynamics:
    """RigidBodyDynamics with each contact with a plane, and each of two bodies, replaced."""
    own = dynamics.mechanism
    contacts, body_contacts = tuple(map(plane, own.contacts)), tuple(map(pair, own.body_contacts))
    mechanism = replace(own, contacts=contacts, body_contacts=body_contacts)
    return dynamics.with_mechanism(mechanism)


def warm_start(plan: Plan, problem: Problem) -> np.ndarray:
    """First controls (N, nu): of lowest cost among the problem's own guess, the plan's and those that track the plan.

    Args:
        plan: Plan of the same duration with at most N stages.
        problem: The new problem; its number of stages N is a multiple of the plan's.
    """
    parts = problem.N // plan.N
    us, K = np.repeat(plan.us, parts, axis=0), np.repeat(plan.K, parts, axis=0)
    xs = plan.xs if parts == 1 else plan.between_knots(parts)  # a discrete map has no states between knots
    tries = [feedback_rollout(problem, problem.first_guess), feedback_rollout(problem, us)]
    for gains in (K, _gains(problem, xs, us)):
        tries += [] if gains is None else [feedback_rollout(problem, us, gains, xs)]
    return min(tries, key=lambda one: one[0])[1]


def tracked_warm_start(
    problem: Problem, given: Plan | Trajectory, max_cost_ratio: float
) -> tuple[np.ndarray, np.ndarray | None, BoundPenalties | None]:
    """A first guess from a trajectory of any duration and step, sampled at the problem's knots.

    Args:
        problem: The problem.
        given: The trajectory.
        max_cost_ratio: Tracking fails if the rollout costs more than this multiple of the sampled trajectory.

    Returns:
        Controls (N, nu) of the cheapest tracking rollout, or the trajectory's own where tracking fails; the
        trajectory's states (N+1, nx) where tracking fails, else None; its penalties, or None.

    Raises:
        PlannerError: Neither a Plan nor a Trajectory, or other dimensions of state or control.
    """
    motion = given.motion if isinstance(given, Plan) else given
    if not isinstance(motion, Trajectory):
        raise PlannerError(
            f"warm_start is {short_repr(given)}, expected a Plan, or what plan.shifted(seconds) or "
            "plan.stretched(duration) returns."
        )
    own, nx, nu = problem.dynamics, motion.xs.shape[1], motion.us.shape[1]
    if (nx, nu, motion.space.ndx) != (own.nx, own.nu, space_of(own).ndx):
        raise PlannerError(
            f"warm_start has {nx} states and {nu} controls, expected {own.nx} and {own.nu}: a plan of the same machine."
        )
    there = motion.at(own.dt * np.arange(problem.N + 1))
    pulls, kept = there.pulls, problem.trajectory_constraints
    penalties = None if pulls is None or kept is None else pulls.penalties(kept)
    xs, us, near = there.xs, there.us, max_cost_ratio * problem.cost.value(there.xs, there.us)
    cost, found = min(feedback_rollout(problem, us), feedback_rollout(problem, us, there.K, xs), key=lambda one: one[0])
    retuned = None if cost <= near else _gains(problem, xs, us)
    if retuned is not None:
        cost, found = feedback_rollout(problem, us, retuned, xs)
    return (found, None, penalties) if cost <= near else (us, xs, penalties)


def at_pace(plan: Plan, pace: float) -> Plan:
    """The plan with velocities scaled by `pace` and unchanged controls, for a warm start at another duration."""
    assert plan.problem is not None
    mechanism, xs = capabilities_of(plan.problem.dynamics).mechanism, plan.xs.copy()
    if mechanism is not None:
        xs[:, mechanism.velocities] *= pace
    return replace(plan, xs=xs)


def feedback_rollout(
    problem: Problem, us: np.ndarray, K: np.ndarray | None = None, about: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Cost (inf if not finite) and clipped controls (N, nu) of the rollout u = us + K difference(x, about)."""
    control = None if K is None or about is None else feedback_control(problem.dynamics, about, us, K)
    with np.errstate(all="ignore"):  # a rollout may diverge
        xs, us = rollout(problem.dynamics, problem.x0, us, control, bounds=problem.bounds)
        cost = problem.cost.value(xs, us) if np.isfinite(xs[-1]).all() else math.inf
    return (cost if math.isfinite(cost) else math.inf), us


def _gains(problem: Problem, xs: np.ndarray, us: np.ndarray) -> np.ndarray | None:
    """LQR gains (N, nu, ndx) along a trajectory: the cost's weights, plus dt times the final one at every knot."""
    model = problem.cost.quadratize(xs, us)
    Q = model.Q + problem.dynamics.dt * model.Q[-1]
    Q = Q + _WEAKEST * np.abs(Q).max() * np.eye(Q.shape[1])
    A, B = problem.dynamics.linearize(xs, us)
    return tracking_gains(A, B, Q, model.R)
