"""ProblemFile: the problem of a problem.toml, solved as the file asks for; and `periodic`, a gait that goes on.

The solver finds the start of a periodic gait (planner.problem.tasks.cycle); its plan is repeated for the other cycles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array
from planner.base.data_files import finite
from planner.base.errors import PlannerError
from planner.cases.problem_file.tasks import steps_of
from planner.dynamics import RigidBodyDynamics
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.space import StateMap
from planner.problem.costs.terms import Cost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.goals import MIN_TOLERANCES
from planner.problem.limits import Limits
from planner.problem.objective import rebuilt
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.problem_parts import Periodic
from planner.problem.reaching_cost import along_gait, staying_cost, with_slip
from planner.problem.tasks.cycle import Cycle, CycleMotion, cycle_motion, cycle_of
from planner.solvers.free_time import solve_for
from planner.solvers.gains import feedback_rollout
from planner.solvers.options import single_start
from planner.solvers.periodic import solve_periodic
from planner.solvers.periodic_boundary import PARAMETER, ends_of, terminal_goal_cost
from planner.solvers.phase_times import TRIED, solve_phase_times
from planner.solvers.slq import solve
from planner.solvers.work import budget_of

RETURNED = 0.5  # of the default tolerance of a goal: how far from the image of its start a cycle may end
GAIN_OF_CYCLE = 3e-6  # of the cost, by an iteration that is worth it: where a cycle begins is told by small differences
ACTIVATION = 0.01  # of an activation, likewise


def cycle_in(table: dict[str, Any], tasked: bool) -> Cycle | None:
    """The cycle of a table; None where it has none.

    Raises:
        PlannerError: It is wrong, there is no gait, or a goal besides.
    """
    if "periodic" not in table:
        return None
    cycle = cycle_of(table["periodic"])
    if tasked or table.get("goal"):
        raise PlannerError("there are periodic, whose end is given by its start, and a goal: expected one of them.")
    if steps_of(table) is None:
        raise PlannerError(
            'periodic is a cycle of a gait, expected gait = "trot" or another one, or tables [[phase]], beside it.'
        )
    if "time" in table.get("objective", {}):
        raise PlannerError("the objective has time, and a cycle has a fixed duration: expected another objective.")
    return cycle


def motion_in(
    table: dict[str, Any], cycle: Cycle, dynamics: RigidBodyDynamics, x0: np.ndarray, N: int, limits: Limits | None
) -> CycleMotion:
    """The reference of a table's cycle from a state (nx,) in which the machine stands, in N stages."""
    steps = steps_of(table, dynamics.mechanism)
    ranges = (limits or Limits(position="off")).position_ranges(dynamics)
    assert steps is not None  # cycle_in has refused it
    return cycle_motion(steps, cycle, dynamics, x0, N, ranges)


def unrolled(problem: Problem, plan: Plan, cycles: int, **options: Any) -> Plan:
    """The plan of so many cycles, one after another, from the plan of one of a file's problem.

    The first rollout of all is on the images of the one before, by their gains; `options` are those of solve().
    """
    assert plan.problem is not None  # solve_periodic made it
    image = plan.problem.periodic.image if plan.problem.periodic is not None else None
    assert image is not None  # of a file
    table = problem.parameters["periodic"] | {"cycles": cycles}
    start, goal = ends_of(plan.problem)
    for _ in range(cycles - 1):
        goal = image.apply(plan.space, goal)
    whole = rebuilt(problem, **{"periodic": table, PARAMETER: [start.tolist(), goal.tolist()]})
    us, xs, K = [plan.us], [plan.xs], [plan.K]
    for _ in range(cycles - 1):
        us.append(image.images_of_controls(us[-1]))
        xs.append(image.apply(plan.space, xs[-1][-plan.N :]))
        K.append(np.swapaxes(image.images_of_controls(np.swapaxes(K[-1] @ image.matrix.T, 1, 2)), 1, 2))
    us = feedback_rollout(whole, np.concatenate(us), np.concatenate(K), np.concatenate(xs))[1]
    periodic, options = whole.periodic, single_start(options)
    assert periodic is not None  # of cycles
    found = solve(replace(whole, us=us), **options)
    miss = periodic.miss(found.space, found.xs)
    rows = [finite([found.cost - terminal_goal_cost(found), miss, math.nan, found.nit])]
    if found.converged and miss > 1.0:  # cheaper ones inside of it have moved its end
        found = solve_periodic(replace(whole, us=found.us), **options)
        rows += found.options["tried"]
    tried = {name: plan.options[name] for name in ("step", "passes", TRIED) if name in plan.options}
    tried |= {"tried": [*plan.options["tried"], *rows], "unrolled": sum(row[3] for row in rows)}
    return replace(found, options=found.options | tried)


def without_cycles(table: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """A file's table of a single cycle, and how many it asks for."""
    if "periodic" not in table:
        return table, 1
    cycles = cycle_of(table["periodic"]).cycles
    return table | {"periodic": {key: part for key, part in table["periodic"].items() if key != "cycles"}}, cycles


def ends_in(table: dict[str, Any], motion: CycleMotion) -> tuple[np.ndarray, np.ndarray]:
    """Start and last reference (nx,) of all cycles: those of a plan's table, else those of their motion."""
    if table.get(PARAMETER) is None:
        return motion.states[0], motion.states[-1]
    start, goal = array(PARAMETER, table[PARAMETER], (2, motion.states.shape[1]))
    return start, goal


def cycle_cost(
    dynamics: RigidBodyDynamics, x0: np.ndarray, motion: CycleMotion, cycle: Cycle, goal: np.ndarray,
    weights: dict[str, Any],
) -> Cost:  # fmt: skip
    """The cost of a cycle, and of its images after it.

    Its end weighs as at x0 (nx,), where the machine stands, the time to stay there would; what is left open does not.

    Args:
        dynamics: The machine.
        x0: (nx,) how it stands.
        motion: The reference of one cycle.
        cycle: What it is to do, and how often.
        goal: (nx,) the last reference of all cycles.
        weights: As of reaching_cost.weighed.
    """
    arguments = along_gait(dynamics, motion.states, weights)
    hold, slip = arguments.pop("hold", 0.0), arguments.pop("slip", 0.0)
    tracking = TrackingCost.joints(dynamics, motion.states[-1], len(motion.states) - 1, **arguments)
    standing = TrackingCost(tracking.Q, tracking.R, x0, tracking.u_ref, tracking.space)
    one, space, image = staying_cost(dynamics, standing, hold, 0.0), dynamics.space, motion.image
    last, names = one.Q[-1].copy(), [one.name for one in coordinates_of_mechanism(dynamics.mechanism)]
    left_open = np.isin(names, cycle.left_open)
    last[left_open] = last[:, left_open] = 0.0
    Q, R, u_ref = [one.Q[:-1]], [one.R], [one.u_ref]
    for _ in range(cycle.cycles - 1):
        Q.append(image.matrix @ Q[-1] @ image.matrix.T)
        R.append(image.images_of_controls(np.swapaxes(image.images_of_controls(R[-1]), 1, 2)))
        u_ref.append(image.images_of_controls(u_ref[-1]))
        last = image.matrix @ last @ image.matrix.T
    whole = np.concatenate([*Q, last[None]])
    cost = TrackingCost(
        0.5 * (whole + np.swapaxes(whole, 1, 2)), np.concatenate(R), motion.repeated(space, cycle.cycles).states,
        np.concatenate(u_ref), space,
    )  # fmt: skip
    return with_slip(cost.with_goal(goal), dynamics, slip, x0[None])


def periodic_of(dynamics: RigidBodyDynamics, image: StateMap, cycle: Cycle) -> Periodic:
    """What returns at the end of a plan's cycles: all that is not left open, within a tolerance for each of them."""
    units = [one.unit for one in coordinates_of_mechanism(dynamics.mechanism)]
    tolerance = [RETURNED * MIN_TOLERANCES[unit] if unit in MIN_TOLERANCES else ACTIVATION for unit in units]
    image = image.power(dynamics.space, cycle.cycles)
    return Periodic(
        cycle.cycles * np.array(tolerance), passes=cycle.passes, image=image, left_open=cycle.left_open
    )  # fmt: skip


SEARCH_SHARE = 0.7  # of the work, for the times of phases: the rest is for the cycles after the first one


class ProblemFile(NamedTuple):
    """The problem of a problem.toml, and how to solve it."""

    problem: Problem
    starts: int
    seed: int
    objective: dict[str, float] | None  # weights by names of OBJECTIVES, for solve_for; None for the problem as it is
    durations: list[float] | None  # the shortest and the longest, s, for an objective with time
    notes: tuple[str, ...] = ()  # sentences about contacts, and about what was done to start and goal
    work: float | None = None  # of the run
    cycles: int = 1  # of a periodic problem, which is of one, that the plan has
    phase_times: Mapping[int, tuple[float, float]] = {}  # s, by phase from 0, within which it may end

    def solved(self, callback: Callable[[Any], object] | None, **options: Any) -> Plan:
        """The plan, by the solver that the problem asks for; options are those of solve()."""
        options["budget"] = budget_of(options.get("budget"))  # one for all solves
        if self.phase_times:
            plan = self._replace(cycles=1)._at_best_times(callback, options)
            assert plan.problem is not None  # it was solved
            return self._replace(problem=plan.problem)._unrolled(plan, callback, options)
        if self.problem.periodic is not None:
            plan = solve_periodic(self.problem, callback=callback, **options)
            return self._unrolled(plan, callback, options)
        if self.objective is None:
            return solve(self.problem, callback=callback, **options)
        return solve_for(self.problem, durations=self.durations, callback=callback, **options)  # its own objective

    def _at_best_times(self, callback: Callable[[Any], object] | None, options: dict[str, Any]) -> Plan:
        """The plan of least cost by the times of its phases; several starts are for the first solve."""
        budget, one = options["budget"], self._replace(phase_times={})
        part = None if budget is None else budget.part("phase times", SEARCH_SHARE)
        each = options | {"budget": part}

        def solved(problem: Problem) -> Plan:
            nonlocal each
            plan = one._replace(problem=problem).solved(None, **each)
            each = single_start(each)
            return plan

        return solve_phase_times(self.problem, self.phase_times, solved, callback, part)

    def _unrolled(self, plan: Plan, callback: Callable[[Any], object] | None, options: dict[str, Any]) -> Plan:
        """The plan of as many cycles as the file asks for, from that of one; that one if it is no solution."""
        if self.cycles == 1 or not plan.converged or (options["budget"] is not None and options["budget"].exhausted):
            return plan
        return unrolled(self.problem, plan, self.cycles, callback=callback, **options)
