"""Plan: what solve() returns and what plan.npz holds.

Everywhere, files included, the control of a plan is

    u = us[n] + K[n] @ (x - xs[n]),     held over stage n.

plan.npz is read with numpy alone: arrays t (N+1,), xs (N+1, nx), us (N, nu), K (N, nu, nx), history (one row
per iteration, columns as in Iteration) and meta, one JSON string. No pickle.
"""

from __future__ import annotations

import functools
import json
import math
import platform
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from planner.errors import FileError, PlannerError
from planner.files import write_atomically
from planner.twin import Twin

if TYPE_CHECKING:
    from planner.problem import Problem

FORMAT_VERSION = 1


class Status(StrEnum):
    """How a solve ended. The value is a sentence; for everything but CONVERGED it says what to do next."""

    CONVERGED = "The gradient or the predicted decrease fell below its tolerance."
    MAX_ITERATIONS = (
        "The iteration limit was reached; raise max_iterations, or start from this plan's controls."
    )
    NO_DESCENT = (
        "No step length lowered the cost, even strongly regularised; check the derivatives, "
        "smooth the dynamics or start from another guess."
    )
    NOT_FINITE = (
        "The first guess rolls out to infinite or undefined states; start from a smaller control or a "
        "shorter stage."
    )
    INTERRUPTED = "Interrupted; this is the best plan so far, and a new solve can start from its controls."


class Iteration(NamedTuple):
    """One line of the iteration table. Costs and gradients are those before the step.

    Attributes:
        iteration: Counted from 0.
        cost: J of Eq. 9.
        gradient_norm: Euclidean norm of the gradient of J with respect to all controls (Eq. 19).
        step: Step length taken (Eq. 36); 0 when none was (converged, or regularisation was raised).
        expected: Decrease that the LQ model promised for that step.
        actual: Decrease that came.
        regularisation: What was added to the diagonal of R + B'PB.
    """

    iteration: int
    cost: float
    gradient_norm: float
    step: float
    expected: float
    actual: float
    regularisation: float

    def __str__(self) -> str:
        return (
            f"{self.iteration:5d}  {self.cost:15.8g}  {self.gradient_norm:9.2e}  {self.step:9.3g}  "
            f"{self.expected:9.2e}  {self.actual:9.2e}  {self.regularisation:9.2e}"
        )

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes."""
        return (
            f"{'iter':>5}  {'cost':>15}  {'|grad|':>9}  {'step':>9}  "
            f"{'expected':>9}  {'actual':>9}  {'regular.':>9}"
        )


@dataclass(frozen=True, eq=False)
class Plan:
    """An optimized motion with the gains that hold it.

    Attributes:
        t: (N+1,) s, the knots.
        xs: (N+1, nx) states.
        us: (N, nu) controls, each held over its stage.
        K: (N, nu, nx) gains of the last Riccati sweep.
        cost: J of Eq. 9.
        gradient_norm: Norm of Eq. 19 at the plan: check optimality from the file.
        status: How the solve ended.
        history: One Iteration per iteration; the last line is the plan itself.
        problem: What was solved; None for a file whose problem is a user's own Python.
        case: Name of the case in planner.cases, or None.
        parameters: Every argument of the case by name.
        twin: The MuJoCo model it is replayed in, or None.
        versions: Of the software that made the plan.
    """

    t: np.ndarray
    xs: np.ndarray
    us: np.ndarray
    K: np.ndarray
    cost: float
    gradient_norm: float
    status: Status
    history: tuple[Iteration, ...]
    problem: Problem | None = None
    case: str | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    twin: Twin | None = None
    made_with: dict[str, str] | None = None

    @property
    def N(self) -> int:
        """Number of stages."""
        return len(self.us)

    @property
    def dt(self) -> float:
        """Length of a stage, s."""
        return float(self.t[-1]) / self.N

    @property
    def nit(self) -> int:
        """Number of iterations (as in SciPy)."""
        return max(len(self.history) - 1, 0)

    @property
    def success(self) -> bool:
        """Whether the solve converged (as in SciPy)."""
        return self.status is Status.CONVERGED

    @property
    def message(self) -> str:
        """The status in a sentence (as in SciPy)."""
        return self.status.value

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the software that made the plan."""
        return installed_versions() if self.made_with is None else self.made_with

    def __str__(self) -> str:
        name = f"{self.case}: " if self.case else ""
        return f"Plan({self.status.name}: {name}{self.nit} iterations, cost {self.cost:.6g}, N = {self.N})"

    __repr__ = __str__
