"""How an iteration grows with joints and stages, and memory with solves: `python benchmarks/scaling.py`.

The phases are told apart through the engine: a sweep with and without linearizing, an iteration of which all but the
line search is done. Times are minima and hold the call from Python, some 10 us. Writes docs/scaling.png.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mechanisms
import numpy as np
from mechanisms import Chain
from planner_worker import posed
from rigid_body_problems import EULER, INTEGRATORS, SHORT, scaling_problem

import planner
from planner.kernels.lq.workspace import ACCEPTED
from planner.kernels.numba.lanes import WIDTH
from planner.solvers.engine import acquire_engine
from planner.view.plots.style import HUES, dress, grid_of, legend_below, save, title_above

KINDS: dict[str, Callable[[int], Chain]] = {"serial chain": mechanisms.serial, "random tree": mechanisms.random_tree}
PHASES = {"linearize": 2.0, "riccati": 3.0, "rollout": 2.0}  # the power of n each may grow with
JOINTS = (2, 3, 4, 6, 8, 12, 16, 20, 24, 32, 40)
STAGES = (50, 100, 200, 400, 800)
BURST = 3  # turns of a point at a time: the first wakes the caches up
FIT_FROM = (2, 12)  # joints; below 12, what a call costs and padding to whole lanes hide some of the growth
ARM = 7  # joints of the arm whose stages are varied
LINEAR = 1.1  # of N: caches hold fewer of many stages
SOLVES, SETTLED = 1000, 100
FLAT = 64 * 1024  # bytes that a thousand solves may leave in Python and NumPy
DOCS = Path(__file__).parent.parent / "docs"


class Point:
    """One size of problem: the least times so far, us, from the first trajectory."""

    def __init__(self, chain: Chain, N: int, integrator: str) -> None:
        self.joints = len(chain["joints"])
        self._best = dict.fromkeys(("both", "sweep", "search"), np.inf)
        self._problem = posed(scaling_problem(chain, N, integrator))
        self._engine = acquire_engine(self._problem)
        self.turn()  # compiles
        self._best = dict.fromkeys(self._best, np.inf)

    def _timed(self, name: str, call: Callable[..., Any], *arguments: Any) -> Any:
        started = time.perf_counter()
        result = call(*arguments)
        self._best[name] = min(self._best[name], 1e6 * (time.perf_counter() - started))
        return result

    def turn(self) -> None:
        """Time each part once."""
        engine = self._engine
        cost = engine.start_from_controls(self._problem.x0, self._problem.first_guess)
        self._timed("both", engine.sweep, 0.0, True)
        self._timed("sweep", engine.sweep, 0.0, False)
        outcome = self._timed("search", engine.iterate, True, 0, 0.0, False, cost, 0.0, -1.0)
        if outcome.kind != ACCEPTED or outcome.step < 0.5 ** (WIDTH - 1):
            sys.exit(f"on {self.joints} joints the search is not one rollout of {WIDTH} candidates.")

    def phases(self) -> dict[str, float]:
        """Least microseconds of each phase."""
        both, sweep, search = self._best.values()
        return {"linearize": both - sweep, "riccati": sweep, "rollout": search - sweep}


def power(x: list[float], y: list[float]) -> float:
    """The slope of y over x in logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def growth(integrator: str, seconds: float) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Points over joints and over stages, and a slope for each phase."""
    points, slopes = [], []

    def series(kind: str, over: str, values: tuple[int, ...], make: Callable[[int], tuple[Chain, int]]) -> None:
        measured = {value: Point(*make(value), integrator) for value in values}
        end = time.perf_counter() + seconds * len(values)
        while time.perf_counter() < end:  # in turn, so that a busy neighbour falls on all of them
            for point in measured.values():
                for _ in range(BURST):
                    point.turn()
        new = [
            {"kind": kind, "over": over, "value": value, "integrator": integrator, **point.phases()}
            for value, point in measured.items()
        ]
        for point in new:
            print(json.dumps(point), flush=True)
        points.extend(new)
        for phase, bound in PHASES.items():
            for least in FIT_FROM if over == "n" else (0,):
                used = [p for p in new if p["value"] >= least]
                slope = power([p["value"] for p in used], [p[phase] for p in used])
                limit = LINEAR if over == "N" else bound
                slopes.append(
                    {
                        "slope_of": phase, "kind": kind, "over": over, "from": used[0]["value"],
                        "integrator": integrator, "slope": slope, "limit": limit, "met": slope <= limit,
                    }
                )  # fmt: skip
                print(json.dumps(slopes[-1]), flush=True)

    for kind, make in KINDS.items():
        series(kind, "n", JOINTS, lambda n, make=make: (make(n), 100))
    series("serial chain", "N", STAGES, lambda N: (mechanisms.serial(ARM), N))
    return points, slopes


def resident() -> int:
    """The process's greatest size so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def memory() -> dict[str, Any]:
    """What is left of a thousand solves of the arm, once the first hundred have filled what there is to fill."""
    problem = posed(scaling_problem(mechanisms.serial(ARM), 100, EULER))
    sizes = []
    tracemalloc.start()
    for i in range(1, SOLVES + 1):
        planner.solve(problem, max_iterations=5)
        if i in (SETTLED, SOLVES):
            sizes.append((tracemalloc.get_traced_memory()[0], resident()))
    tracemalloc.stop()
    (kept, size), (kept_after, size_after) = sizes
    line = {
        "solves": SOLVES, "kept_bytes": kept_after - kept, "process_bytes": size_after - size,
        "met": kept_after - kept <= FLAT,
    }  # fmt: skip
    print(json.dumps(line), flush=True)
    return line


def draw(points: list[dict[str, Any]], path: Path) -> None:
    """The phases over joints and over stages, in logarithms, beside their bounds."""
    panels = [(kind, "n") for kind in KINDS] + [("serial chain", "N")]
    figure, (axes,) = grid_of(1, len(panels), 13.0, 4.4)
    colours = dict(zip(PHASES, (middle for _, middle, _ in HUES), strict=False))
    for ax, (kind, over) in zip(axes, panels, strict=True):
        title = f"{kind}, 100 stages" if over == "n" else f"serial chain of {ARM} joints"
        dress(ax, title, "time of an iteration, us", "joints" if over == "n" else "stages")
        for phase, bound in PHASES.items():
            for integrator, style in zip(INTEGRATORS, ("o-", "s--"), strict=True):
                chosen = [
                    p for p in points if (p["kind"], p["over"], p["integrator"]) == (kind, over, integrator)
                ]  # fmt: skip
                if chosen:
                    x, y = np.array([p["value"] for p in chosen]), np.array([p[phase] for p in chosen])
                    ax.loglog(x, y, style, color=colours[phase], ms=3.5, label=f"{phase}, {SHORT[integrator]}")
            shown = [p for p in points if (p["kind"], p["over"], p["integrator"]) == (kind, over, EULER)]
            if shown:
                x, last = np.array([p["value"] for p in shown if over == "N" or p["value"] >= FIT_FROM[-1]]), shown[-1]
                exponent = 1.0 if over == "N" else bound
                guide = 1.6 * last[phase] * (x / last["value"]) ** exponent
                ax.loglog(x, guide, ":", color=colours[phase], lw=1.0)
        ticks = JOINTS if over == "n" else STAGES
        ax.set_xticks(ticks, [str(t) for t in ticks])
        ax.minorticks_off()
        ax.sharey(axes[0])
    legend_below(figure, axes[0].get_legend_handles_labels()[0])
    title_above(figure, "Phases of an iteration; dotted: n, n² and n³")
    save(figure, path)


def main() -> None:
    """Measure, draw, and say which bounds hold."""
    parser = argparse.ArgumentParser(description="Growth of an iteration's phases with joints and stages.")
    parser.add_argument("--seconds", type=float, default=0.5, help="time per point, on average (0.5)")
    parser.add_argument("--out", type=Path, default=DOCS / "scaling.png", help="the plot (docs/scaling.png)")
    arguments = parser.parse_args()
    points, slopes = [], []
    for integrator in INTEGRATORS:
        new_points, new_slopes = growth(integrator, arguments.seconds)
        points += new_points
        slopes += new_slopes
    kept = memory()
    draw(points, arguments.out)

    print("\nslopes in logarithms")
    word = {True: "met", False: "MISSED"}
    for s in slopes:
        print(
            f"{s['kind']:<13} {SHORT[s['integrator']]:<6} {s['slope_of']:<10} {s['over']} >= {s['from']:<3} "
            f"{s['over']}^{s['slope']:.2f} <= {s['over']}^{s['limit']:g}: {word[s['met']]}"
        )
    print(
        f"memory from solve {SETTLED} to {SOLVES}: {kept['kept_bytes'] / 1024:+.1f} KiB kept, process "
        f"{kept['process_bytes'] / 1024:+.0f} KiB: {word[kept['met']]}"
    )


if __name__ == "__main__":
    main()
