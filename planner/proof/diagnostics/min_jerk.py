"""The minimum-jerk trajectory from start to goal, a polynomial of fifth order, and its actuator forces.

It is defined where every joint is a hinge or slide joint with an actuator, and velocities are zero at start and goal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.dynamics.joint_forces import gains_at, passive_forces
from planner.model.actuators import DIRECT
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.costs.tracking import tracking_of
from planner.problem.initial_guess import quintic
from planner.problem.problem import Problem


class MinJerkMotion(NamedTuple):
    """Values at the middle of every stage; forces are those of the actuators."""

    q: np.ndarray  # (N, nq)
    qd: np.ndarray  # (N, nv)
    forces: np.ndarray  # (N, nu)
    bias: np.ndarray  # (N, nu) actuator forces at zero control
    gain: np.ndarray  # (N, nu) actuator forces per control

    @property
    def controls(self) -> np.ndarray:
        """(N, nu) controls that give the forces."""
        return (self.forces - self.bias) / np.where(self.gain == 0.0, np.inf, self.gain)


def machine_of(problem: Problem) -> Mechanism | None:
    """The mechanism of a problem with a minimum-jerk trajectory; else None."""
    dynamics, cost = problem.dynamics, tracking_of(problem.cost)
    if not isinstance(dynamics, RigidBodyDynamics) or dynamics.prescribed or cost is None:
        return None
    machine = dynamics.mechanism
    moving = machine.velocities
    ends = np.concatenate([problem.x0[moving], cost.x_ref[-1][moving]])
    whole = np.all(machine.kind == SCREW) and not np.any(machine.actuators.dynamics != DIRECT)
    if not whole or machine.nq != machine.nv or machine.contacts or machine.body_contacts or np.any(ends):
        return None
    moment = machine.actuators.moment  # of what acts at sites 0: its motion is not worth the poses' moments here
    return machine if np.linalg.matrix_rank(moment) == machine.nv else None


def smooth_motion(problem: Problem, machine: Mechanism, duration: float) -> MinJerkMotion:
    """The minimum-jerk trajectory of this duration, with the problem's number of stages."""
    cost, acts = tracking_of(problem.cost), machine.actuators
    assert cost is not None  # checked by machine_of()
    q, qd, qdd = quintic(problem.x0[: machine.nq], cost.x_ref[-1][: machine.nq], duration, problem.N)
    forces = np.linalg.lstsq(acts.moment.T, rnea(machine, q, qd, qdd).T, rcond=None)[0].T
    lengths, rates = q @ acts.moment.T, qd @ acts.moment.T
    return MinJerkMotion(q, qd, forces, passive_forces(acts, lengths, rates), gains_at(acts, lengths, rates))
