"""Plan: what solve() returns and what plan.npz holds.

Everywhere, files included, the control of a plan is

    u = us[n] + K[n] @ (x - xs[n]),     held over stage n,

put back within the bounds of the problem's limits where it has some (within_bounds), and
where x - xs[n] is the deviation space.difference(x, xs[n]), for plain vectors their difference.

plan.npz is read with numpy alone: arrays t (N+1,), xs (N+1, nx), us (N, nu), K (N, nu, ndx), history (one row
per iteration, columns as in Iteration) and meta, one JSON string, in which `space` tells where xs has quaternions and
`digests` what was changed since it was written. Its model and its problem are in it too, so it is proved from the file
alone; a problem that is its maker's own Python must be given. No pickle.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable
from planner.base.versions import installed_versions
from planner.model.space import StateSpace, euclidean, space_of
from planner.model.twin import Twin
from planner.problem.archive import ASSET, HINGES, PART, plan_name, read_archive, write_archive
from planner.problem.limits import Limits
from planner.problem.objective import plain, with_objective
from planner.problem.state_ranges import Hinges
from planner.problem.stored_problem import rebuilt, stored

if TYPE_CHECKING:
    from planner.problem.problem import Problem


class Status(StrEnum):
    """How a solve ended. The value is a sentence; for everything but CONVERGED it says what to do next."""

    CONVERGED = "The gradient, the predicted or the actual decrease fell below its tolerance."
    MAX_ITERATIONS = "The iteration limit was reached; raise max_iterations, or start from this plan's controls."
    NO_DESCENT = (
        "No step length lowered the cost, even strongly regularised; check the derivatives, "
        "smooth the dynamics or start from another guess."
    )
    NOT_FINITE = (
        "The first guess rolls out to infinite or undefined states; start from a smaller control or a shorter stage."
    )
    OUTSIDE_LIMITS = (
        "The limits were not met to their tolerance within the rounds of the augmented Lagrangian; give the motion "
        "more time or wider limits, or start from a guess that meets them."
    )
    NOT_PERIODIC = (
        "The motion did not come back to where it began within the passes; allow more passes or wider tolerances, or "
        "give what must come back a larger final weight."
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
        return f"{'iter':>5}  {'cost':>15}  {'|grad|':>9}  {'step':>9}  {'expected':>9}  {'actual':>9}  {'regular.':>9}"


class Start(NamedTuple):
    """How one of several starts of a solve ended.

    Attributes:
        number: 0 is the problem's own first guess.
        status: How it ended.
        cost: J of Eq. 9.
        iterations: It took.
        score: What it is ranked by: the cost, or what solve()'s `rank` made of the plan.
    """

    number: int
    status: Status
    cost: float
    iterations: int
    score: float

    @property
    def rank(self) -> tuple[bool, float, int]:
        """Least for the best: converged before others, then the least score."""
        return self.status is not Status.CONVERGED, self.score if math.isfinite(self.score) else math.inf, self.number

    def __str__(self) -> str:
        return f"{self.number:5d}  {self.cost:15.8g}  {self.iterations:10d}  {self.status.name}"

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes."""
        return f"{'start':>5}  {'cost':>15}  {'iterations':>10}  status"


@dataclass(frozen=True, eq=False)
class Plan:
    """An optimized motion with the gains that hold it.

    Attributes:
        t: (N+1,) s, the knots.
        xs: (N+1, nx) states.
        us: (N, nu) controls, each held over its stage.
        K: (N, nu, ndx) gains of the last Riccati sweep.
        cost: J of Eq. 9.
        gradient_norm: Norm of Eq. 19 at the plan: check optimality from the file.
        status: How the solve ended.
        history: One Iteration per iteration; the last line is the plan itself.
        problem: What was solved; None for a file whose problem is a user's own Python.
        case: Name of the case in planner.cases, or None.
        parameters: Every argument of the case by name.
        twin: The MuJoCo model it is replayed in, or None.
        starts: How each start of a solve with several ended; empty for a single one.
        options: How it was solved: the arguments of solve(), the seed among them.
        changed: What of its file was changed after it was written; empty when nothing, or when it comes from no file.
        hinges: What the ranges of states added to the cost in the last round of the augmented Lagrangian: with it
            the gradient, its norm and the gains. None where nothing was added.
        space: Where the states lie.
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
    starts: tuple[Start, ...] = ()
    stored_space: StateSpace | None = None
    options: dict[str, Any] = field(default_factory=dict)
    changed: tuple[str, ...] = ()
    hinges: Hinges | None = None

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
    def space(self) -> StateSpace:
        """Where the states lie: of the problem's dynamics, or what the file says."""
        if self.problem is not None:
            return space_of(self.problem.dynamics)
        return euclidean(self.xs.shape[1]) if self.stored_space is None else self.stored_space

    @property
    def start(self) -> int:
        """Which of the starts this plan is; 0 is the problem's own first guess."""
        return min(self.starts, key=lambda start: start.rank).number if self.starts else 0

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the software that made the plan."""
        return installed_versions() if self.made_with is None else self.made_with

    def within_bounds(self, n: int, u: np.ndarray) -> np.ndarray:
        """Controls u (..., nu) of stage n, put back within the problem's bounds: what the feedback may ask for."""
        bounds = None if self.problem is None else self.problem.bounds
        return u if bounds is None else np.clip(u, bounds[0][n], bounds[1][n])

    def __str__(self) -> str:
        name = f"{self.case}: " if self.case else ""
        return f"Plan({self.status.name}: {name}{self.nit} iterations, cost {self.cost:.6g}, N = {self.N})"

    __repr__ = __str__

    def save(self, path: str | Path) -> Path:
        """Write the plan as .npz, atomically and without pickle.

        Raises:
            FileError: The file cannot be written.
        """
        own = stored(None if self.problem is None else plain(self.problem))
        objective = None if self.problem is None else self.problem.objective
        meta = {
            "case": self.case,
            "parameters": self.parameters,
            "status": self.status.name,
            "cost": float(self.cost),
            "gradient_norm": float(self.gradient_norm),
            "iterations": self.nit,
            "versions": self.versions,
            "twin": None if self.twin is None else self.twin.to_dict(),
            "mjcf": None if self.twin is None else self.twin.mjcf,
            "space": self.space.to_dict(),
            "starts": [(s.number, s.status.name, float(s.cost), s.iterations, float(s.score)) for s in self.starts],
            "options": self.options,
            "problem": None if own is None else own[0],
            "objective": None if objective is None else objective.weights,
            "limits": None if self.problem is None or self.problem.limits is None else self.problem.limits.to_dict(),
        }
        history = np.array(self.history, dtype=float).reshape(-1, len(Iteration._fields))
        arrays = {"t": self.t, "xs": self.xs, "us": self.us, "K": self.K, "history": history}
        if self.hinges is not None:
            arrays |= dict(zip(HINGES, self.hinges, strict=True))
        for name, content in ({} if self.twin is None else self.twin.assets).items():
            arrays[ASSET + name] = np.frombuffer(content, np.uint8)
        for name, part in ({} if own is None else own[1]).items():
            arrays[PART + name] = part
        write_archive(plan_name(path), arrays, meta)
        return Path(path)

    @classmethod
    def load(cls, path: str | Path, *, problem: Problem | None = None) -> Plan:
        """Read a plan.npz and rebuild its problem.

        Args:
            path: The file.
            problem: What was solved, for a plan whose dynamics or cost is its maker's own Python.

        Raises:
            FileError: No such file, not a plan, damaged, or written by a newer version.
            PlannerError: The problem given is not of the plan's sizes.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise FileError(f"cannot read a plan from a {type(path).__name__}, expected the path of a plan.npz.")
        arrays, meta = read_archive(Path(path), len(Iteration._fields))
        assets = {name.removeprefix(ASSET): arrays[name].tobytes() for name in arrays if name.startswith(ASSET)}
        try:
            plan = cls(
                *(arrays[name] for name in ("t", "xs", "us", "K")),
                cost=_number(meta["cost"]),
                gradient_norm=_number(meta["gradient_norm"]),
                status=_status(meta["status"]),
                history=tuple(Iteration(int(row[0]), *map(float, row[1:])) for row in arrays["history"]),
                case=meta["case"],
                parameters=meta["parameters"],
                twin=None if meta["twin"] is None else Twin.from_dict(meta["mjcf"], meta["twin"], assets),
                made_with=meta["versions"],
                starts=tuple(
                    Start(index, _status(status), _number(cost), iterations, _number(score))
                    for index, status, cost, iterations, score in meta["starts"]
                ),
                stored_space=meta["space"],
                options=meta["options"],
                changed=meta["changed"],
                hinges=Hinges(*(arrays[name] for name in HINGES)) if HINGES[0] in arrays else None,
            )
            if problem is not None:
                return replace(plan, problem=_fitting(plan, problem))
            parts = {name.removeprefix(PART): arrays[name] for name in arrays if name.startswith(PART)}
            return replace(plan, problem=_rebuilt(plan, meta, parts))
        except PlannerError as error:
            raise FileError(f"{printable(path)} is damaged or of a case that cannot be rebuilt: {error}") from None
        except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError, MemoryError) as error:
            reason = " ".join(f"{type(error).__name__} in its meta, {error}".split()).rstrip(" ,.")
            raise FileError(f"{printable(path)} is damaged: {reason}.") from None


def _number(value: float | None) -> float:
    """A number of a JSON file, where null stands for what is not finite."""
    return math.nan if value is None else float(value)


def _status(name: str) -> Status:
    return Status[choice("status", name, Status.__members__)]


def _rebuilt(plan: Plan, meta: dict[str, Any], parts: dict[str, np.ndarray]) -> Problem | None:
    """The problem of a stored plan, with its limits and its objective; None where it is its maker's own Python."""
    from planner import cases
    from planner.cases import problem_file  # these build on everything above; only a file's name leads back here

    if meta["problem"] is not None:
        problem = rebuilt(meta["problem"], parts, plan.twin)
    elif plan.case is None:
        return None
    else:
        own = plan.case == problem_file.CASE
        problem = problem_file.rebuilt(plan.parameters, plan.twin) if own else cases.build(plan.case, **plan.parameters)
        if problem.parameters != plan.parameters:
            missing = sorted(set(problem.parameters) - set(plan.parameters))
            raise PlannerError(
                f"its parameters are not complete (missing: {', '.join(missing) or 'none, but changed'})."
            )
    limits = problem.limits if meta["limits"] is None else Limits.from_dict(meta["limits"])
    problem = replace(plain(problem), limits=limits)
    return _fitting(plan, problem if meta["objective"] is None else with_objective(problem, meta["objective"]))


def _fitting(plan: Plan, problem: Problem) -> Problem:
    """The problem, when a plan's arrays and maps are of its sizes."""
    if plan.stored_space != space_of(problem.dynamics) or plan.us.shape != (problem.N, problem.dynamics.nu):
        raise PlannerError(f"its arrays do not fit its {f'case {plan.case!r}' if plan.case else 'problem'}.")
    if plan.hinges is not None and (
        problem.ranges is None or plan.hinges.weight.shape[1] != len(problem.ranges.component)
    ):
        raise PlannerError("what its limits add to the cost does not fit its problem's ranges.")
    if plan.twin is not None and len(plan.twin.to_x) != problem.dynamics.nx:
        raise PlannerError(f"its twin is of {len(plan.twin.to_x)} states, expected {problem.dynamics.nx}.")
    return problem
