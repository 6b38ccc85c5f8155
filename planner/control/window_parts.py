"""Parts of a RecedingHorizonProblem: stages and rate, cost terms during and after the task, limits, and goals.

A goal is checked before it is aimed at: sizes, ranges of joints, clearances, and the reach of a frame, which is an
upper bound. A point on the axis of a hinge is fixed in both of its links. So no pose takes the frame farther from the
first axis than the lengths from axis to axis in sum, and the travel of slides. A goal within it may be out of reach
too: the machine then goes as near as its cost lets it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, count, number, numbers, short_repr
from planner.base.errors import PlannerError
from planner.control.control_laws import TIME_TOLERANCE
from planner.control.controller_states import Fault
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.assembly import with_joints
from planner.dynamics.protocol import integrator_of
from planner.dynamics.step_stability import implicit_error
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import space_of
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.costs.least_squares import LeastSquares, ResidualCost
from planner.problem.costs.residual_arrays import ResidualArrays
from planner.problem.costs.tracking import TrackingCost, states, tracking_of
from planner.problem.goals import terms_of
from planner.problem.limits import Limits
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.goal_regulator import hold_gain
from planner.solvers.other_guesses import DIVERGENCE_FACTOR

SETTLING_TIME = 0.5  # s, upper limit of sqrt(velocity weight / position weight) after the end of the task
WINDOW_ERROR = 1e-2  # ten times what a plan of the whole task may have, which no later one corrects
AIMED = "position of "
"""Name prefix of the frame goals that controller.goal can change (planner.problem.costs.frame)."""


def parts_of(problem: Problem) -> tuple[TrackingCost, list[ResidualCost], list[LeastSquares]]:
    """The TrackingCost of a problem, its compiled costs of residuals and those in Python; an error for other terms."""
    terms = terms_of(problem.cost)
    tracking = [term for term in terms if type(term) is TrackingCost]
    residuals = [term for term in terms if isinstance(term, ResidualCost)]
    python = [term for term in terms if isinstance(term, LeastSquares)]
    if len(tracking) != 1 or len(terms) != 1 + len(residuals) + len(python):
        others = sorted({type(term).__name__ for term in terms if type(term) not in (TrackingCost,)})
        raise PlannerError(
            f"the cost has {len(tracking)} TrackingCost and {', '.join(others) or 'nothing else'}, expected one "
            "TrackingCost, alone or with FrameCosts, PenaltyCosts and LeastSquares: a controller asks it for weights "
            "past its end."
        )
    return tracking[0], residuals, python


def window_dynamics(problem: Problem, states: np.ndarray) -> Any:
    """The dynamics of a window: with implicit damping in fewer substeps where the problem's need more than one.

    As few as change no entry of a stage's Jacobian by more than WINDOW_ERROR at some states (K, nx): what a plan of a
    window misses, the next one sees. Machines that touch keep their own.
    """
    own = problem.dynamics
    if type(own) is not RigidBodyDynamics or own.mechanism.has_closed_chains or capabilities_of(own).contacts:
        return own
    evaluations = own.substeps * integrator_of(own).stages
    for k in (1, 2, 4, 8):
        if 2 * k >= evaluations or own.substeps == 1:
            break
        if implicit_error(own.mechanism, own.dt, states, own.prescribed, k) <= WINDOW_ERROR:
            return RigidBodyDynamics(own.mechanism, own.dt, "rosenbrock", own.prescribed, k)
    return own


class SlidingLeastSquares:
    """A LeastSquares over the task and H stages after it, of which windows are parts; there weighed as `lengthened`."""

    def __init__(self, cost: LeastSquares, H: int, dt: float, keeps: bool) -> None:
        N, self._cost, self._H, self._keeps = cost.N, cost, H, keeps
        self._N, at = N, np.minimum(np.arange(N + H + 1), N)
        weight, off = cost.weight[at], (cost.weight[at] == 0.0) & (cost.weight[-1] > 0.0)
        weight[N + 1 - cost.of_controls :] = keeps * (cost.weight[N - 1] + dt * cost.weight[N])
        self._tables = weight, *(np.where(off, side[-1], side[at]) for side in (cost.lower, cost.upper))
        self.window = self.at(0)

    def at(self, stage: int) -> LeastSquares:
        """The cost of the window that begins at a stage."""
        weight, lower, upper = (table[stage : stage + self._H + 1].copy() for table in self._tables)
        if self._cost.of_controls or self._keeps or stage + self._H <= self._N:
            weight[-1] = self._cost.weight[-1]
        return self._cost.with_tables(weight, lower, upper)

    def slide(self, stage: int) -> None:
        """Move the window to a stage."""
        now = self.at(stage)
        self.window.weight, self.window.lower, self.window.upper = now.weight, now.lower, now.upper


def lengthened(measures: ResidualArrays, H: int, dt: float, keeps: bool) -> ResidualArrays:
    """Residuals of the task and H stages after it, there with weights of stage N-1 plus dt times final ones, or 0."""
    N = measures.weight.shape[1] - 1
    longer = measures.along(np.minimum(np.arange(N + H + 1), N))
    weight, bound = np.array(longer.weight), np.array(longer.bound)
    weight[:, N + 1 :] = keeps * (measures.weight[:, N - 1] + dt * measures.weight[:, N])[:, None]
    # A window that ends before the task has the final goal at its end, whose components have weight zero there.
    off = (longer.weight == 0.0) & (measures.weight[:, -1:] > 0.0)
    bound = np.where(off, measures.bound[:, -1:], bound)
    return replace(longer, weight=weight, bound=bound)


def at_stages(measures: ResidualArrays | None, stages: slice) -> ResidualArrays:
    """The residuals at a slice of the stages."""
    assert measures is not None
    part = measures.along(stages)
    return ResidualArrays(**{f.name: np.array(getattr(part, f.name)) for f in fields(ResidualArrays)})


def frame_rows(residuals: list[ResidualCost], N: int) -> dict[str, np.ndarray]:
    """Indices (3,) of each frame's position components in the joined residuals, by the frame's name."""
    found, first = dict[str, np.ndarray](), 0
    for cost in residuals:
        for name, rows in cost.goal_rows().items():
            if name.startswith(AIMED):
                frame = name.removeprefix(AIMED)
                found[frame] = np.concatenate([found.get(frame, np.zeros(0, dtype=int)), first + rows])
        first += len(cost.residual_arrays_for(N).weight)
    return {frame: rows for frame, rows in found.items() if len(rows) == 3}


def first_stages(limits: Limits | None, H: int, N: int) -> Limits | None:
    """Limits of the window at stage 0: control bounds (N, nu) per stage become those of its H stages."""
    if limits is None or isinstance(limits.control, (str, Mapping)) or not isinstance(limits.control, (tuple, list)):
        return limits
    at = np.minimum(np.arange(H), N - 1)
    sides = [np.asarray(side, dtype=float)[at] if np.ndim(side) == 2 else side for side in limits.control]
    return replace(limits, control=tuple(sides))


def holding_stage_weights(Q: np.ndarray) -> np.ndarray:
    """Stage weights (ndx, ndx) that regulate a goal, from weights Q (ndx, ndx) for the end of the task.

    With position weight q and velocity weight v, a robot with strong motors converges as exp(-t sqrt(q / v)). So a
    velocity weight is at most q SETTLING_TIME^2.
    """
    ndx = len(Q)
    q, v = np.split(np.diag(Q)[: ndx // 2 * 2], 2)
    factor, both = np.ones(ndx), (q > 0.0) & (v > 0.0)
    factor[len(q) : 2 * len(q)][both] = np.minimum(1.0, SETTLING_TIME * np.sqrt(q[both] / v[both]))
    return Q * factor[:, None] * factor


def updated_rows(problem: Problem) -> tuple[ConstraintStack | None, np.ndarray]:
    """The constraints with updated multipliers, and their columns among ranges and constraints, ranges included."""
    kept = problem.trajectory_constraints
    if kept is None:
        return None, np.zeros(0, dtype=int)
    ranges = 0 if problem.ranges is None else len(problem.ranges.component)
    columns = [np.arange(ranges)]
    if kept.rows is None:
        return None, columns[0]
    rows, which = kept.rows.subset(
        [part for part in kept.rows.parts if not isinstance(part.function, PairClearanceFunction)]
    )
    return (rows if rows.parts else None), np.concatenate([*columns, ranges + which])


def goal_states(problem: Problem, goal: Any, horizon: int) -> np.ndarray:
    """The state (nx,) of a goal: a keyframe's name, positions (nq,), a table of joints or a state; or states (H+1, nx).

    Joints that a table does not name are where the problem's own goal has them; `horizon` is H.
    """
    mechanism, space = capabilities_of(problem.dynamics).mechanism, space_of(problem.dynamics)
    if isinstance(goal, str):
        if mechanism is None:
            raise PlannerError(f"goal is {short_repr(goal)}, expected a state: the machine has no keyframes.")
        return mechanism.keyframe(goal)
    if isinstance(goal, Mapping):
        own = tracking_of(problem.cost)
        if mechanism is None or own is None:
            raise PlannerError("goal is a table of joints, expected a state: the machine has no joints with names.")
        return states("goal", with_joints("goal", goal, mechanism, own.x_ref[-1]), space, ())
    if mechanism is not None and np.shape(goal) == (mechanism.nq,) != (space.nx,):
        goal = np.concatenate([numbers("goal", goal), np.zeros(space.nx - mechanism.nq)])
    return states("goal", goal, space, () if np.ndim(goal) < 2 else (horizon + 1,))


def is_of_frames(problem: Problem, goal: Any, frames: Collection[str] = ()) -> bool:
    """Whether a goal is a table of frames: it has positions, whose three numbers no joint has.

    So is one with other lists for `frames` of which no joint has the name: positions that are to be refused.
    """
    if not isinstance(goal, Mapping):
        return False
    mechanism = capabilities_of(problem.dynamics).mechanism
    frames = set(frames).difference(() if mechanism is None else mechanism.joint_names)
    return any(_is_position(at) or (frame in frames and np.ndim(at) > 0) for frame, at in goal.items())


def _is_position(at: Any) -> bool:
    try:
        return np.shape(at)[-1:] == (3,)
    except ValueError:  # a list of unequal lists, which is refused as a position
        return True


def goal_stays(problem: Problem) -> bool:
    """Whether some control makes the goal an equilibrium; True for goals of frames or without a final weight."""
    goal = tracking_of(problem.cost)
    frames = any(isinstance(one, ResidualCost) and one.goal_rows() for one in terms_of(problem.cost))
    if goal is None or frames or not np.any(goal.Q[-1]):
        return True
    try:
        hold_gain(problem)
    except PlannerError:
        return False
    return True


def horizon_and_rate(problem: Problem, horizon: int | None = None, rate: float | None = None) -> tuple[int, float]:
    """Number of stages and rate, Hz, of a controller; a PlannerError for invalid arguments, or a cost without a window.

    It solves nothing, so that what is wrong is said before any work.
    """
    if not isinstance(problem, Problem):
        more = "; write Controller(plan.problem, plan=plan)" if isinstance(problem, Plan) else ""
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem{more}.")
    if problem.objective is not None and "time" in problem.objective.weights:
        raise PlannerError(
            "the objective has time, and a controller keeps the duration: expected another objective, and the duration "
            "that `planner solve` finds."
        )
    parts_of(problem)
    dt = problem.dynamics.dt
    H = problem.N if horizon is None else count("horizon", horizon, maximum=LONGEST_HORIZON)
    rate = 1.0 / dt if rate is None else number("rate", rate, greater_than=0.0)
    if rate * dt > 1.0 + 1e-9:
        raise PlannerError(
            f"the rate is {rate:.6g} Hz and the horizon has stages of {dt:.4g} s, expected at most one plan per "
            f"stage, {1.0 / dt:.6g} Hz, or a problem with dt = {1.0 / rate:.4g}; in between the gains act."
        )
    if rate * H * dt < 1.0 - 1e-9:
        raise PlannerError(
            f"the rate is {rate:.4g} Hz and a plan ends after {H * dt:.4g} s, expected at least "
            f"{1.0 / (H * dt):.4g} Hz, or a longer horizon."
        )
    return H, rate


def state_after(problem: Problem, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
    """The state (nx,) after `seconds` of constant control u (nu,) from x (nx,), by the problem's dynamics."""
    left, dt = seconds, problem.dynamics.dt
    while left > TIME_TOLERANCE * dt:
        whole = left >= dt * (1.0 - TIME_TOLERANCE)  # the usual one, and faster without a length of its own
        x = problem.dynamics.step(x[None], u[None], None if whole else np.array([left]))[0]
        left -= dt
    return x


def goal_fault(problem: Problem, goal: np.ndarray | Mapping[str, Any]) -> Fault | None:
    """What is wrong with a goal, states (..., nx) or a table of frames with positions (..., 3), m; or None."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if isinstance(goal, Mapping):
        for frame, places in goal.items():
            center, most = reach(mechanism, str(frame)) if mechanism is not None else (np.zeros(3), math.inf)
            if not np.abs(places).max() < DIVERGENCE_FACTOR:
                return Fault.GOAL_SIZE
            if np.linalg.norm(np.asarray(places) - center, axis=-1).max() > most:
                return Fault.GOAL_REACH
        return None
    if not np.abs(goal).max() < DIVERGENCE_FACTOR:
        return Fault.GOAL_SIZE
    xs, ranges, kept = np.atleast_2d(goal), problem.ranges, problem.trajectory_constraints
    if ranges is not None:
        columns, stage = slice(0, len(ranges.component) - ranges.at_end), -1 if problem.N == 1 else -2
        e = ranges.space.difference(xs, ranges.reference[-1])[:, ranges.component][:, columns]
        shift = ranges.space.difference(ranges.reference[stage], ranges.reference[-1])[ranges.component][columns]
        below, above = ranges.lower[stage, columns] + shift - e, e - ranges.upper[stage, columns] - shift
        tolerance = 0.0 if kept is None else kept.tolerance
        if np.any(np.maximum(below, above) > tolerance):
            return Fault.GOAL_RANGE
    for part in () if kept is None or kept.rows is None else kept.rows.parts:
        function = part.function
        if isinstance(function, PairClearanceFunction):
            us, n = np.zeros((len(xs), problem.dynamics.nu)), np.arange(len(xs))
            if np.any(function.values(xs, us, n) < 0.0):
                return Fault.GOAL_COLLIDES
    return None


def reach(mechanism: Mechanism, frame: str) -> tuple[np.ndarray, float]:
    """A fixed point (3,) of the world, m, and an upper bound of the frame's distance from it, m; infinite for balls."""
    own, length = mechanism.frame(frame), 0.0
    before: np.ndarray | None = None  # point of the last axis, in the frame of its link
    center = own.T[:3, 3]
    for i in chain_of(mechanism.parent, own.link)[::-1]:
        w, v = mechanism.S[i, :3], mechanism.S[i, 3:]
        hinge = float(w @ w) > 0.0
        if mechanism.kind[i] != SCREW:
            return center, math.inf
        point = np.cross(w, v) / (w @ w) if hinge else np.zeros(3)
        at = mechanism.T_home[i, :3, :3] @ point + mechanism.T_home[i, :3, 3]
        if before is None:
            center = at
        else:
            length += float(np.linalg.norm(at - before))
        if not hinge:
            length += float(np.abs(mechanism.joint_range[i] - mechanism.q_home[i]).max() * np.linalg.norm(v))
        before = point
    return center, length + (0.0 if before is None else float(np.linalg.norm(own.T[:3, 3] - before)))
