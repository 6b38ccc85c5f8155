"""Gains: LQR along a trajectory and at an equilibrium, and gains for contacts whose stiffness is not known exactly.

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
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers import lq


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


PERSISTENCE = 0.1  # s; with 0.05 to 0.2 bipeds on floors 5 mm too high or low end alike, with 0.025 up to a third fall


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
        quadratic: Quadratic = problem.cost.quadratize(xs, us)
        if plan.bound_penalties is not None and problem.trajectory_constraints is not None:
            quadratic = problem.trajectory_constraints.with_penalties(plan.bound_penalties, quadratic, xs, us, A, B)
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
    return None if sweep is None else sweep.K


def _on_softer_ground(dynamics: Any) -> RigidBodyDynamics:
    """The dynamics with each contact as soft as its law's uncertainty allows."""

    def softer(contact: Any) -> Any:
        return replace(contact, law=replace(contact.law, stiffness=contact.law.stiffness / contact.law.uncertainty))

    mechanism = replace(dynamics.mechanism, contacts=tuple(map(softer, dynamics.mechanism.contacts)))
    return RigidBodyDynamics(mechanism, dynamics.dt, dynamics.integrator, dynamics.prescribed, dynamics.substeps)
