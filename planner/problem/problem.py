"""Problem: dynamics, cost, start and first guess (Eq. 9, 10), with all checks of their shapes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, array, count, number, short_repr
from planner.base.errors import PlannerError
from planner.base.measured import Section
from planner.dynamics import Dynamics, RigidBodyDynamics
from planner.dynamics.assembly import check_assembled
from planner.model.coordinates import coordinates_of
from planner.model.mjcf.prescribed_joints import twin_of
from planner.model.space import space_of
from planner.model.twin import Twin
from planner.problem.appearance import Appearance
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.constraints.trajectory_constraints import BoundPenalties, StateBounds, TrajectoryConstraints
from planner.problem.control_bounds import ControlBounds
from planner.problem.costs.terms import Cost, GoalSpec, Quadratic, check_cost, checked_tolerance
from planner.problem.costs.tracking import states, tracking_of
from planner.problem.limits import TOLERANCE, Limits
from planner.problem.problem_parts import Built, Objective, Periodic, Recipe
from planner.problem.stances import Stance


@dataclass(frozen=True)
class Requirements:
    """Rules for the proof of a built-in problem, in addition to the general ones or in place of them; all optional."""

    # (rng, K) -> random simulator states (K, nw) at which the twin's accelerations must equal the plan's dynamics.
    equal_states: Callable[[np.random.Generator, int], np.ndarray] | None = None
    # (xs (K, nx), us (K, nu)) -> (K, nx), the continuous dx/dt, reference of the parity check.
    rates: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    start: str = ""  # Keyframe of the twin that must equal the plan's start
    no_same_step: str = ""  # Reason why a replay at the plan's own integration step is not meaningful
    tracking: Callable[[Any], Section] | None = None  # planner.Replay -> the Section of the tracking error
    # planner.Replay -> the Section of the goal check.
    goal: Callable[[Any], Section] | None = None
    # End states (K, nx) of perturbed rollouts, all finite -> (K,) bool, whether each reached the goal.
    success: Callable[[np.ndarray], np.ndarray] | None = None
    # In place of `success` where the whole trajectory counts: (states (K, T, nx) of perturbed rollouts, all finite, the
    # plan's (T, nx), their knots (T,), N for the end) -> (K,) bool, success of each rollout.
    follows: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None
    # Default perturbations of step 5 of prove(): amounts by names of Perturbation, in place of its defaults.
    perturbation: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Problem(Built):
    """Minimize J = phi(x(N)) + sum L(x(n), u(n), n) subject to x(n+1) = f(x(n), u(n)), x(0) = x0.

    Attributes:
        dynamics: f and its Jacobians.
        cost: phi and L.
        x0: (nx,) start. Its quaternions are normalized; one of length zero is refused.
        us: (N, nu) first guess of the controls; zero by default.
        horizon: N; needed only if neither us nor the cost has it.
        twin: The MuJoCo model for replays; by default the MJCF that the dynamics' mechanism was read from, with
            actuators at its prescribed joints (planner.model.mjcf.prescribed_joints); None if there is none.
        appearance: Cameras, colours and plots of the machine.
        requirements: Rules for the proof of a built-in problem; None for the general rules.
        limits: Bounds of the controls, ranges of the states, exact goals; None for none.
        constraints: planner.Constraint of terms or functions along the plan; () for none.
        objective: The weights of planner.costs.with_objective; None for the cost as given.
        expected_reduction_tolerance: Default of planner.solve for this problem, for a cost that is flat near its
            minimum; None for solve's own.
        actual_reduction_tolerance: The same, for a nonsmooth cost.
        periodic: Components of the state that return at the end, for planner.solve_periodic; None for none.
        tolerance: Max error of the end against the cost's final reference, for the proof: a number in rad, m, rad/s
            and m/s, infinite (or "soft") for no check, or a table of these by "position", "velocity" and the names of
            joints and frames. What it leaves out: 2 % of the displacement, see planner.problem.goals. With None, the
            default, such a goal that is missed does not make a solve's status GOAL_MISSED; with a table, empty too, it
            does.
        goal_specs: Goal checks of a task for the proof; None for those of the cost's final reference.
        stances: Which feet its phases or gait ask to stand and to swing, for the proof; () for none.
        recipe: Recipe to rebuild the problem; None for one that was assembled from parts, or whose dynamics, cost,
            start, horizon or constraints were replaced.
        bounds: Control bounds, from the limits; None for none.
        ranges: State bounds, from the limits; None for none.
        trajectory_constraints: State bounds and constraints together, for the solver; None for none.

    Raises:
        PlannerError: Inconsistent shapes, numbers that are not finite, a start that violates the mechanism's couplings
            or a constraint.
    """

    dynamics: Dynamics
    cost: Cost
    x0: np.ndarray
    us: np.ndarray | None = None
    horizon: int | None = None
    twin: Twin | None = None
    appearance: Appearance | None = None
    requirements: Requirements | None = None
    recipe: Recipe | None = None
    limits: Limits | None = None
    constraints: Sequence[Constraint] = ()
    objective: Objective | None = None
    periodic: Periodic | None = None
    tolerance: float | Mapping[str, float] | None = None
    expected_reduction_tolerance: float | None = None
    actual_reduction_tolerance: float = 0.0
    goal_specs: tuple[GoalSpec, ...] | None = None
    stances: tuple[Stance, ...] = ()
    bounds: ControlBounds | None = field(init=False, default=None)
    ranges: StateBounds | None = field(init=False, default=None)
    trajectory_constraints: TrajectoryConstraints | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._check_parts()
        nx, nu = self.dynamics.nx, self.dynamics.nu
        space = space_of(self.dynamics)
        object.__setattr__(self, "x0", states("x0", self.x0, space, ()))
        if isinstance(self.dynamics, RigidBodyDynamics):
            check_assembled("x0", self.x0, self.dynamics.mechanism)
        us = None if self.us is None else array("us", self.us, ("N", nu))
        told = (self.horizon, getattr(self.cost, "N", None), None if us is None else len(us))
        N = next((number for number in told if number is not None), None)
        if N is None:
            raise PlannerError("the problem has no horizon, expected horizon=N or first controls us (N, nu).")
        N = count("horizon", N, maximum=LONGEST_HORIZON)
        us = np.zeros((N, nu)) if us is None else array("us", us, (N, nu))
        object.__setattr__(self, "horizon", N)
        object.__setattr__(self, "us", us)
        sizes = (
            ("N", N, "horizon"), ("nx", nx, "dynamics.nx"), ("ndx", space.ndx, "the dynamics' ndx"),
            ("nu", nu, "dynamics.nu"),
        )  # fmt: skip
        for name, size, asked in sizes:
            have = getattr(self.cost, name, None)
            if have is not None and have != size:
                hint = "; make it with space=dynamics.space" if space.ndx != nx and name in ("nx", "ndx") else ""
                if name == "nu" and have == 1:  # of an effort that is a number
                    hint = f"; make it with nu={nu}, or with an effort of {nu} numbers"
                raise PlannerError(f"the cost is made for {name} = {have}, expected {asked} = {size}{hint}.")
        have = getattr(self.cost, "space", None)
        if have is not None and have != space:
            raise PlannerError("the cost has its quaternions elsewhere, expected it to be made with dynamics.space.")
        if self.recipe is not None:
            cost = self.cost if self.objective is None else self.objective.base
            object.__setattr__(self, "recipe", self.recipe.of(self.dynamics, cost, self.x0, N, self.constraints))
        if self.expected_reduction_tolerance is not None:
            number("expected_reduction_tolerance", self.expected_reduction_tolerance, minimum=0.0)
        number("actual_reduction_tolerance", self.actual_reduction_tolerance, minimum=0.0)
        object.__setattr__(self, "tolerance", checked_tolerance(self.tolerance))
        if self.periodic is not None:
            names = [one.name for one in coordinates_of(self.dynamics)]
            object.__setattr__(self, "periodic", self.periodic.of_coordinates(names))
        if self.limits is not None:
            goal = tracking_of(self.cost) or self.cost
            object.__setattr__(self, "bounds", self.limits.bounds(self.dynamics, N))
            ends = self.periodic is None  # else the last reference is a multiplier
            object.__setattr__(self, "ranges", self.limits.ranges(self.dynamics, goal, self.x0, N, ends))
        self._keep(us)
        if self.twin is None and isinstance(self.dynamics, RigidBodyDynamics) and self.dynamics.mechanism.mjcf:
            object.__setattr__(self, "twin", twin_of(self.dynamics.mechanism, self.dynamics.prescribed))
        if self.twin is not None and len(self.twin.to_x_offset) != nx:
            raise PlannerError(f"the twin maps to {len(self.twin.to_x_offset)} states, expected dynamics.nx = {nx}.")

    def _check_parts(self) -> None:
        """Raise a PlannerError unless each part is of its type, before its sizes are read."""
        missing = [name for name in ("nx", "nu", "dt", "step", "linearize") if not hasattr(self.dynamics, name)]
        if missing:
            what = f"expected dynamics with nx, nu, dt, step and linearize (no {missing[0]} there)"
            raise PlannerError(f"dynamics is {short_repr(self.dynamics)}, {what}.")
        check_cost("cost", self.cost)
        given = self.constraints
        if not isinstance(given, Sequence) or not all(isinstance(one, Constraint) for one in given):
            raise PlannerError(f"constraints is {short_repr(given)}, expected a list of planner.Constraint.")
        object.__setattr__(self, "constraints", tuple(given))
        parts = (
            ("twin", Twin), ("appearance", Appearance), ("requirements", Requirements), ("limits", Limits),
            ("periodic", Periodic), ("recipe", Recipe), ("objective", Objective),
        )  # fmt: skip
        for name, kind in parts:
            part = getattr(self, name)
            if part is not None and not isinstance(part, kind):
                raise PlannerError(f"{name} is {short_repr(part)}, expected {kind.__name__} or None.")

    def _keep(self, us: np.ndarray) -> None:
        """Set trajectory_constraints: state bounds, tendon ranges and joint forces of the limits, and constraints."""
        tolerance = TOLERANCE if self.limits is None else self.limits.tolerance
        goal = tracking_of(self.cost) or self.cost
        tendons = () if self.limits is None else self.limits.tendons(self.dynamics, goal, self.x0)
        forces = () if self.limits is None else self.limits.joint_forces(self.dynamics)
        constraints = (*self.constraints, *tendons, *forces)
        rows = ConstraintStack(constraints, self.dynamics, self.x0, us, tolerance) if constraints else None
        if rows is not None or self.ranges is not None:
            object.__setattr__(self, "trajectory_constraints", TrajectoryConstraints(self.ranges, rows, tolerance))

    def with_bounds(self, bounds: ControlBounds | None, ranges: StateBounds | None) -> Problem:
        """A copy with other bounds and ranges than its limits state; constraints stay as they are.

        dataclasses.replace() of the copy has those of the limits again.
        """
        problem, constraints = copy(self), self.trajectory_constraints
        if constraints is not None:
            rows, tolerance = constraints.rows, constraints.tolerance
            none = ranges is None and rows is None
            constraints = None if none else TrajectoryConstraints(ranges, rows, tolerance)
        for name, part in (("bounds", bounds), ("ranges", ranges), ("trajectory_constraints", constraints)):
            object.__setattr__(problem, name, part)
        return problem

    def penalized_cost(self, penalties: BoundPenalties | None, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost along xs (N+1, nx), us (N, nu) with the penalties of trajectory_constraints."""
        J, constraints = float(self.cost.value(xs, us)), self.trajectory_constraints
        return J if penalties is None or constraints is None else J + constraints.value(penalties, xs, us)

    def penalized_quadratic(
        self, penalties: BoundPenalties | None, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray
    ) -> Quadratic:
        """The quadratic model of penalized_cost along xs, us; A and B of Eq. 35."""
        model, constraints = self.cost.quadratize(xs, us), self.trajectory_constraints
        if penalties is None or constraints is None:
            return model
        return constraints.with_penalties(penalties, model, xs, us, A, B)

    def __repr__(self) -> str:
        title = "" if self.appearance is None else self.appearance.title
        name = title or (self.recipe.name if self.recipe else type(self.dynamics).__name__)
        stages = "1 stage" if self.N == 1 else f"{self.N} stages"
        return f"Problem({name}: {stages} of {self.dynamics.dt:g} s, nx {self.dynamics.nx}, nu {self.dynamics.nu})"

    @property
    def N(self) -> int:
        """Number of stages."""
        assert self.horizon is not None  # set when the problem was made
        return self.horizon

    @property
    def duration(self) -> float:
        """N dt, s."""
        return self.N * self.dynamics.dt

    @property
    def first_guess(self) -> np.ndarray:
        """(N, nu) initial controls of a solve."""
        assert self.us is not None  # set when the problem was made
        return self.us
