"""Recipe: how a problem was built, so that it can be built again with another step, or from a plan's file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner.base.errors import PlannerError

PROBLEM_FILE = "problem-file"  # the name of a problem.toml's recipe, whatever its machine
ROUNDING = 1e-14  # quaternions that are normalized twice differ by as much


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
