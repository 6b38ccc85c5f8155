"""The cost of reaching a goal with given weights, and of staying there: the cost-to-go of a finite time after the end.

Large final weights on positions and velocities make the gains vary strongly over the last stages, which amplifies
errors of the ground model. The cost-to-go of staying at the goal avoids this: with the weights Q, R of a stage and the
dynamics A, B linearized at the goal,

    P(T) = Q,    P(t) = Q + A'P A - A'P B (R + B'P B)^-1 B'P A

for each stage after the end gives the cost-to-go of a deviation at the end (Eq. 33), and the gains are those of a
machine at rest at the goal. The time is finite because the cost of uncontrollable directions (feet do not slide back)
grows with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import bias, mass_matrix
from planner.dynamics.contacts import contact_forces
from planner.dynamics.joint_forces import actuator_lengths, force_slopes
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.statics import stands_somewhere
from planner.problem.costs.frame import SlipCost
from planner.problem.costs.terms import SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.default_weights import MOVING_SHARE, WAY_SHARE, default_weights, fully_actuated, servos_of
from planner.problem.initial_guess import minimum_jerk

LARGEST = 1e12  # upper limit of the entries of P; above it the cost is returned unchanged


def default_cost(
    dynamics: RigidBodyDynamics, x0: Any, goal: Any, horizon: int, *,
    tolerance: float | Mapping[str, float] | None = None, **weights: Any,
) -> TrackingCost | SumCost:  # fmt: skip
    """A cost for reaching a goal (nx,) from x0 (nx,), with default weights.

    Args:
        dynamics: The machine.
        x0: (nx,) start.
        goal: (nx,) end.
        horizon: N, number of stages.
        tolerance: Of the goal, as of Problem.
        **weights: Arguments of TrackingCost.joints that replace the default ones.

    Raises:
        PlannerError: As TrackingCost.joints.
    """
    x0, goal = np.asarray(x0, dtype=float), np.asarray(goal, dtype=float)
    chosen: dict[str, Any] = default_weights(dynamics, x0, goal, horizon * dynamics.dt, tolerance=tolerance).weights
    straight = stands_somewhere(dynamics.mechanism, np.stack([x0, goal]))
    return weighed(dynamics, x0, goal, horizon, chosen | weights, straight=straight)


def weighed(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, horizon: int, weights: Mapping[str, Any], *,
    straight: bool,
) -> TrackingCost | SumCost:  # fmt: skip
    """The cost from x0 (nx,) to a goal (nx,), with weights by the arguments of TrackingCost.joints, hold, rest, slip.

    The running weights refer to straight_reference if `straight`, and of machines whose joints all have actuators, or
    that have servos; of others to the goal.

    Raises:
        PlannerError: As TrackingCost.joints and terminal_holding_cost.
    """
    chosen = dict(weights)
    hold, rest, slip = (chosen.pop(name, 0.0) for name in ("hold", "rest", "slip"))
    if straight:
        chosen.setdefault("reference", straight_reference(dynamics, x0, goal, horizon))
    elif fully_actuated(dynamics, np.stack([x0, goal])) or servos_of(dynamics).any():
        reference = straight_reference(dynamics, x0, goal, horizon, moving_share=1.0)
        chosen.setdefault("reference", reference)
        if servos_of(dynamics).any():
            chosen.setdefault("control", servo_reference(dynamics, reference))
    cost = staying_cost(dynamics, TrackingCost.joints(dynamics, goal, horizon, **chosen), hold, rest)
    return with_slip(cost, dynamics, slip, np.stack([x0, goal]))


def with_slip(cost: Any, dynamics: RigidBodyDynamics, slip: Any, xs: np.ndarray) -> Any:
    """A cost, and the one of feet that slide with a weight `slip`, 0 for none.

    Feet are the bodies that bear load at one of the states xs (E, nx); all that may touch where none does. A contact
    without friction is there to slide.

    Raises:
        PlannerError: A negative weight.
    """
    if number("weights.slip", slip, minimum=0.0) == 0.0:
        return cost
    mechanism = dynamics.mechanism
    forces = contact_forces(mechanism, xs[:, : mechanism.nq], np.zeros((len(xs), mechanism.nv))).forces
    loaded = {mechanism.contacts[k].link for k in np.flatnonzero(forces.any(axis=(0, 2)))}
    feet = [one for one in mechanism.contacts if one.law.friction > 0.0 and (one.link in loaded or not loaded)]
    return SumCost(cost, SlipCost(dynamics, slip, feet)) if feet else cost


def staying_cost(dynamics: RigidBodyDynamics, cost: TrackingCost, hold: Any, rest: Any) -> TrackingCost:
    """A cost at whose last reference the machine is to be for a share `rest` of its stages, and `hold` s after the end.

    Raises:
        PlannerError: rest is not from 0 to 1, or as terminal_holding_cost.
    """
    rest = number("rest", rest, minimum=0.0, maximum=1.0)
    if rest > 0.0:
        nv, N = dynamics.mechanism.nv, len(cost.Q) - 1
        Q, first = cost.Q.copy(), N - round(rest * N)
        Q[:first, :nv] = Q[:first, :, :nv] = 0.0
        Q[:first, nv : 2 * nv, nv : 2 * nv] *= WAY_SHARE
        cost = TrackingCost(Q, cost.R, np.tile(cost.x_ref[-1], (N + 1, 1)), cost.u_ref, cost.space)
    return terminal_holding_cost(dynamics, cost, hold)


def straight_reference(
    dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, N: int, moving_share: float = MOVING_SHARE
) -> np.ndarray:
    """States (N+1, nx) on the straight line from x0 to a goal, both (nx,), at the goal after `moving_share` of N."""
    mechanism, space = dynamics.mechanism, dynamics.space
    nv, start = mechanism.nv, mechanism.at_rest(x0)
    displacement = space.difference(mechanism.at_rest(goal), start)
    share, rate, _ = minimum_jerk(np.minimum(np.arange(N + 1) / (moving_share * N), 1.0))
    xs = space.integrate(np.tile(start, (N + 1, 1)), share[:, None] * displacement)
    xs[:, mechanism.velocities] = rate[:, None] * displacement[:nv] / (moving_share * N * dynamics.dt)
    xs[0], xs[N] = x0, goal
    return xs


def servo_reference(dynamics: RigidBodyDynamics, xs: np.ndarray, *, inertia: bool = False) -> np.ndarray:
    """Controls (N, nu) with which servos go along states (N+1, nx); 0 for motors.

    Each is the static control in the middle of its stage, and what balances the servo's own damping there; with
    `inertia` what the machine's inertia and damping take too.
    """
    mechanism, servos, space = dynamics.mechanism, servos_of(dynamics), dynamics.space
    nq, speeds, forces = mechanism.nq, xs[:, mechanism.velocities], np.zeros((len(xs) - 1, mechanism.nv))
    middle = space.integrate(xs[:-1], 0.5 * space.difference(xs[1:], xs[:-1]))
    if inertia:
        q, v = middle[:, :nq], middle[:, mechanism.velocities]
        forces = np.einsum("nij,nj->ni", mass_matrix(mechanism, q), np.diff(speeds, axis=0) / dynamics.dt)
        forces += bias(mechanism, q, v) - bias(mechanism, q, np.zeros_like(v))
    us = np.array([quasi_static_controls(dynamics, x, inertia=force) for x, force in zip(middle, forces, strict=True)])
    rates, own = middle[:, mechanism.velocities] @ mechanism.actuators.moment.T, us[:, : mechanism.nu]
    slopes = force_slopes(mechanism.actuators, own, actuator_lengths(mechanism, middle[:, :nq]), rates)
    own -= rates * (slopes.by_rate / np.where(slopes.gain == 0.0, 1.0, slopes.gain))
    return np.where(servos, us, 0.0)


def along_gait(dynamics: RigidBodyDynamics, xs: np.ndarray, weights: Mapping[str, Any]) -> dict[str, Any]:
    """Weights, by arguments of TrackingCost.joints, whose references are those of a gait with states xs (N+1, nx).

    Servos go along it, with the inertia of swinging legs. The reference of motors, whose controls are forces, stays as
    it is.
    """
    servos, control = servos_of(dynamics), weights.get("control", 0.0)
    if servos.any():
        control = np.where(servos, servo_reference(dynamics, xs, inertia=True), control)
    return {**weights, "reference": xs, "control": control}


def terminal_holding_cost(dynamics: RigidBodyDynamics, cost: TrackingCost, seconds: Any) -> TrackingCost:
    """A cost whose final weights include the cost-to-go of staying at its goal for a time.

    The cost is unchanged if the cost-to-go of the linearized machine diverges.

    Args:
        dynamics: The machine, with actuators.
        cost: Its last reference is the goal; its last running weights are those of staying.
        seconds: Time at the goal, s, at least 0; 0 gives the cost itself.

    Raises:
        PlannerError: seconds is negative or no number.
    """
    stages = round(number("hold", seconds, minimum=0.0) / dynamics.dt)
    if not stages:
        return cost
    goal, u = cost.x_ref[-1], quasi_static_controls(dynamics, cost.x_ref[-1])
    A, B = (part[0] for part in dynamics.linearize(np.stack([goal, goal]), u[None]))
    Q, R = cost.Q[-2], cost.R[-1]
    P = Q
    with np.errstate(all="ignore"):
        for _ in range(stages):
            PA, PB = P @ A, P @ B
            H, S = R + B.T @ PB, B.T @ PA
            if not (np.isfinite(H).all() and np.abs(P).max() < LARGEST):
                return cost
            P = Q + A.T @ PA - S.T @ np.linalg.solve(H, S)
            P = 0.5 * (P + P.T)
    rounding = np.abs(np.diagonal(P)) < np.finfo(float).eps * np.abs(P).max()  # of where a wheel is
    P[rounding] = P[:, rounding] = 0.0
    return TrackingCost(
        np.concatenate([cost.Q[:-1], [cost.Q[-1] + P]]), cost.R, cost.x_ref, cost.u_ref, cost.space
    )  # fmt: skip
