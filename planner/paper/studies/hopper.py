"""The hopper, the paper's numerical example (section 4).

The paper's own method: "a simple Euler approximation", N = 50, zero first guess, open-loop update (Eq. 36), Armijo
rule. It does not say which Euler, nor q_fin, nor its stopping rule. Both Eulers stand side by side against the numbers
that it gives; q_fin and the rule are varied, since the iteration counts depend on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.cases.hopper import PAPER, crossings
from planner.paper.studies.study import Row, Study, row_of, table
from planner.problem.plan import Plan
from planner.proof.replays.replaying import replay
from planner.solvers.slq import solve
from planner.view.plots.style import HUES, INK, dress, grid_of, save

HEIGHTS = (1.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0)
PAPER_ITERATIONS = {1.0: 3, 50.0: 166}  # section 4
EULERS = {"semi-implicit": "semi-implicit-euler", "explicit": "euler"}
READINGS: dict[str, dict[str, Any]] = {
    "": {}, ", q_fin on both final terms of Eq. 8": {"speed_weight": 2.0 * float(PAPER["final_weight"])},
    ", feedback update (our default)": {"update": "feedback"},
}  # fmt: skip
"""Arguments of paper_plan(). Eq. 8 has no 1/2 on the final rate, so a weight there is twice as large here."""
SWEPT = {  # arguments of paper_plan() and the values that each takes
    "final_weight": (10.0, 100.0, 1000.0, 1e4, 1e5), "tolerance": (1e-3, 1e-6, 1e-10),
    "flow_weight": (0.1, 1.0, 10.0, 100.0), "smoothing": (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
}  # fmt: skip
LABELS = {"final_weight": "q_fin", "tolerance": "tolerance", "flow_weight": "r", "smoothing": "alpha"}
ALPHAS = SWEPT["smoothing"][1:]
WAYS: dict[str, tuple[bool, dict[str, Any]]] = {
    "open-loop, from zero": (False, {}),
    "feedback, from zero": (False, {"update": "feedback"}),
    "feedback, by continuation": (True, {"update": "feedback"}),
    "exact Hessians, from zero": (False, {"update": "feedback", "hessian": "exact"}),
}
"""How a small alpha is come to: whether from the solution at the one before, and the options of a solve."""
SCENES = ((20.0, 1.0), (50.0, 1.0), (50.0, 3.0))  # (height, duration) whose phases are drawn; the last one is ours
LIMIT = 2000  # iterations; a solve that needs more counts as failed


def paper_plan(
    height: float, *, update: str = "open-loop", tolerance: float = 1e-10, us: np.ndarray | None = None,
    hessian: str = "gauss-newton", **changes: Any,
) -> Plan:  # fmt: skip
    """The paper's hopper problem for a height, solved by the paper's method or with changes."""
    problem = replace(cases.build("hopper", height=height, **{**PAPER, **changes}), us=us)
    return solve(problem, update=update, hessian=hessian, max_iterations=LIMIT, expected_reduction_tolerance=tolerance)


def _count(plan: Plan) -> int | None:
    return plan.nit if plan.success else None


def _run() -> dict[str, Any]:
    def counts(**options: Any) -> list[int | None]:
        return [_count(paper_plan(height, **options)) for height in HEIGHTS]

    readings = [
        {"name": f"{name}{reading}", "iterations": counts(integrator=integrator, **options),
         "by_r": [_count(paper_plan(HEIGHTS[-1], integrator=integrator, flow_weight=r, **options))
                  for r in SWEPT["flow_weight"]]}
        for reading, options in READINGS.items() for name, integrator in EULERS.items()
    ]  # fmt: skip
    return {
        "case": "hopper", "heights": list(HEIGHTS), "readings": readings,
        "paper_iterations": [PAPER_ITERATIONS.get(height) for height in HEIGHTS],
        **{f"iterations_by_{name}": {f"{value:g}": counts(**{name: value}) for value in values}
           for name, values in SWEPT.items()},
        "alphas": list(ALPHAS), "small_alpha": {name: _small_alpha(*way) for name, way in WAYS.items()},
        "phases": [_phases(*scene) for scene in SCENES],
        "replayed": [_replayed(name, height) for name in EULERS for height in (20.0, 50.0)],
    }  # fmt: skip


def _small_alpha(continued: bool, options: dict[str, Any]) -> list[int | None]:
    """Iterations at the greatest height for ever smaller alpha."""
    found, us = [], None
    for alpha in ALPHAS:
        plan = paper_plan(HEIGHTS[-1], smoothing=alpha, us=us if continued else None, **options)
        found.append(_count(plan))
        us = plan.us
    return found


def _phases(height: float, duration: float) -> dict[str, Any]:
    """Stance and flight of the plan at the paper's step."""
    plan = paper_plan(height, duration=duration, horizon=round(duration * int(PAPER["horizon"])))
    events = crossings(plan.t, plan.xs, float(plan.parameters["smoothing"]))
    return {
        "height": height, "duration": duration, "status": plan.status.name,
        "touchdowns_s": [float(t) for t, rate in events if rate > 0.0],
        "lift_offs_s": [float(t) for t, rate in events if rate < 0.0],
        "t_s": plan.t.tolist(), "height_in": plan.xs[:, 0].tolist(), "piston_in": plan.xs[:, 2].tolist(),
        "flow_in_per_s": plan.us[:, 0].tolist(),
    }  # fmt: skip


def _replayed(name: str, height: float) -> dict[str, Any]:
    plan = paper_plan(height, integrator=EULERS[name])
    planned, reached = plan.xs[-1].tolist(), replay(plan).xs[-1].tolist()
    return {
        "euler": name, "height": height, "planned_height": planned[0], "planned_rate": planned[1],
        "reached_height": reached[0],
    }  # fmt: skip


def _cells(cells: Sequence[Any]) -> list[str]:
    return ["failed" if cell is None else str(cell) for cell in cells]


def _rises(cells: Sequence[int | None]) -> bool:
    known = [LIMIT if cell is None else cell for cell in cells]
    return all(a <= b for a, b in pairwise(known))


def _evidence(results: dict[str, Any]) -> str:
    """What each Euler has in common with the print."""
    said = []
    for one in results["readings"][: len(EULERS)]:
        first, last = results["paper_iterations"][0], one["iterations"][-1]
        reached = [row["reached_height"] / row["height"] for row in results["replayed"] if row["euler"] == one["name"]]
        said.append(
            f"{one['name']} Euler: {_cells(one['iterations'])[0]} at {results['heights'][0]:g} in (print: {first}) to "
            f"{_cells([last])[0]} at {results['heights'][-1]:g} in, "
            f"{'never fewer' if _rises(one['iterations']) else 'at times fewer'} for a higher hop; "
            f"{'fewer' if _rises(one['by_r'][::-1]) else 'not always fewer'} with every larger r; MuJoCo reaches "
            f"{100 * min(reached):.0f} to {100 * max(reached):.0f} % of the height"
        )
    return ". ".join(said)


def _fails_at(cells: Sequence[int | None], alphas: Sequence[float]) -> str:
    """Down to where a way converges, and where it fails."""
    good = [f"{alpha:g} ({cell})" for alpha, cell in zip(alphas, cells, strict=True) if cell is not None]
    bad = [f"{alpha:g}" for alpha, cell in zip(alphas, cells, strict=True) if cell is None]
    return f"down to {good[-1] if good else 'none'}" + (f", fails at {', '.join(bad)}" if bad else "")


def _page(results: dict[str, Any]) -> list[str]:
    heads = ["", *(f"{height:g}" for height in results["heights"])]
    over_r = [f"r = {r:g}" for r in SWEPT["flow_weight"]]
    known = ["not given" if cell is None else str(cell) for cell in results["paper_iterations"]]
    swept = [
        row_of([f"{label} = {value}", *_cells(cells)])
        for name, label in LABELS.items() for value, cells in results[f"iterations_by_{name}"].items()
    ]  # fmt: skip
    alphas = [f"{alpha:g}" for alpha in results["alphas"]]
    lines = [
        "# The paper's hopper (section 4) beside ours", "",
        "Problem and method are the paper's: N = 50, t_f = 1 s, k/m = 100, g = 386.4, alpha = 0.1, q = 1000, r = 1,",
        "states and controls zero at first, open-loop update (Eq. 36), Armijo's rule; q_fin = 1000 is our choice. A",
        f"solve stops when the LQ model promises less than 1e-10 of the cost; failed: not within {LIMIT} iterations.",
        "", "![heights, pistons and flows with stance shaded](hopper.png)", "",
        'Iterations by goal height (in), and by r at the greatest. The print says "a simple Euler approximation":', "",
        row_of([*heads, *over_r]), f"| --- |{' ---: |' * (len(heads) - 1 + len(over_r))}",
        row_of(["paper", *known, "slower", "", "", "faster"]),
        *(row_of([one["name"], *_cells(one["iterations"]), *_cells(one["by_r"])]) for one in results["readings"]), "",
        f"{_evidence(results)}. What follows is by {PAPER['integrator']}.", "",
        row_of(heads), f"| --- |{' ---: |' * (len(heads) - 1)}", *swept, "",
        f"Small alpha at {results['heights'][-1]:g} in. Continuation starts from the controls at the alpha before:", "",
        row_of(["", *alphas]), f"| --- |{' ---: |' * len(alphas)}",
        *(row_of([way, *_cells(cells)]) for way, cells in results["small_alpha"].items()), "",
    ]  # fmt: skip
    for phase in results["phases"]:
        down, up = (", ".join(f"{t:.3f}" for t in phase[key]) for key in ("touchdowns_s", "lift_offs_s"))
        lines.append(
            f"- height {phase['height']:g}, t_f = {phase['duration']:g} s: touchdown at {down} s; lift-off at {up} s"
        )
    return [
        *lines, "", *table({
            "Euler": "{euler}", "height, in": "{height:g}", "planned, in": "{planned_height:.2f}",
            "planned final rate, in/s": "{planned_rate:.2f}", "reached in MuJoCo, in": "{reached_height:.2f}",
        }, results["replayed"]),
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    low, high = results["heights"][0], results["heights"][-1]

    def ends(cells: Sequence[Any]) -> str:
        first, *_, last = _cells(cells)
        return f"{first} at {low:g} in, {last} at {high:g} in"

    def spread(name: str) -> str:
        lasts = [cells[-1] for cells in results[name].values() if cells[-1] is not None]
        return f"{min(lasts)} to {max(lasts)}"

    first, *_, longest = results["phases"]
    stances = f"{len(first['touchdowns_s'])} touchdowns within 1 s at height {first['height']:g}, "
    stances += f"{len(longest['touchdowns_s'])} within {longest['duration']:g} s at height {longest['height']:g}"
    r = ", ".join(f"{value:g}" for value in SWEPT["flow_weight"])
    ways = (f"{way}: {_fails_at(cells, results['alphas'])}" for way, cells in results["small_alpha"].items())
    return [
        Row("2.4, Eq. 8", "A weight q_fin on the final height, of which no value is given; the final rate has none",
            "1000 taken; " + "; ".join(
                f"q_fin = {q}: {ends(cells)}" for q, cells in results["iterations_by_final_weight"].items()
            ),
            "the paper does not say; the counts of section 4 depend on it. "
            + "; ".join(f"{one['name']}: {ends(one['iterations'])}" for one in results["readings"][2:4])),
        Row("4", "A simple Euler approximation with N = 50; 3 iterations for y_N = 1 to 166 for y_N = 50",
            "; ".join(f"{one['name']}: {', '.join(_cells(one['iterations']))}" for one in results["readings"][:2])
            + f" for {', '.join(f'{h:g}' for h in results['heights'])} in",
            f"{_evidence(results)}. q_fin and the stopping rule are not given: at {high:g} in they alone move "
            f"the count ({spread('iterations_by_final_weight')} and {spread('iterations_by_tolerance')})"),
        Row("4", "Converged much faster when the weighting r is increased",
            f"at {high:g} in for r = {r}: "
            + "; ".join(f"{one['name']} {', '.join(_cells(one['by_r']))}" for one in results["readings"][:2]),
            "it does not differ where every larger r needs fewer; low hops take a few iterations at any r"),
        Row("4", "Failed to converge for alpha < 1e-5", f"at {high:g} in (iterations), {'; '.join(ways)}",
            f"failed is not within {LIMIT} iterations: slow, not divergent. The paper's update from zero fails sooner "
            "than printed, continuation by the feedback update near where it is printed, and exact Hessians, which "
            "see the spring's curvature, lift the limit"),
        Row("4, figure of the hop",
            "An alternating sequence of stance and flight, with its switches found by the algorithm",
            stances, "agrees in kind; the figure has no numbers to compare"),
        Row("4", "Plans of 50 steps in the continuous machine: not asked",
            "; ".join(f"{row['euler']}: {row['reached_height']:.2f} of {row['height']:g} in in MuJoCo"
                      for row in results["replayed"]),
            "50 steps are coarse by either Euler; explicit Euler adds energy at every step, which the optimizer uses"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Heights, pistons and controls of the paper's problem with stance shaded, and the iteration counts."""
    figure, grid = grid_of(2, 4, 14.0, 6.2)
    for column, phase in enumerate(results["phases"]):
        top, bottom = grid[0, column], grid[1, column]
        t, y, piston = (np.array(phase[name]) for name in ("t_s", "height_in", "piston_in"))
        # ContactRecorder counts from half the smoothing on, as in the list of events.
        e = piston - y - 0.5 * float(PAPER["smoothing"])
        top.plot(t, y, color=HUES[0][1], label="height y")
        top.plot(t, piston, color=HUES[1][1], label="piston $y_p$")
        top.axhline(phase["height"], color="0.6", lw=0.8, ls=":")
        bottom.step(t[:-1], phase["flow_in_per_s"], where="post", color=HUES[2][1], label="flow u")
        for axes in (top, bottom):
            low, high = axes.get_ylim()
            axes.fill_between(t, low, high, where=np.asarray(e > 0.0), color="0.5", alpha=0.15, lw=0)
            axes.set_ylim(low, high)
            axes.set_xlim(0.0, t[-1])
            axes.legend(fontsize=8, frameon=False, loc="upper left")
        title = f"height {phase['height']:g} in, {phase['duration']:g} s (stance shaded)"
        dress(top, title, "" if column else "height and piston, in")
        dress(bottom, "", "" if column else "flow, in/s", "time, s")
    counts, small = grid[:, 3]
    heights = results["heights"]
    for one in results["readings"][:2]:
        counts.semilogy(heights, [np.nan if c is None else c for c in one["iterations"]], marker="o", ms=4,
                        label=f"{one['name']} Euler")  # fmt: skip
    known = [(h, c) for h, c in zip(heights, results["paper_iterations"], strict=True) if c is not None]
    counts.semilogy(*zip(*known, strict=True), ls="", marker="*", ms=11, color=INK, label="paper")
    dress(counts, "by height, q_fin = 1000", "iterations", "goal height, in")
    counts.legend(fontsize=8, frameon=False)
    for way, cells in results["small_alpha"].items():
        points = [point for point in zip(results["alphas"], cells, strict=True) if point[1] is not None]
        small.loglog(*zip(*points, strict=True), marker="o", ms=4, label=way)
    small.axvline(1e-5, color="0.6", lw=0.8, ls=":")
    dress(small, f"by smoothing, {heights[-1]:g} in; no point: failed", "iterations", "smoothing alpha, in")
    small.set_ylim(top=2e4)  # room for the legend
    small.legend(fontsize=8, frameon=False, loc="upper left")
    save(figure, path)


STUDY = Study("hopper", "the numerical example (section 4)", _run, _page, _rows, {"hopper.png": _draw}, seconds=25)
