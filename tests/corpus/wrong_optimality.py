"""Wrong plans: a gradient that vanishes where there is no minimum, and numbers that a finer step changes entirely."""

from dataclasses import replace

import numpy as np

import planner
from corpus import machines
from corpus.asking import reach
from corpus.machines import arm
from corpus.planting import Rng
from corpus.wrong_between import siblings
from planner import FrameCost, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost, cases
from planner.contact import ContactLaw
from planner.problem.costs.terms import Quadratic, Term


class Effort(Term):
    """An own cost whose quadratize() is not that of its value(): another reference, or another weight."""

    def __init__(self, weight: float, wrong: float, reference: float, n: int) -> None:
        self.weight, self.wrong, self.reference, self.n = weight, wrong, reference, n

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The running cost."""
        return 0.5 * self.weight * float(np.sum((xs[:-1, : self.n] - self.reference) ** 2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Of another one."""
        (N, nu), ndx = us.shape, xs.shape[1]
        Q, q = np.zeros((N + 1, ndx, ndx)), np.zeros((N + 1, ndx))
        Q[:-1, range(self.n), range(self.n)] = self.wrong
        q[:-1, : self.n] = self.wrong * xs[:-1, : self.n]
        return Quadratic(Q, q, np.zeros((N, nu, nu)), np.zeros((N, nu)))

    def resampled(self, parts: int, ratio: float) -> "Effort":
        """Of shorter stages."""
        return Effort(ratio * self.weight, ratio * self.wrong, self.reference, self.n)


def other_derivatives(rng: Rng) -> Plan:
    """At the minimum of what the derivatives belong to, so that the gradient is zero."""
    problem = reach(arm(rng, 2, gravity="0 0 0"), [0.8, -0.7], tolerance="soft")
    weight = planner.solve(problem).cost * rng.uniform(0.1, 1.0)
    wrong = weight * rng.choice([0.0, rng.uniform(0.1, 0.5)])
    told = planner.solve(replace(problem, cost=problem.cost + Effort(wrong, wrong, 0.0, 2)))
    own = Effort(weight, wrong, rng.uniform(0.5, 1.5), 2)
    return planner.solve(replace(problem, cost=problem.cost + own, us=told.us))


siblings("an own cost whose derivatives are another's", other_derivatives)


def farthest(rng: Rng) -> Plan:
    """The hand is held where it is farthest from its goal: a stationary point, and the worst of all."""
    joints = int(rng.integers(1, 4))
    m = Mechanism.from_mjcf(arm(rng, joints, gravity="0 0 0", joint=lambda i: 'damping="0.3"'))
    dynamics = RigidBodyDynamics(m, 0.02)
    still = TrackingCost.joints(dynamics, m.home, 50, effort=rng.uniform(0.001, 0.01), final_velocity=1.0)
    there = FrameCost(dynamics, "hand", position=[-rng.uniform(0.3, 0.9), 0.0, 0.0], final_position_weight=300.0)
    return planner.solve(Problem(dynamics, still + there, m.home, us=np.zeros((50, joints)), tolerance="soft"))


siblings("a hand held farthest from its goal", farthest)


def untouched(rng: Rng) -> Plan:
    """What is to be pushed is out of the pusher's way: no control moves it, so the gradient is zero."""
    m = Mechanism.from_mjcf(machines.pusher(rng, rng.uniform(0.5, 2.0)), contacts=ContactLaw.resting(1.0))
    dynamics = RigidBodyDynamics(m, 0.01)
    goal = np.zeros(4)
    goal[m.joint("thing").start] = rng.uniform(0.1, 0.4)
    cost = TrackingCost.joints(dynamics, goal, 100, effort=0.01, final_position={"thing": 1e3}, final_velocity=1.0)
    return planner.solve(Problem(dynamics, cost, m.home, tolerance="soft"))


siblings("a thing that is never touched", untouched)


def unresolved(rng: Rng) -> Plan:
    """A two-link arm whirls, and in twenty steps a stage its controls cost something else, with its gains too."""
    problem = replace(cases.two_link(), tolerance="soft")
    while True:
        us = np.cumsum(rng.normal(size=problem.first_guess.shape), axis=0)
        plan = planner.solve(replace(problem, us=3.0 * us / np.sqrt(np.mean(us**2))))
        if not any(0.5 < _fine_cost(plan, K) / plan.cost < 2.0 for K in (0.0 * plan.K, plan.K)):
            return plan


def _fine_cost(plan: Plan, K: np.ndarray) -> float:
    """The cost in twenty steps a stage of the controls with gains K, which act at the knots."""
    dynamics, xs, us = plan.problem.dynamics, [plan.problem.x0], plan.us.copy()
    for n in range(plan.N):
        us[n] += K[n] @ (xs[-1] - plan.xs[n])
        x = xs[-1][None]
        for _ in range(20):
            x = dynamics.step(x, us[n : n + 1], np.array([dynamics.dt / 20]))
        xs.append(x[0])
    return plan.problem.cost.value(np.array(xs), us)


siblings("a two-link arm that whirls", unresolved)
