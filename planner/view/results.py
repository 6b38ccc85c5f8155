"""How results look: a figure, the HTML of a notebook, a film, a page. planner.base.late_imports calls this."""

from __future__ import annotations

import base64
import io
from html import escape
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner.control.judging import judge
from planner.control.simulating import ClosedLoopRun
from planner.problem.plan import Plan
from planner.proof import Proof
from planner.proof.replays.replaying import Replay
from planner.sweeps.sweeping import Sweep
from planner.view.plots.case_pictures import draw_loop
from planner.view.plots.plan import draw_plan
from planner.view.plots.proof import draw_proof
from planner.view.report.sweep_page import word, write_sweep_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 72  # of pictures in a notebook, which keeps them in its file
_GREEN, _AMBER, _RED, _GREY = "#1a7f37", "#8a5a00", "#b3261e", "#57606a"


def figure_of(result: Plan | Replay | Proof) -> Figure:
    """States, controls and convergence of a plan; a replay beside its plan; a loop; what a proof measured."""
    if isinstance(result, Proof):
        return draw_proof(result)
    if isinstance(result, ClosedLoopRun):
        return draw_loop(judge(result))
    return draw_plan(result.plan, result) if isinstance(result, Replay) else draw_plan(result, None)


def html_of(result: Plan | Replay | Proof) -> str:
    """A line about a result and, beneath it, its motion as a picture: HTML without links and without scripts."""
    if isinstance(result, Proof):
        colour = _AMBER if result.misleads else _GREEN if result.passed else _RED
        word, rest = result.verdict, result.headline[len(result.verdict) :]
        text, figure = f"{result.reason} {result.own_step}".strip(), draw_plan(result.replay.plan, result)
    elif isinstance(result, ClosedLoopRun):
        judged = judge(result)
        word, colour, rest = judged.verdict, _GREEN if judged.passed else _RED, judged.headline[len(judged.verdict) :]
        text, figure = " ".join([judged.reason, *map(str, result.events[:3])]).strip(), draw_loop(judged)
    elif isinstance(result, Replay):
        word, colour, rest, text = "Replay", _GREY, repr(result).removeprefix("Replay"), " ".join(result.warnings)
        figure = draw_plan(result.plan, result)
    else:
        word, colour, rest = result.status.name, _GREEN if result.success else _RED, result.summary
        text, figure = result.message, draw_plan(result, None)
    return (
        f'<div><strong style="color:{colour}">{escape(word)}</strong> {escape(rest.strip(" ;"))}'
        f"<p>{escape(text)}</p>{_picture(figure)}</div>"
    )


_ROWS = 10  # of a sweep in a notebook
_COLUMNS = ("status", "cost", "iterations", "verdict")


page_of = write_sweep_page


def html_of_sweep(sweep: Sweep) -> str:
    """How the tasks of a sweep ended, and a table of the first rows: HTML without links and without scripts."""
    columns = ("task", *sweep.grid.values, *_COLUMNS)
    rows = [[word(row.get(name, "")) for name in columns] for row in islice(sweep.rows(), _ROWS)]
    lines = [f"<tr>{''.join(f'<{kind}>{escape(cell)}</{kind}>' for cell in cells)}</tr>"
             for kind, cells in (("th", columns), *(("td", cells) for cells in rows))]  # fmt: skip
    more = f"<p>{sweep.finished - len(rows)} more rows.</p>" if sweep.finished > len(rows) else ""
    return f"<div><strong>{escape(str(sweep))}</strong><table>{''.join(lines)}</table>{more}</div>"


def film_of(result: Replay | Proof, path: str | Path, **options: Any) -> Path:
    """The film of a replay, or of both replays of a proof: see render_video."""
    from planner.view.render.video import render_video

    return render_video(result, path, **options)


def _picture(figure: Figure) -> str:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=_DPI)
    data = base64.b64encode(content.getvalue()).decode("ascii")
    return f'<img alt="states and controls over time" src="data:image/png;base64,{data}">'
