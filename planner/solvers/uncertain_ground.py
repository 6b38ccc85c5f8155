"""Gains for contacts whose stiffness is not known exactly.

A foot that stands lightly on stiff ground tells by its depth how hard it presses. The LQ problem uses this: gains of an
ankle may have the wrong sign for a foot in the air, since the ground holds it. Where the file's contact is softer or
stiffer than the plan's law, such gains run away within a few stages. So the contact's part in the dynamics is taken for
random: with the stiffness K of every contact multiplied and divided by its law's uncertainty,

    A + sum_i w_i (A_i - A),   B + sum_i w_i (B_i - B),   w_i white noise of variance 1,

A_i, B_i the linearizations with those stiffnesses along the same trajectory. The expected cost-to-go of the next stage
adds to the stage's Hessians (Wonham 1967; de Koning 1982)

    Q + sum_i dA_i' P dA_i,   R + sum_i dB_i' P dB_i,   S + sum_i dB_i' P dA_i,   dA_i = A_i - A,

P of the LQ problem without noise. With P of the one with it, by fixed-point iteration, the gains differ little. The
plan's states and controls are those of the plan's own law; the gains alone change.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers import lq


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
    P, S = sweep.P, quadratic.S
    Q, R, S = quadratic.Q.copy(), quadratic.R.copy(), np.zeros(sweep.K.shape) if S is None else S.copy()
    for side in (-1.0, 1.0):
        other_A, other_B = _with_other_stiffness(problem.dynamics, side).linearize(xs, us)
        dA, dB = other_A - A, other_B - B
        P_dA, dB_T = P[1:] @ dA, dB.transpose(0, 2, 1)
        Q[:-1] += dA.transpose(0, 2, 1) @ P_dA
        R += dB_T @ P[1:] @ dB
        S += dB_T @ P_dA
    sweep = lq.riccati(A, B, quadratic._replace(Q=Q, R=R, S=S), bounds=constant)
    return None if sweep is None else sweep.K


def _with_other_stiffness(dynamics: Any, side: float) -> RigidBodyDynamics:
    """The dynamics with each contact's stiffness at one side of its uncertainty."""

    def other(contact: Any) -> Any:
        law = contact.law
        return replace(contact, law=replace(law, stiffness=law.stiffness * law.uncertainty**side))

    mechanism = replace(dynamics.mechanism, contacts=tuple(map(other, dynamics.mechanism.contacts)))
    return RigidBodyDynamics(mechanism, dynamics.dt, dynamics.integrator, dynamics.prescribed, dynamics.substeps)
