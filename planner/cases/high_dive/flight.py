"""Dive: the data of a flight, its cost, and first controls that turn the diver the right number of times.

    J = 1/2 (dx_N' F dx_N) + 1/2 sum dt (r |u|^2 + p s(t) |(q - q_mid) / half range|^2 + c |joint rates|^2)

F weighs the angles of pelvis and joints and the rates of the joints; s removes the posture term at both ends.

An orientation does not count turns: 1 1/2 somersaults with 1 twist end like 1/2 somersault with none, and the cost
measures the shortest rotation to the goal. So a homotopy sets the count: the goal starts where a stiff body arrives and
moves to its place by at most 0.6 rad per solve; each solve starts from the controls of the one before. These solves use
few stages; a rollout with the gains of the last one gives the first controls at the requested stages.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from planner.cases.high_dive.diver import Diver
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.model.space import exp_quaternion, product
from planner.problem.costs.tracking import TrackingCost
from planner.problem.initial_guess import rollout_states
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.slq import solve

OPENING = 0.35  # s, at most a quarter of the flight: the posture term grows after take-off and fades before entry

_STEP = 0.6  # rad between the goals of two solves: far below the half turn at which the shortest rotation changes
_STAGES, _ITERATIONS = 140, 25  # limits of the solves on the way, which need not converge
_LAST_ITERATIONS = 100  # limit of the last solve, whose gains are used


@dataclass(frozen=True)
class Weights:
    """Weights of a dive; see high_dive()."""

    final: float
    rate: float
    effort: float
    posture: float
    calm: float


@dataclass(frozen=True)
class Dive:
    """A flight from take-off to entry."""

    diver: Diver
    up: float  # m/s, of the centre of mass at take-off
    ahead: float  # m/s, likewise
    rate: float  # rad/s, of the somersault at take-off
    duration: float  # s
    somersaults: float  # turns over the head, positive forward
    twists: float  # turns about the long axis, positive to the left
    weights: Weights

    @property
    def start(self) -> np.ndarray:
        """(nx,) at take-off."""
        return self.diver.take_off(self.up, self.ahead, self.rate)

    def entry(self, part: float = 1.0) -> np.ndarray:
        """Goal state (nx,) on the homotopy: where a stiff body arrives at part 0, the entry of the dive at 1.

        Only orientation and joints are goals; place and velocity of the pelvis follow from the fall.
        """
        x = self.diver.mechanism.keyframe("goal")
        stiff = self.rate * self.duration
        somersault = stiff + part * (2.0 * np.pi * self.somersaults - stiff)
        x[3:7] = turned(somersault, part * 2.0 * np.pi * self.twists)
        return x

    def cost(self, dynamics: RigidBodyDynamics, N: int, part: float = 1.0) -> TrackingCost:
        """The cost over N stages, with the goal entry(part)."""
        nq, nv = dynamics.mechanism.nq, dynamics.mechanism.nv
        ranges, weights = self.diver.ranges(), self.weights
        t = dynamics.dt * np.arange(N + 1)
        posture = np.zeros(2 * nv)
        posture[6:nv] = weights.posture / (0.5 * (ranges[:, 1] - ranges[:, 0])) ** 2
        calm = np.repeat([0.0, weights.calm], [nv + 6, nv - 6])
        Q = dynamics.dt * (self.carried(t)[:, None, None] * np.diag(posture) + np.diag(calm))
        Q[N] = np.diag(np.repeat([0.0, weights.final, 0.0, weights.rate], [3, nv - 3, 6, nv - 6]))
        x_ref = np.tile(self.entry(part), (N + 1, 1))
        x_ref[:N, 7:nq] = ranges.mean(axis=1)
        R = np.tile(dynamics.dt * weights.effort * np.eye(dynamics.nu), (N, 1, 1))
        return TrackingCost(Q, R, x_ref, space=dynamics.space)

    def carried(self, t: np.ndarray) -> np.ndarray:
        """Share (K,) of the posture weight at times t (K,): 0 at both ends, 1 between."""
        fade = min(OPENING, 0.25 * self.duration)
        s = np.clip(np.minimum(t, self.duration - t) / fade, 0.0, 1.0)
        return s * s * (3.0 - 2.0 * s)

    def first_controls(self, dynamics: RigidBodyDynamics, N: int) -> np.ndarray:
        """Controls (N, nu) that end near the goal after the right number of turns."""
        plan = turning_plan(self, min(N, _STAGES))
        space = dynamics.space
        stage = np.arange(N) * plan.N // N
        part = (np.arange(N) * plan.N / N - stage)[:, None]
        xs = space.integrate(plan.xs[stage], part * space.difference(plan.xs[stage + 1], plan.xs[stage]))
        us, x = plan.us[stage], self.start
        for n in range(N):
            us[n] += plan.K[stage[n]] @ space.difference(x, xs[n])
            x = dynamics.step(x[None], us[n : n + 1])[0]
        return us if np.isfinite(us).all() else plan.us[stage]


def turned(somersault: float, twist: float) -> np.ndarray:
    """Quaternion (4,) of an upright body turned about its lateral axis, then about its long axis, by angles in rad."""
    axes = np.array([[0.0, somersault, 0.0], [0.0, 0.0, twist]])
    return product(*exp_quaternion(axes))


@lru_cache(maxsize=8)
def turning_plan(dive: Dive, N: int) -> Plan:
    """Plan the dive over N stages by the homotopy of goals."""
    mechanism = dive.diver.mechanism
    dynamics = RigidBodyDynamics(mechanism, dive.duration / N, "rk4")
    us = _stiff_controls(dive, dynamics, N)
    way = 2.0 * np.pi * max(abs(dive.somersaults - dive.rate * dive.duration / (2.0 * np.pi)), abs(dive.twists))
    steps = max(1, int(np.ceil(way / _STEP)))
    for k in range(1, steps):
        problem = Problem(dynamics, dive.cost(dynamics, N, k / steps), x0=dive.start, us=us)
        us = solve(problem, max_iterations=_ITERATIONS).us
    return solve(Problem(dynamics, dive.cost(dynamics, N), x0=dive.start, us=us), max_iterations=_LAST_ITERATIONS)


def _stiff_controls(dive: Dive, dynamics: RigidBodyDynamics, N: int) -> np.ndarray:
    """Torques (N, nu) that hold every joint still, by inverse dynamics at the beginning of each stage."""
    mechanism = dynamics.mechanism
    held = RigidBodyDynamics(mechanism, dynamics.dt, prescribed=mechanism.joint_names[1:])
    still = np.zeros((N, held.nu))
    xs = rollout_states(held, dive.start, still)[:-1]
    nq, nv = mechanism.nq, mechanism.nv
    return rnea(mechanism, xs[:, :nq], xs[:, nq:], held.rates(xs, still)[:, nv:])[:, 6:]
