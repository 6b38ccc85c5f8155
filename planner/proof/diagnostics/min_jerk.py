"""The smooth motion from start to goal, a polynomial of fifth order, and what its actuators give for it.

It is known where every joint is a hinge or a slide and has an actuator, and where start and goal are at rest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.model.actuators import DIRECT
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.costs.tracking import tracking_of
from planner.problem.initial_guess import quintic
from planner.problem.problem import Problem


class MinJerkMotion(NamedTuple):
    """In the middle of every stage; forces are those of the actuators."""

    q: np.ndarray  # (N, nq)
    qd: np.ndarray  # (N, nv)
    forces: np.ndarray  # (N, nu)
    bias: np.ndarray  # (N, nu) of the forces, without a control

    def controls(self, machine: Mechanism) -> np.ndarray:
        """(N, nu)."""
        gain = machine.actuators.gain
        return (self.forces - self.bias) / np.where(gain == 0.0, np.inf, gain)


def machine_of(problem: Problem) -> Mechanism | None:
    """The mechanism of a problem whose smooth motion is known; else None."""
    dynamics, cost = problem.dynamics, tracking_of(problem.cost)
    if not isinstance(dynamics, RigidBodyDynamics) or dynamics.prescribed or cost is None:
        return None
    machine = dynamics.mechanism
    moving = slice(machine.nq, machine.nq + machine.nv)
    ends = np.concatenate([problem.x0[moving], cost.x_ref[-1][moving]])
    whole = np.all(machine.kind == SCREW) and not np.any(machine.actuators.dynamics != DIRECT)
    if not whole or machine.nq != machine.nv or machine.contacts or machine.body_contacts or np.any(ends):
        return None
    return machine if np.linalg.matrix_rank(machine.actuators.moment) == machine.nv else None


def smooth_motion(problem: Problem, machine: Mechanism, duration: float) -> MinJerkMotion:
    """The motion in this duration, with as many stages as the problem has."""
    cost, acts = tracking_of(problem.cost), machine.actuators
    assert cost is not None  # machine_of() asked
    q, qd, qdd = quintic(problem.x0[: machine.nq], cost.x_ref[-1][: machine.nq], duration, problem.N)
    forces = np.linalg.lstsq(acts.moment.T, rnea(machine, q, qd, qdd).T, rcond=None)[0].T
    bias = acts.bias[:, 0] + acts.bias[:, 1] * (q @ acts.moment.T) + acts.bias[:, 2] * (qd @ acts.moment.T)
    return MinJerkMotion(q, qd, forces, bias)
