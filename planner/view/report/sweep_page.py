"""index.html of a sweep: maps of success, cost and iterations, what a click on a task shows; needs no other file."""

from __future__ import annotations

import json
import math
from html import escape
from pathlib import Path
from typing import Any

from planner.base.json_files import finite
from planner.sweeps.store import CSV, PARQUET
from planner.sweeps.sweeping import Sweep
from planner.view.report.markup import number, table, write_page
from planner.view.report.sweep_maps import CSS, WIDE, Map, bar, colour, maps_of, mark_jumps, picture, word

NAME = "index.html"
LEGEND = "green: proven, light green: converged and not proven, red: FAIL or not converged"
_GOOD, _UNPROVEN, _BAD = "#2a9d5c", "#8fbf5f", "#d1495b"
_SHOWN = 14  # columns of the row that a click shows, beside the parameters
_SCRIPT = """
const rows = JSON.parse(document.getElementById("rows").textContent), detail = document.getElementById("detail");
function cell(text, kind) { const one = document.createElement(kind); one.textContent = text; return one; }
document.addEventListener("click", event => {
  const task = event.target.dataset && event.target.dataset.t, row = task && rows[task];
  if (!row) return;
  detail.replaceChildren(cell("Task " + task, "h3"));
  const made = document.createElement("table");
  for (const [name, value] of Object.entries(row)) {
    const line = made.insertRow();
    line.append(cell(name, "th"), cell(value === null ? "" : value, "td"));
  }
  detail.append(made);
  if (row.plan) {
    const where = decodeURI(location.pathname).replace(/[^/]*$/, "") + row.plan;
    const link = cell("the archive with its plan", "a");
    link.href = row.plan.replace(/\\/[^/]*$/, "");
    detail.append(link, cell("planner report " + where + "\\nplanner render " + where, "pre"));
  }
});
"""


def write_sweep_page(sweep: Sweep) -> Path:
    """Write the page into the sweep's folder.

    Raises:
        FileError: It cannot be written.
    """
    maps = maps_of(sweep.grid)
    drawn = {int(task) for one in maps for task in one.tasks.flat}
    rows = {row["task"]: row for row in sweep.rows() if row["task"] in drawn}
    parts = []
    for one in maps:
        mark_jumps(one, (rows[task] for task in map(int, one.tasks.flat) if task in rows))
        parts.append(_section(one, sweep, rows))
    left = len(sweep.grid) - len(drawn)
    more = f'<p class="soft">{left} more tasks are in the table alone.</p>' if left else ""
    counts = {"Tasks": f"{sweep.finished} of {len(sweep.grid)}", **sweep.statuses}
    data = json.dumps(finite({task: _detail(row, sweep) for task, row in rows.items()})).replace("<", "\\u003c")
    written = [name for name in (CSV, PARQUET) if (sweep.folder / name).exists()]
    tables = ", ".join(f'<a href="{name}">{name}</a>' for name in written)
    title = f"Sweep over {', '.join(sweep.grid.values)}"
    head = (
        f"<h1>{escape(title)}</h1>\n{table(counts)}\n<p>Tables: {tables}. A click on a task shows it below, with the "
        "commands for its plan. A line separates neighbours in different minima, by their cost and motion.</p>"
    )
    detail = f'{more}\n<div id="detail"></div>\n<script type="application/json" id="rows">{data}</script>'
    return write_page(sweep.folder / NAME, title, [head, *parts, detail, f"<script>{_SCRIPT}</script>"], CSS)


def _section(one: Map, sweep: Sweep, rows: dict[int, dict[str, Any]]) -> str:
    constant = ", ".join(f"{name} = {word(value)}" for name, value in one.constant.items())
    pictures = [
        picture("Success", LEGEND, one, sweep.grid, {t: _success(row) for t, row in rows.items()}),
        _scale("Cost", "cost", one, sweep, rows),
        _scale("Iterations", "iterations", one, sweep, rows),
    ]
    head = f"<h2>{escape(constant)}</h2>\n" if constant else ""
    pairs = "pair of neighbours is" if len(one.jumps) == 1 else "pairs of neighbours are"
    jumps = f"<p>{len(one.jumps)} {pairs} in different minima.</p>" if one.jumps else ""
    few = " few" if one.tasks.shape[1] <= WIDE else ""
    return f'{head}<div class="three{few}">{"".join(pictures)}</div>{jumps}'


def _success(row: dict[str, Any]) -> str:
    if row.get("verdict"):
        return _GOOD if row["verdict"] == "PASS" else _BAD
    return _UNPROVEN if row["status"] == "CONVERGED" else _BAD


def _scale(title: str, name: str, one: Map, sweep: Sweep, rows: dict[int, dict[str, Any]]) -> str:
    """A map of a number, on a logarithmic scale where it spans more than a factor of ten."""
    found = {
        int(task): float(rows[int(task)][name])
        for task in one.tasks.flat
        if int(task) in rows and rows[int(task)]["status"] == "CONVERGED" and math.isfinite(rows[int(task)][name])
    }
    if not found:
        return picture(title, "no task converged", one, sweep.grid, {})
    low, high = min(found.values()), max(found.values())
    scaled = math.log if low > 0.0 and high > 10.0 * low else float
    first, last = scaled(low), scaled(high)
    colours = {
        task: colour((scaled(value) - first) / (last - first) if last > first else 0.0) for task, value in found.items()
    }
    how = ", logarithmic" if scaled is math.log else ""
    return picture(title, bar(number(low), number(high)) + how, one, sweep.grid, colours)


def _detail(row: dict[str, Any], sweep: Sweep) -> dict[str, Any]:
    """The part of a row that a click shows."""
    first = [name for name in row if name not in ("task", "print", "start", "guess")][: len(sweep.grid.values) + _SHOWN]
    names = dict.fromkeys([*first, *(name for name in ("reason", "plan") if row.get(name))])
    return {name: row[name] for name in names}
