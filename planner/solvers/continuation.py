"""Continuation: follow the plans of a family of problems from an easy member to the one that is asked for.

A family is a function of s >= 0: problem_at(0) is the asked problem, a larger s an easier one. From a plan at some s,
until s = 0:

    predict    states and controls, linear in s through the last two plans
    correct    solve problem_at(s) from there, by multiple shooting where a rollout does not follow the prediction
    step       longer after a quick solve; shorter where the plan misses its goal: it fell off its branch

(Allgower and Georg, Numerical Continuation Methods, 1990, sections 2 and 6). The families have a factor f, the problem
itself at f = 1.

WiderLimits has

    lower - (f - 1) room <= u <= upper + (f - 1) room

of the bounds of controls, of servos' forces, and of the ranges of states. The room is half of the width between two
bounds. A bound without an opposite one has room for the plan of the free problem at the factor at which all others have
it. Exact goals and constraints stay as they are. At f = inf the problem is free.

    SofterContacts      K / f,          B / sqrt(f),    f a        of every contact
    DistantContacts     K min(1, 8/f),  as stiff,       f a        of what is driven with what is not

of the stiffness, the damping and the ramp. A hard contact is nearly a switch, about which the LQ problem knows nothing
until it happens. On softer ones a machine at rest sinks f times as deep, its bounces keep their damping ratio, and the
force ramp is the same: there is a gradient over a longer part of the way, and the plan takes off and lands as the hard
one does. An object that is never touched has no gradient at all. The law's surface is half a ramp above the body's, so
a long ramp is a force at a distance: it begins at f a / 2, and is K a where the surfaces touch. (Mordatch, Todorov and
Popovic 2012 have both; Posa, Cantu and Tedrake 2014 relax the complementarity instead.) Stops of joints and friction
stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from planner.dynamics.contacts import body_contact_forces, contact_forces
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.capabilities import roots
from planner.model.contact.body_contact import BodyContact
from planner.problem.initial_guess import Trajectory
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.solvers.gains import with_contacts

FALL_ITERATIONS, FALL_SHARE = 10, 0.02  # a solve whose cost falls by this share in so many iterations goes on
BETTER_SHARE = 0.5  # of the cost of the plan before: a solve that is cheaper by it has found a better branch

# One solve from a trajectory, or from the problem's first guess for None, with an iteration limit.
SolveFrom = Callable[[Problem, Trajectory | None, int], Plan]
MIN_FREE_FACTOR = 2.0  # factor at which bounds without an opposite one admit the free plan, if no other says more
SMOOTHER = 100.0  # of friction loss, which of legs is full from 0.02 rad/s on, where a leap has 20
SOFT_FACTOR = 10.0  # of the depth that contacts sink in, at which a continuation in the contact begins
REACH = 2.0  # distance at which a force at a distance begins, over the gap at the start


class RelaxationStep(NamedTuple):
    """One solve of a relaxation."""

    number: int  # Counted from 0
    # "direct", "collision-free", "tracked", "held", "line", "shaken" (see solvers.other_guesses), "distance",
    # "friction", "contacts", "resumed", "free", "limits", "swing" or "duration"
    stage: str
    factor: float  # By which contacts sink deeper, or limits are wider; inf without limits
    duration: float  # s
    cost: float
    iterations: int
    status: Status
    meets_goal: bool  # Whether it was kept, so that the next solve starts from it

    def __str__(self) -> str:
        row = (
            f"{self.number:5d}  {self.stage:14s}  {self.factor:7.4g}  {self.duration:11.5g}  {self.cost:15.8g}  "
            f"{self.iterations:10d}  {self.status.name}{'' if self.meets_goal else ', not kept'}"
        )
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The heading of the table of str(); part of the first row."""
        columns = f"{'factor':>7}  {'duration, s':>11}  {'cost':>15}  {'iterations':>10}  status"
        return f"{'relax':>5}  stage           {columns}"


@dataclass(frozen=True)
class Continuation:
    """A family of problems, and how to follow its plans.

    Attributes:
        problem_at: The problem at s.
        solve: One solve.
        meets_goals: Whether a plan, converged or not, meets the goals of its problem.
        report: Called with s, the plan of each solve and whether it was kept.
        max_solves: Limit of the solves of one call.
        look_iterations: Number of iterations after which a solve goes on only if its cost is falling, its plan meets
            the goals, or it costs less than the plan before by BETTER_SHARE.
        max_iterations: Limit of those that it goes on with: a plan that has converged predicts the next one better.
        min_step: Smallest step of s.
        first_share: First step over s.
        growth: Ratio of a step to the one before it, after a quick solve.
        min_share: Smallest step over s: below it a branch ends far from the asked problem.
    """

    problem_at: Callable[[float], Problem]
    solve: SolveFrom
    meets_goals: Callable[[Plan], bool]
    report: Callable[[float, Plan, bool], object]
    max_solves: int = 16
    look_iterations: int = 60
    max_iterations: int = 1000
    min_step: float = 0.01
    first_share: float = 0.5
    growth: float = 1.5
    min_share: float = 0.1

    def run(self, s: float, plan: Plan) -> tuple[float, Plan]:
        """The smallest s that was reached from a plan at s, and its plan: at 0 the one of the asked problem."""
        before: tuple[float, Plan] | None = None
        step = max(self.first_share * s, self.min_step)
        for _ in range(self.max_solves):
            if s == 0.0 or step < max(self.min_step, self.min_share * s):
                break
            to = s - step if s - step >= self.min_step else 0.0
            better = plan.cost - BETTER_SHARE * abs(plan.cost)
            found, kept = self._corrected(to, _predicted(to, s, plan, before), better)
            if kept:
                before = (s, plan) if plan.converged else None  # a plan on its way predicts nothing
                s, plan = to, found
                step = min(self.growth * step, s) if found.nit < self.look_iterations else min(step, s)
            else:
                step = 0.4 * min(step, s)
        return s, plan

    def _corrected(self, s: float, guess: Trajectory, better: float) -> tuple[Plan, bool]:
        """The plan at s from a predicted trajectory, and whether it meets its goals; at s = 0 it must converge too.

        It goes on also where its cost is below `better`: it has left the branch for one that is worth its iterations.
        """
        problem = self.problem_at(s)
        plan = self.solve(problem, guess, self.look_iterations)
        for _ in range(self.max_iterations // self.look_iterations):
            if not (plan.status is Status.MAX_ITERATIONS and _is_falling(plan)):
                break
            self.report(s, plan, True)
            plan = self.solve(problem, plan.motion, self.look_iterations)
        if plan.status is Status.MAX_ITERATIONS and (self.meets_goals(plan) or plan.cost < better):
            self.report(s, plan, True)
            plan = self.solve(problem, plan.motion, self.max_iterations)
        kept = self.meets_goals(plan) and (s > 0.0 or plan.converged)
        self.report(s, plan, kept)
        return plan, kept


def _is_falling(plan: Plan) -> bool:
    """Whether the last FALL_ITERATIONS of a solve have reduced its cost by more than FALL_SHARE of it."""
    return plan.nit > FALL_ITERATIONS and plan.history[-FALL_ITERATIONS].cost - plan.cost > FALL_SHARE * abs(plan.cost)


def _predicted(to: float, s: float, plan: Plan, before: tuple[float, Plan] | None) -> Trajectory:
    """The trajectory of a plan at s, extrapolated to another s through the plan before it."""
    motion = plan.motion
    if before is None:
        return motion
    ahead, space = (to - s) / (s - before[0]), motion.space
    change = space.difference(motion.xs, before[1].xs)
    return replace(
        motion, xs=space.integrate(motion.xs, ahead * change), us=motion.us + ahead * (motion.us - before[1].us)
    )


@dataclass(frozen=True, eq=False)
class WiderLimits:
    """A problem, and how far its free plan is beyond its limits.

    Attributes:
        problem: With bounds of its controls or ranges of its states.
        factor: At which the limits admit the free plan; 1 or less where it is within them.
        controls: (2, N, nu) excess of the free plan's controls below their lower and above their upper bounds.
        states: (2, N+1, H) the same of the ranges of its states.
    """

    problem: Problem
    factor: float
    controls: np.ndarray | None
    states: np.ndarray | None

    @classmethod
    def around(cls, problem: Problem, free: Plan) -> WiderLimits:
        """The family of a problem for its free plan."""
        controls = states = None
        factors = [0.0]
        if problem.bounds is not None:
            controls, factor = _beyond(free.us, *problem.bounds.at(slice(None), free.xs[:-1]))
            factors.append(factor)
        if problem.ranges is not None:
            ways = slice(0, len(problem.ranges.component) - problem.ranges.at_end)  # without exact goals
            sides = (side[:, ways] for side in (problem.ranges.lower, problem.ranges.upper))
            states, factor = _beyond(problem.ranges.deviations(free.xs)[:, ways], *sides)
            factors.append(factor)
        one_sided = any(part is not None and part.any() for part in (controls, states))
        return cls(problem, max(*factors, MIN_FREE_FACTOR if one_sided else 0.0), controls, states)

    def at(self, factor: float) -> Problem:
        """The problem with limits `factor` times as wide; the problem itself at 1."""
        if factor == 1.0:
            return self.problem
        bounds, ranges, more = self.problem.bounds, self.problem.ranges, factor - 1.0
        scale = more / max(self.factor - 1.0, 1.0)  # of excess, which is room at the free plan's factor
        if bounds is not None:
            lower, upper = _wider(bounds.lower, bounds.upper, more, self.controls, scale)
            servos = bounds.servos
            if servos is not None:
                low, high = _wider(servos.low, servos.high, more, None, scale)
                servos = replace(servos, low=low, high=high)
            bounds = None if np.isinf(factor) else replace(bounds, lower=lower, upper=upper, servos=servos)
        if ranges is not None:
            ways = len(ranges.component) - ranges.at_end
            lower, upper = ranges.lower.copy(), ranges.upper.copy()
            lower[:, :ways], upper[:, :ways] = _wider(
                ranges.lower[:, :ways], ranges.upper[:, :ways], more, self.states, scale
            )
            ranges = replace(ranges, lower=lower, upper=upper) if np.isfinite([lower, upper]).any() else None
        return self.problem.with_bounds(bounds, ranges)


def free_problem(problem: Problem) -> Problem:
    """The problem without bounds of its controls and ranges of its states; exact goals and constraints stay."""
    return WiderLimits(problem, 1.0, None, None).at(np.inf)


def at_limits(problem: Problem, plan: Plan) -> bool:
    """Whether a plan is at a bound of its controls or of a range of its states, or beyond."""
    return share_at_limits(problem, plan) > 0.0


def share_at_limits(problem: Problem, plan: Plan) -> float:
    """The share of the stages in which a plan is at a bound of a control or of a range of a state, or beyond."""
    acts, ranges = np.zeros(plan.N, dtype=bool), problem.ranges
    if problem.bounds is not None:
        acts |= problem.bounds.at_bound(plan.xs, plan.us).any(axis=1)
    if ranges is not None:
        ways = len(ranges.component) - ranges.at_end
        assert problem.trajectory_constraints is not None  # of the ranges
        acts |= ranges.at_bound(plan.xs, problem.trajectory_constraints.tolerance)[1:, :ways].any(axis=1)
    return float(acts.mean())


def _beyond(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, float]:
    """(2, M, K) excess of values (M, K) beyond bounds without an opposite one, and the factor of all others."""
    with np.errstate(invalid="ignore", divide="ignore"):
        half = 0.5 * (upper - lower)
        two_sided = np.isfinite(half) & (half > 0.0)
        factors = np.where(two_sided, np.abs(values - 0.5 * (lower + upper)) / half, 0.0)
    excess = np.stack([lower - values, values - upper])
    excess = np.where(two_sided, 0.0, excess.max(axis=1, initial=0.0)[:, None])
    return excess, float(factors.max(initial=0.0))


def _wider(
    lower: np.ndarray, upper: np.ndarray, more: float, excess: np.ndarray | None, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds moved outwards by `more` times half of their width; those without an opposite by `scale` times excess."""
    with np.errstate(invalid="ignore"):
        half = 0.5 * (upper - lower)
        room = np.where(np.isfinite(half), more * half, 0.0)
    if np.isinf(more):
        return np.full_like(lower, -np.inf), np.full_like(upper, np.inf)
    below, above = (0.0, 0.0) if excess is None else scale * excess
    return lower - room - below, upper + room + above


@dataclass(frozen=True, eq=False)
class SofterContacts:
    """A problem of a rigid-body machine with contacts, which sink `factor` times as deep at first."""

    problem: Problem
    factor: float = SOFT_FACTOR

    def at(self, factor: float) -> Problem:
        """The problem with contacts that sink `factor` times as deep; the problem itself at 1."""

        def softer(one: Any) -> Any:
            return replace(one, law=_softened(one.law, factor, factor))

        if factor == 1.0:
            return self.problem
        return replace(self.problem, dynamics=with_contacts(self.problem.dynamics, softer, softer), recipe=None)


def _softened(law: Any, softer: float, longer: float) -> Any:
    """A law that is `softer` times as soft, with a ramp `longer` times as long."""
    stiffness, damping = law.stiffness / softer, law.damping / math.sqrt(softer)
    return replace(law, stiffness=stiffness, damping=damping, ramp=law.ramp * longer)


def with_smoother_friction(problem: Problem) -> Problem:
    """The problem with friction loss that is full only at SMOOTHER times the speed: a damper, not a kink, below."""
    dynamics: Any = problem.dynamics
    mechanism = replace(dynamics.mechanism, friction_inertia=np.array(dynamics.mechanism.friction_inertia) / SMOOTHER)
    return replace(problem, dynamics=dynamics.with_mechanism(mechanism), recipe=None)


@dataclass(frozen=True, eq=False)
class DistantContacts:
    """A problem whose machine is to move objects that no actuator drives, and begins apart from some of them."""

    problem: Problem

    def at(self, factor: float) -> Problem:
        """The problem with ramps `factor` times as long between what is driven and objects; the problem itself at 1."""

        def longer(pair: BodyContact) -> BodyContact:
            if pair not in self._pushing:
                return pair
            # half a ramp deep the force is an eighth of K a
            return replace(pair, law=_softened(pair.law, max(1.0, factor / 8.0), factor))

        if factor == 1.0:
            return self.problem
        dynamics = with_contacts(self.problem.dynamics, lambda plane: plane, longer)
        return replace(self.problem, dynamics=dynamics, recipe=None)

    @cached_property
    def factor(self) -> float:
        """The factor at which every object feels what may push it at the start; 1 where all is in touch."""
        return max((2.0 * REACH * gap / pair.law.ramp for pair, gap in self._pushing.items()), default=1.0)

    def touches(self, xs: np.ndarray) -> bool:
        """Whether the machine pushes an object at some state of xs (K, nx)."""
        dynamics: Any = self.problem.dynamics
        mechanism = dynamics.mechanism
        forces = body_contact_forces(mechanism, xs[:, : mechanism.nq], xs[:, mechanism.velocities]).forces
        return any(forces[:, k].any() for k, pair in enumerate(mechanism.body_contacts) if pair in self._pushing)

    def concerns(self, error: Callable[[np.ndarray], np.ndarray]) -> bool:
        """Whether an error (K,) of states (K, nx) depends on objects alone, by small changes of the start."""
        dynamics: Any = self.problem.dynamics
        mechanism, x0, root = dynamics.mechanism, self.problem.x0, roots(dynamics.mechanism)
        driven = np.isin(root, root[mechanism.directly_actuated])
        changes = np.zeros((mechanism.nv + 1, mechanism.space.ndx))
        changes[np.arange(mechanism.nv), np.arange(mechanism.nv)] = 1e-3
        values = error(mechanism.space.integrate(np.tile(x0, (len(changes), 1)), changes))
        moves = np.abs(values[:-1] - values[-1]) > 1e-9
        return bool(moves[~driven].any() and not moves[driven].any())

    @cached_property
    def _pushing(self) -> dict[BodyContact, float]:
        """Smooth contacts of a driven tree with one that is not, and their gaps at the start, m, 0 in touch."""
        if not has_softer(self.problem):
            return {}
        dynamics: Any = self.problem.dynamics
        mechanism, x0 = dynamics.mechanism, self.problem.x0
        root = roots(mechanism)
        driven = set(root[mechanism.directly_actuated].tolist())
        depths = body_contact_forces(mechanism, *np.split(x0[: mechanism.nq + mechanism.nv], [mechanism.nq])).depths
        pushing = {}
        for pair, depth in zip(mechanism.body_contacts, depths, strict=True):
            trees = [int(root[part.link]) in driven for part in (pair.first, pair.second) if part.link >= 0]
            if sorted(trees) == [False, True] and pair.law.ramp > 0.0:
                pushing[pair] = max(0.0, -float(depth))
        return pushing


def has_softer(problem: Problem) -> bool:
    """Whether a problem has contacts that can be made softer."""
    dynamics = problem.dynamics
    return isinstance(dynamics, RigidBodyDynamics) and bool(
        dynamics.mechanism.contacts or dynamics.mechanism.body_contacts
    )


def stays_on_feet(problem: Problem, xs: np.ndarray) -> bool:
    """Whether each body that planes carry at some knot of xs (N+1, nx) is carried at all, and no bodies may touch."""
    if not has_softer(problem):
        return False
    dynamics: Any = problem.dynamics
    mechanism = dynamics.mechanism
    q, qd = np.split(xs[:, : mechanism.nq + mechanism.nv], [mechanism.nq], axis=1)
    pressed = np.any(contact_forces(mechanism, q, qd).forces, axis=2)  # (N+1, contacts)
    links = np.array([contact.link for contact in mechanism.contacts])
    loaded = np.array([pressed[:, links == link].any(axis=1) for link in np.unique(links)])
    return not mechanism.body_contacts and bool(np.all(loaded.all(axis=1) == loaded.any(axis=1)))
