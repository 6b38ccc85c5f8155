"""How a solve goes and ends: a row of each iteration, a row of each start, and the status."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple


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
        "give what must come back a larger final weight."
    )
    NOT_OPTIMAL = (
        "The motion comes back to where it began, but another start and end of it would cost less; solve with "
        "step='newton', which optimizes them."
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
    expected: float  # Expected reduction of the LQ model for that step length
    actual: float  # Actual reduction
    regularization: float  # Added to the diagonal of R + B'PB

    def __str__(self) -> str:
        row = (
            f"{self.iteration:5d}  {self.cost:15.8g}  {self.gradient_norm:9.2e}  {self.step:9.3g}  "
            f"{self.expected:9.2e}  {self.actual:9.2e}  {self.regularization:9.2e}"
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
