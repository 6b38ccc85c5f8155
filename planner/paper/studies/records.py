"""Results of solves as records of JSON values, and records as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from planner.paper.methods.splines import SplineDescent
from planner.problem.plan import Plan


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
