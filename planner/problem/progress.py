"""How a solve goes and ends: rows of iterations and starts, the status, and what a plan says of bounds and constraints.

Diagnostics of a plan at bounds of its controls, or outside of ranges and constraints, have messages here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from planner.base.measured import Diagnostic, Quantity
from planner.model.capabilities import capabilities_of
from planner.problem.problem import Problem

_AT_BOUND_SHARE = 1e-6  # share of a range: distance below which a control is at its bound
_MIN_SHARE_AT_BOUND = 0.1  # of the stages: lower limit to report a bound
_MAX_NAMED = 3  # constraints that are named
_MIN_REDUCTION = 1e-3  # relative cost reduction in the second half of a solve at or below which it has stalled


class Status(StrEnum):
    """Outcome of a solve. The value is a sentence, which suggests a next action unless CONVERGED."""

    CONVERGED = "The gradient, the predicted or the actual decrease fell below its tolerance."
    MAX_ITERATIONS = "The iteration limit was reached; raise max_iterations, or start from this plan's controls."
    NO_DESCENT = (
        "No step length lowered the cost, even strongly regularized; check the derivatives with "
        "planner.check_derivatives(problem), smooth the dynamics or start from another guess."
    )
    NOT_FINITE = (
        "The first guess rolls out to infinite or undefined states, or its cost or gradient is not a number; start "
        "from smaller controls, take a shorter stage or more substeps, or check a cost of your own."
    )
    OUTSIDE_LIMITS = (
        "The limits and constraints were not met to their tolerance within the rounds of the augmented Lagrangian; "
        "give the motion more time or wider bounds, or start from a guess that meets them."
    )
    NOT_PERIODIC = (
        "The motion did not come back to where it began within the passes; allow more passes or wider tolerances, or "
        "give it another duration."
    )
    NOT_OPTIMAL = (
        "The motion comes back to where it began, but another start and end of it would cost less; solve with more "
        "passes, and with step='newton', which optimizes them."
    )
    GOAL_MISSED = "The solve converged, but a goal is missed by more than its tolerance."
    UNRESOLVED = (
        "The solve converged, but its steps do not resolve the motion: halving them moves it by more than 5 % of its "
        "range; take shorter stages or more substeps, or start from calmer controls."
    )
    INFEASIBLE = (
        "The motion is solved without its limits, and within them it is infeasible as far as found; give it more time "
        "or wider limits."
    )
    GIVEN = "The controls were given, not solved for; prove them with prove(..., optimal=False)."
    WORK_LIMIT = (
        "The work budget of the run was reached; this is the best plan so far. Allow more (work in a problem.toml, "
        "--work), or give the motion more time, wider limits or a shorter way."
    )
    TIME_LIMIT = (
        "The time budget of the run was reached, so this plan depends on the speed of the computer; it is the best so "
        "far. Allow more seconds (--budget)."
    )
    INTERRUPTED = "Interrupted; this is the best plan so far, and a new solve can start from its controls."

    @property
    def converged(self) -> bool:
        """Whether the solve converged, whatever its plan misses."""
        return self in _OF_CONVERGED

    @property
    def cut(self) -> bool:
        """Whether the solve ended at a limit of iterations, work or time, and might have gone on."""
        return self in (Status.MAX_ITERATIONS, Status.WORK_LIMIT, Status.TIME_LIMIT)


_OF_CONVERGED = (Status.CONVERGED, Status.GOAL_MISSED, Status.UNRESOLVED)


class Iteration(NamedTuple):
    """One row of the iteration table. Cost and gradient are those before the iteration's step."""

    iteration: int  # Counted from 0
    cost: float  # J of Eq. 9
    gradient_norm: float  # Euclidean norm of the gradient of J with respect to all controls (Eq. 19)
    step: float  # Step length (Eq. 36); 0 without a step (converged, or regularization was increased)
    expected: float  # Expected reduction of the LQ model for that step length; NaN of a step that closes defects
    actual: float  # Actual reduction
    regularization: float  # Added to the diagonal of R + B'PB

    def __str__(self) -> str:
        expected = "-" if math.isnan(self.expected) else f"{self.expected:.2e}"
        row = (
            f"{self.iteration:5d}  {self.cost:15.8g}  {self.gradient_norm:9.2e}  {self.step:9.3g}  "
            f"{expected:>9}  {self.actual:9.2e}  {self.regularization:9.2e}"
        )
        return row if self.iteration else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The table header; str() puts it above iteration 0."""
        return f"{'iter':>5}  {'cost':>15}  {'|grad|':>9}  {'step':>9}  {'expected':>9}  {'actual':>9}  {'regular.':>9}"


class Start(NamedTuple):
    """Result of one of several starts of a solve."""

    number: int  # 0 is the problem's own first guess
    status: Status  # Of its solve
    cost: float  # J of Eq. 9
    iterations: int  # Of its solve
    score: float  # Ranking value, lower is better: the cost, or the value of solve()'s `rank`

    @property
    def rank(self) -> tuple[bool, float, int]:
        """Sorting key, smallest for the best: converged before others, then by score."""
        return self.status is not Status.CONVERGED, self.score if math.isfinite(self.score) else math.inf, self.number

    def __str__(self) -> str:
        row = f"{self.number:5d}  {self.cost:15.8g}  {self.iterations:10d}  {self.status.name}"
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The table header; str() puts it above start 0."""
        return f"{'start':>5}  {'cost':>15}  {'iterations':>10}  status"


SENTENCES = {
    "control_at_bound": "{control} is at its bound in {stages} of {all} stages",
    "state_at_bound": "the {coordinate} is at its limit at {knots} of {all} knots",
    "outside_range": "{coordinate} is {distance} outside of its range at t = {time}",
    "off_exact_goal": "{coordinate} is {distance} from its exact goal at t = {time}",
    "constraint_violated": "{constraint} is broken by {violation} at t = {time}",
    "more_violated": "and {count} more",
}


def sentence_of(found: Diagnostic | None) -> str:
    """The message of a diagnostic of this module; "" for None."""
    return "" if found is None else found.text(SENTENCES)


def control_name(problem: Problem, index: int) -> str:
    """Name of a control in messages: its actuator's, else its index."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    names = () if mechanism is None else mechanism.actuators.names
    return f"actuator {names[index]!r}" if index < len(names) and names[index] else f"control {index}"


def control_at_bound(problem: Problem, xs: np.ndarray, us: np.ndarray) -> Diagnostic | None:
    """The control that is most often at a bound along xs (N+1, nx), us (N, nu), and in how many stages."""
    if problem.bounds is None:
        return None
    stages = controls_at_bounds(problem, xs, us).sum(axis=0)
    worst = int(np.argmax(stages))
    if stages[worst] < max(1, _MIN_SHARE_AT_BOUND * len(us)):
        return None
    values = {"control": control_name(problem, worst), "stages": int(stages[worst]), "all": len(us)}
    return Diagnostic("control_at_bound", values)


def controls_at_bounds(problem: Problem, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """(N, nu) bool, whether each control is at a bound in each stage of xs (N+1, nx), us (N, nu)."""
    if problem.bounds is None:
        return np.zeros(us.shape, dtype=bool)
    lower, upper = problem.bounds.at(slice(None), xs[: len(us)])
    with np.errstate(invalid="ignore"):
        near = _AT_BOUND_SHARE * np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    return (us <= lower + near) | (us >= upper - near)


def state_at_bound(problem: Problem, xs: np.ndarray) -> Diagnostic | None:
    """The coordinate that is most often at a bound along the states xs (N+1, nx), and how often."""
    ranges, limits = problem.ranges, problem.limits
    if ranges is None or limits is None or not np.isfinite(xs).all():
        return None
    knots = ranges.at_bound(xs, limits.tolerance)[:, : len(ranges.component) - ranges.at_end].sum(axis=0)
    worst = int(np.argmax(knots)) if len(knots) else -1
    if worst < 0 or knots[worst] < max(1, _MIN_SHARE_AT_BOUND * len(xs)):
        return None
    values = {"coordinate": ranges.coordinates[worst].name, "knots": int(knots[worst]), "all": len(xs)}
    return Diagnostic("state_at_bound", values)


def state_outside(problem: Problem, xs: np.ndarray, t: np.ndarray) -> Diagnostic | None:
    """The coordinate of the states xs (N+1, nx) that is furthest outside of its range, and when."""
    limits, ranges = problem.limits, problem.ranges
    if ranges is None or limits is None or not np.isfinite(xs).all():
        return None
    violation = ranges.violation(xs)
    n, worst = np.unravel_index(int(np.argmax(violation)), violation.shape)
    if violation[n, worst] <= limits.tolerance:
        return None
    name, unit = ranges.coordinates[worst]
    code = "off_exact_goal" if worst >= len(ranges.component) - ranges.at_end else "outside_range"
    values = {"coordinate": name, "distance": Quantity(violation[n, worst], unit), "time": Quantity(t[n], "s")}
    return Diagnostic(code, values)


def constraints_broken(problem: Problem, xs: np.ndarray, us: np.ndarray, t: np.ndarray) -> list[Diagnostic]:
    """Violated constraints at states xs (N+1, nx) and controls us (N, nu), with violation and time; worst first."""
    rows = None if problem.trajectory_constraints is None else problem.trajectory_constraints.rows
    if rows is None or not np.isfinite(xs).all():
        return []
    broken = [one for one in rows.violations(xs, us) if not one.value <= one.constraint.allowed()]
    broken.sort(key=lambda one: -one.value / one.constraint.allowed())
    found = [
        Diagnostic("constraint_violated", {
            "constraint": str(one.constraint), "violation": Quantity(one.value, one.constraint.unit),
            "time": Quantity(t[one.at], "s"),
        })
        for one in broken[:_MAX_NAMED]
    ]  # fmt: skip
    more = len(broken) - _MAX_NAMED
    return [*found, Diagnostic("more_violated", {"count": more})] if more > 0 else found


def infeasible_message(message: str, found: Mapping[str, Any]) -> str:
    """A message about limits that no motion was found to keep, with the duration and the factor that pass."""
    passes = []
    if "duration" in found:
        passes.append(f"in {found['duration']:.6g} s")
    if "factor" in found:
        wider = math.ceil(100.0 * found["factor"]) / 100.0
        passes.append(f"with limits {wider:.6g} times as wide, in the model too where they are its own")
    what = "it comes near its goals" if "lacks_weight" in found else "it passes"
    return f"{message[:-1]}: {what} {', or '.join(passes)}." if passes else message


def stalled(history: Sequence[Any], cost: float) -> bool:
    """Whether the second half of a solve's iterations reduced the cost by at most _MIN_REDUCTION of it."""
    half = history[len(history) // 2 :]
    return len(half) > 2 and half[0].cost - cost <= _MIN_REDUCTION * abs(cost)
