"""Parts of a Problem: its Recipe, its Objective, and what of it is Periodic.

A recipe says how a problem was built, so that it can be built again with another step, or from a plan's file. Nothing
slow is imported: what is wrong with an objective or a number of stages is said at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner.base.arguments import choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.model.space import StateMap, StateSpace
from planner.problem.costs.terms import Cost

PROBLEM_FILE = "problem-file"  # the name of a problem.toml's recipe, whatever its machine
ROUNDING = 1e-14  # quaternions that are normalized twice differ by as much
STEPS = ("newton", "follow")
OBJECTIVES = ("effort", "energy", "jerk", "time")
FOUND = "duration_found"  # beside the weights of a stored objective
MAX_STAGES = 100_000


class Built:
    """Name and arguments of the recipe that a problem, or a plan, may have."""

    recipe: Recipe | None

    @property
    def case(self) -> str | None:
        """Name of the recipe: a case of planner.cases, or "problem-file"; None without a recipe."""
        return None if self.recipe is None else self.recipe.name

    @property
    def parameters(self) -> dict[str, Any]:
        """Arguments of the recipe by name; none without a recipe."""
        return {} if self.recipe is None else self.recipe.parameters


@dataclass(frozen=True)
class Recipe:
    """The function that builds a problem, and its arguments."""

    name: str  # Of the function, as a plan's file has it: a case of planner.cases, or "problem-file"
    parameters: dict[str, Any]  # Every argument by name, as JSON values
    # (**parameters) -> Problem; None in a plan whose problem was not built again.
    build: Callable[..., Any] | None = field(default=None, compare=False, repr=False)
    # Arrays that were sought when it was built, by name: a plan's file has them, so that loading it seeks none.
    found: Mapping[str, np.ndarray] = field(default_factory=dict, compare=False, repr=False)
    _parts: tuple[Any, ...] = field(default=(), compare=False, repr=False)  # of the problem that was built

    def of(
        self, dynamics: Any, cost: Any, x0: np.ndarray, horizon: int, constraints: Sequence[Any] = ()
    ) -> Recipe | None:
        """The recipe of a problem with these parts; None where another problem was built by it.

        dataclasses.replace(problem, cost=...) makes a problem that no recipe describes.
        """
        if not self._parts:
            return replace(self, _parts=(dynamics, cost, x0, horizon, constraints))
        own_dynamics, own_cost, own_start, own_horizon, own_constraints = self._parts
        same = dynamics is own_dynamics and cost is own_cost and horizon == own_horizon
        same = same and x0.shape == own_start.shape and constraints == own_constraints
        return self if same and np.allclose(x0, own_start, ROUNDING, ROUNDING, equal_nan=True) else None

    def rebuilt(self, **changes: Any) -> Any:
        """The problem built with some arguments changed."""
        if self.build is None:
            raise PlannerError(f"what builds {self.name!r} is not known here, expected the problem that was solved.")
        return self.build(**self.parameters | changes)

    def changed(self, **changes: Any) -> Recipe:
        """The recipe of the problem that is built with some arguments changed, where it is made without building it."""
        return replace(self, parameters=self.parameters | changes, found={}, _parts=())


@dataclass(frozen=True, eq=False)
class Objective:
    """The weights of a problem's objective, and its cost without them.

    Attributes:
        weights: Above 0, by names of OBJECTIVES: the arguments of with_objective, and the share of effort.
        base: The problem's cost before with_objective.
        smoothing: Of the energy, W; None until a motion tells (planner.problem.objective.with_smoothing).
        duration_found: Whether the problem's duration is what a search over durations found, for time.
    """

    weights: dict[str, float]
    base: Cost
    smoothing: float | None = None
    duration_found: bool = False

    @property
    def stored(self) -> dict[str, float]:
        """The weights, and what else there is, for with_objective() of the same problem without them."""
        more = {} if self.smoothing is None else {"smoothing": self.smoothing}
        return {**self.weights, **more, **({FOUND: True} if self.duration_found else {})}


def weights_of(objective: Any) -> dict[str, float]:
    """The weights above 0 of an objective: a name, or weights by name."""
    if isinstance(objective, str):
        return {choice("objective", objective, OBJECTIVES): 1.0}
    if not isinstance(objective, Mapping):
        expected = f"expected one of {', '.join(OBJECTIVES)}, or weights by these names"
        raise PlannerError(f"objective is {short_repr(objective)}, {expected}.")
    given = {choice("objective", name, OBJECTIVES): weight for name, weight in objective.items()}
    weights = {name: number(f"the weight of {name}", weight, minimum=0.0) for name, weight in given.items()}
    weights = {name: weights[name] for name in OBJECTIVES if weights.get(name)}
    if not weights:
        raise PlannerError(f"no weight of the objective is above 0, expected some of {', '.join(OBJECTIVES)}.")
    return weights


def durations_or_default(durations: Any, weights: Mapping[str, float], duration: float) -> Any:
    """Durations as given; a fifth and twice the problem's own duration, s, where time is weighed and none are given."""
    return (duration / 5.0, 2.0 * duration) if durations is None and "time" in weights else durations


def checked_durations(durations: Any, weights: Mapping[str, float]) -> tuple[float, float] | None:
    """Checked min and max duration, s: required by an objective with time, None and refused for any other."""
    if "time" not in weights:
        if durations is not None:
            raise PlannerError(f"durations are {short_repr(durations)}, expected none without time in the objective.")
        return None
    pair = isinstance(durations, (Sequence, np.ndarray)) and not isinstance(durations, str) and len(durations) == 2
    if not pair:
        raise PlannerError(
            f"durations is {short_repr(durations)}, expected (shortest, longest) in s, which time needs."
        )
    shortest, longest = (number("a duration", value, greater_than=0.0) for value in durations)
    if not shortest < longest:
        raise PlannerError(f"durations are {shortest:g} and {longest:g} s, expected the shortest before the longest.")
    return shortest, longest


def stages_of(duration: Any, dt: Any) -> tuple[float, int]:
    """The checked dt, s, and the number of stages in a duration, s, which has to be a whole one."""
    duration, dt = number("duration", duration, greater_than=0.0), number("dt", dt, greater_than=0.0)
    if not duration / dt < MAX_STAGES + 0.5:
        raise PlannerError(
            f"duration is {duration:g} s and dt {dt:g} s, {duration / dt:.4g} stages, expected at most {MAX_STAGES}; "
            "both are in s."
        )
    N = round(duration / dt)
    if N < 1 or abs(N * dt - duration) > 1e-9 * duration:
        if dt > duration:
            raise PlannerError(f"dt is {dt:g} s, longer than the duration of {duration:g} s, expected a part of it.")
        near = N * dt
        raise PlannerError(f"duration is {duration:g} s, expected a whole number of stages of {dt:g} s, e.g. {near:g}.")
    return dt, N


@dataclass(frozen=True, eq=False)
class Periodic:
    """The components of the state that return to their start at the end of a trajectory, with tolerances.

    With `image` they return to the image of the start: of a gait it is further along the ground, or mirrored.
    """

    # (ndx,) max closure error of each component of the deviation; infinite for components that need not return, like
    # the travel of a belt. A number applies to all.
    tolerance: np.ndarray
    step: str = "newton"  # Method of solve_periodic to change the start: "newton" or "follow"
    passes: int = 8  # Max number of solves of solve_periodic
    cost_tolerance: float = 1e-3  # Relative change of the cost below which "newton" only reduces the closure error
    image: StateMap | None = None  # From the start to where it returns; None for the start itself
    left_open: tuple[str, ...] = ()  # Names of coordinates that need not return, whatever their tolerance

    def __post_init__(self) -> None:
        try:
            tolerance = np.array(self.tolerance, dtype=float)
        except (TypeError, ValueError):
            tolerance = np.array(np.nan)
        if tolerance.ndim > 1 or not (tolerance > 0.0).all() or not np.isfinite(tolerance).any():
            raise PlannerError(
                "the tolerance of what is periodic has to be a number or one for each component of a deviation, above "
                "0, infinite only for what need not come back."
            )
        choice("step", self.step, STEPS)
        count("passes", self.passes)
        if self.image is not None and not isinstance(self.image, StateMap):
            raise PlannerError(f"image of what is periodic is {short_repr(self.image)}, expected a StateMap, or None.")
        if isinstance(self.left_open, str) or not isinstance(self.left_open, Sequence):
            raise PlannerError(f"left_open of what is periodic is {short_repr(self.left_open)}, expected names.")
        number("cost_tolerance", self.cost_tolerance, minimum=0.0)
        tolerance.flags.writeable = False
        object.__setattr__(self, "tolerance", tolerance)

    def of_coordinates(self, names: Sequence[str]) -> Periodic:
        """The same with a tolerance (ndx,), for a deviation whose coordinates have these names."""
        ndx = len(names)
        if self.tolerance.shape not in ((), (ndx,)):
            shape = self.tolerance.shape
            raise PlannerError(f"the tolerance of what is periodic has shape {shape}, expected ({ndx},).")
        if self.image is not None and self.image.matrix.shape != (ndx, ndx):
            raise PlannerError(
                f"the image of what is periodic is of {len(self.image.matrix)} deviations, expected {ndx}."
            )
        open_ = [choice("what a periodic motion leaves open", name, names) for name in self.left_open]
        tolerance = np.where(np.isin(names, open_), np.inf, self.tolerance)
        if not np.isfinite(tolerance).any():
            raise PlannerError("a periodic motion leaves all of its coordinates open, expected some that return.")
        return replace(self, tolerance=tolerance)

    @property
    def matrix(self) -> np.ndarray:
        """(ndx, ndx) the derivative of where the start returns to by the start."""
        return np.eye(len(self.tolerance)) if self.image is None else self.image.matrix

    @property
    def periodic_mask(self) -> np.ndarray:
        """(ndx,) bool: the components that return."""
        return np.isfinite(self.tolerance)

    def closure_error(self, space: StateSpace, xs: np.ndarray) -> np.ndarray:
        """(ndx,) difference of end and start of states (N+1, nx); zero for components that need not return."""
        start = xs[0] if self.image is None else self.image.apply(space, xs[0])
        return np.where(self.periodic_mask, space.difference(xs[-1], start), 0.0)

    def miss(self, space: StateSpace, xs: np.ndarray) -> float:
        """Max closure error over its tolerance: at most 1 if states (N+1, nx) are periodic."""
        return float(np.max(np.abs(self.closure_error(space, xs)) / self.tolerance))

    def brought(self, space: StateSpace, x: np.ndarray, end: np.ndarray) -> np.ndarray:
        """State x (nx,) with its returning components taken from another state `end` (nx,)."""
        return space.integrate(x, np.where(self.periodic_mask, space.difference(end, x), 0.0))

    def to_dict(self) -> dict[str, Any]:
        """As JSON values; infinity is None."""
        tolerance = [float(value) if np.isfinite(value) else None for value in self.tolerance]
        table = {name: getattr(self, name) for name in ("step", "passes", "cost_tolerance")}
        image = {} if self.image is None else {"image": self.image.to_dict()}
        return {"tolerance": tolerance, **table, "left_open": list(self.left_open), **image}

    @classmethod
    def from_dict(cls, table: dict[str, Any]) -> Periodic:
        """The Periodic of a table that to_dict made."""
        tolerance = np.array([np.inf if value is None else value for value in table["tolerance"]])
        image = StateMap.from_dict(table["image"]) if "image" in table else None
        return cls(**{**table, "tolerance": tolerance, "image": image, "left_open": tuple(table.get("left_open", ()))})
