"""A study of one part of the paper: it computes, writes a page, fills rows of the table and draws pictures.

With it: results of solves as records of JSON values, records as Markdown tables, and errors of the gradient of Eq. 7.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from planner.paper.methods.splines import SplineDescent
from planner.problem.plan import Plan
from planner.view.plots.style import dress

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Result = TypeVar("Result")


class Row(NamedTuple):
    """A row of the table: section of the paper, what the paper says, what we get, and why it differs."""

    where: str
    paper: str
    ours: str
    why: str


@dataclass(frozen=True)
class Study:
    """One part of the paper beside ours."""

    name: str  # in the command and in file names
    title: str  # one line about it
    run: Callable[..., dict[str, Any]]  # computes the results, as JSON values, in a short time
    lines: Callable[[dict[str, Any]], list[str]]  # of a page of Markdown, from the results
    rows: Callable[[dict[str, Any]], list[Row]]  # of the table, from the results
    pictures: Mapping[str, Callable[[dict[str, Any], Path], None]] = field(default_factory=dict)
    """For each file name a function that draws it, given the results and a path."""
    seconds: float = 10.0  # rough duration; the longest studies start first
    full: Callable[[], dict[str, Any]] | None = None  # computes those of the documents, where they take longer

    def page(self, results: dict[str, Any]) -> str:
        """The page of Markdown."""
        return "\n".join(self.lines(results)).rstrip("\n") + "\n"


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """The result of some work, and the seconds that it took."""
    began = time.perf_counter()
    return work(), time.perf_counter() - began


def plan_record(plan: Plan) -> dict[str, Any]:
    """Status, iterations and cost of a plan."""
    return {"status": plan.status.name, "iterations": plan.nit, "cost": plan.cost}


def descent_record(found: SplineDescent) -> dict[str, Any]:
    """The numbers of a descent among splines, and its message."""
    names = ("cost", "first_cost", "iterations", "evaluations", "success", "message", "gradient_norm")
    return {name: getattr(found, name) for name in names}


def table(columns: Mapping[str, str], records: Iterable[Mapping[str, Any]]) -> list[str]:
    """Lines of a Markdown table with a row for each record, whose values fill the formats of the columns by head.

    A column, such as {"cost": "{cost:.3f}"}, is right-aligned where all of its cells begin with a number.
    """
    rows = [[form.format(**record) for form in columns.values()] for record in records]
    columned = zip(*rows, strict=True)
    marks = ["---:" if all(cell[:1] in "-*0123456789" for cell in cells) else "---" for cells in columned]
    return [row_of(columns), f"|{'|'.join(marks)}|", *map(row_of, rows)]


def row_of(cells: Iterable[str]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


Evaluated = tuple[float, np.ndarray]
"""J and its gradient."""


def errors_at(point: str, exact: Evaluated, values: Sequence[Evaluated]) -> dict[str, Any]:
    """Errors of J and its gradient at a named point: `values` at each tolerance, `exact` at a very tight one."""
    J, gradient = exact
    size = float(np.linalg.norm(gradient))
    return {
        "point": point, "cost": J, "gradient_norm": size,
        "cost_errors": [abs(value - J) / abs(J) for value, _ in values],
        "relative_errors": [float(np.linalg.norm(g - gradient)) / size for _, g in values],
    }  # fmt: skip


def errors_table(points: Sequence[dict[str, Any]], tolerances: Sequence[float]) -> list[str]:
    """Lines of a Markdown table: a row for each point, a column for each tolerance."""
    columns = {f"{tolerance:g}": f"{{relative_errors[{i}]:.1e}}" for i, tolerance in enumerate(tolerances)}
    return table({"at": "{point}", "gradient": "{gradient_norm:.3g}", **columns}, points)


def draw_errors(axes: Axes, title: str, points: Sequence[dict[str, Any]], tolerances: Sequence[float]) -> None:
    """A curve for each point, from loose to tight tolerances."""
    dress(axes, title, "relative error of the gradient", "tolerance of the integration")
    for point in points:
        label = f"{point['point']}: gradient {point['gradient_norm']:.2g}"
        axes.loglog(tolerances, point["relative_errors"], marker="o", ms=4, label=label)
    axes.invert_xaxis()
