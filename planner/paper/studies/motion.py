"""Figures 1 to 4: the machines, inverse dynamics, and the motions of both arms as SLQ finds them.

The paper draws its arms as frames at equal intervals of time (Fig. 3, Fig. 4); so are ours.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.dynamics import algorithms as rigid_body
from planner.dynamics import poe
from planner.problem.plan import Plan
from planner.solvers.slq import solve
from planner.view.plots.style import INK, SOFT, save

FRAMES = 14  # as many as Fig. 3 has
STATES = 50  # random ones per arm, for Fig. 2
STARTS = 8  # first guesses of the better local minimum
LIMIT = 300  # iterations of each; those that need more end higher


def motion_results() -> dict[str, Any]:
    """Figures 1 to 4 as JSON values."""
    for case in ("two-link", "acrobot"):
        solve(cases.build(case), max_iterations=1)  # so that nothing is compiled on the clock
    return {
        "machines": [_machine(name) for name in cases.CASES],
        "inverse_dynamics_error": max(inverse_dynamics_error(case) for case in ("two-link", "acrobot")),
        "motions": [
            _motion("Fig. 3: two-link, from the paper's first guess", "two-link", 1),
            _motion(f"Fig. 3: two-link, best of {STARTS} first guesses", "two-link", STARTS),
            _motion("Fig. 4: acrobot, from the paper's first guess", "acrobot", 1),
        ],
    }


def _machine(name: str) -> dict[str, Any]:
    problem = cases.build(name)
    return {"case": name, "states": problem.dynamics.nx, "controls": problem.dynamics.nu, "t_f": problem.duration}


def inverse_dynamics_error(case: str, states: int = STATES) -> float:
    """The largest relative difference of the compiled inverse dynamics to Fig. 2, line by line, at random states."""
    mechanism, rng = cases.build(case).dynamics.mechanism, np.random.default_rng(0)  # type: ignore[attr-defined]
    q, qd, qdd = rng.normal(size=(3, states, mechanism.nv))
    fast = rigid_body.rnea(mechanism, q, qd, qdd)
    plain = np.array([poe.rnea(mechanism, *one) for one in zip(q, qd, qdd, strict=True)])
    return float(np.abs(fast - plain).max() / np.abs(plain).max())


def _motion(title: str, case: str, starts: int) -> dict[str, Any]:
    problem = cases.build(case)
    first = problem.dynamics.dt * 0.5 * float(np.sum(problem.first_guess**2))
    began = time.perf_counter()
    plan = solve(problem, starts=starts, max_iterations=LIMIT)
    seconds = time.perf_counter() - began
    q, qd = plan.xs[:, :2], plan.xs[:, 2:]
    chosen = np.linspace(0, plan.N, FRAMES).round().astype(int)
    return {
        "title": title, "case": case, "status": plan.status.name, "iterations": plan.nit, "cost": plan.cost,
        "first_effort": first, "effort": problem.dynamics.dt * 0.5 * float(np.sum(plan.us**2)),
        "seconds": seconds, "miss": float(np.abs(plan.xs[-1] - [0.5 * np.pi, 0.0, 0.0, 0.0]).max()),
        "lowest_q1": float(q[:, 0].min()), "at": float(plan.t[q[:, 0].argmin()]),
        "folds": [float(q[:, 1].min()), float(q[:, 1].max())], "swings": _swings(qd[:, 0]),
        "t_s": plan.t[chosen].tolist(), "frames": q[chosen].tolist(),
        "lengths": [float(plan.parameters[name]) for name in ("length1", "length2")],
        "path": _path(plan),
    }  # fmt: skip


def _swings(rate: np.ndarray) -> int:
    """How often the upper arm turns back."""
    signs = np.sign(rate[np.abs(rate) > 1e-3])  # rad/s; slower is rest
    return int(np.sum(signs[1:] != signs[:-1]))


def _path(plan: Plan) -> list[list[float]]:
    """The hand (N+1, 2), m."""
    a, b = (float(plan.parameters[name]) for name in ("length1", "length2"))
    elbow, hand = plan.xs[:, 0], plan.xs[:, 0] + plan.xs[:, 1]
    return np.stack([a * np.cos(elbow) + b * np.cos(hand), a * np.sin(elbow) + b * np.sin(hand)], axis=1).tolist()


def motion_markdown(results: dict[str, Any]) -> str:
    """The results as a page of Markdown."""
    lines = [
        "# The machines and their motions (Fig. 1 to 4)", "",
        "| machine of Fig. 1 | states | controls | t_f, s |", "|---|---:|---:|---:|",
        *(f"| {m['case']} | {m['states']} | {m['controls']} | {m['t_f']:g} |" for m in results["machines"]),
        "",
        f"Fig. 2, inverse dynamics line by line, against the compiled code at random states of the arms: relative "
        f"difference {results['inverse_dynamics_error']:.1e}.", "",
        "![frames of the arms at equal intervals](motions.png)", "",
        "| motion | status | iterations | s | effort of the guess | effort | cost | lowest q1 | q2 between | turns of "
        "q1 | miss |",
        "|---|---|---:|---:|---:|---:|---:|---:|---|---:|---:|",
    ]  # fmt: skip
    for m in results["motions"]:
        lines.append(
            f"| {m['title']} | {m['status']} | {m['iterations']} | {m['seconds']:.3g} | {m['first_effort']:.1f} "
            f"| {m['effort']:.2f} | {m['cost']:.2f} | {m['lowest_q1']:.2f} rad at {m['at']:.2f} s "
            f"| {m['folds'][0]:.2f} and {m['folds'][1]:.2f} rad | {m['swings']} | {m['miss']:.3f} |"
        )
    return "\n".join(lines) + "\n"


def motion_rows(results: dict[str, Any]) -> list[dict[str, str]]:
    """Rows of the table: the paper says, we get, why it differs."""
    paper, best, acrobot = results["motions"]
    machines = ", ".join(m["case"] for m in results["machines"])

    def described(m: dict[str, Any]) -> str:
        return (
            f"effort {m['effort']:.1f}, lowest q1 {m['lowest_q1']:.2f} rad, q2 from {m['folds'][0]:.2f} to "
            f"{m['folds'][1]:.2f} rad, {m['status']} after {m['iterations']} iterations, {m['seconds']:.2g} s"
        )

    return [
        {
            "where": "1, Fig. 1", "paper": "Four systems: 2R arm, the same without the base motor, human step, hopper",
            "ours": machines, "why": "it does not differ",
        },
        {
            "where": "1.2, Fig. 2", "paper": "Recursive inverse dynamics by matrix exponentials",
            "ours": f"as printed in poe.py, compiled: relative difference {results['inverse_dynamics_error']:.1e}",
            "why": "it does not differ; gravity enters as acceleration of the base, which the figure leaves out",
        },
        {
            "where": "2.1, Fig. 3",
            "paper": "The arm swings down while folding the second link, then swings up and pumps the second link "
            "upright",
            "ours": f"from the paper's guess: {described(paper)}; best of {STARTS} guesses: {described(best)}",
            "why": "another method, other masses (the paper has none) and many local minima; the paper calls its own "
            "locally optimal",
        },
        {
            "where": "2.2, Fig. 4", "paper": "From q1 = -1.0 the elbow pumps energy until the arm stands upright",
            "ours": f"{described(acrobot)}; q1 turns back {acrobot['swings']} times",
            "why": "the paper gives neither masses nor t_f, so only the kind of motion can be compared",
        },
    ]  # fmt: skip


def draw_motions(results: dict[str, Any], path: Path) -> None:
    """Frames at equal intervals, one row per motion."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = results["motions"]
    figure = Figure(figsize=(14.0, 1.75 * len(rows)), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    for axes, motion in zip(figure.subplots(len(rows), 1, squeeze=False)[:, 0], rows, strict=True):
        a, b = motion["lengths"]
        reach = 1.05 * (a + b)
        for frame, ((q1, q2), t) in enumerate(zip(motion["frames"], motion["t_s"], strict=True)):
            place = 2.1 * reach * frame
            x = place + np.cumsum([0.0, a * np.cos(q1), b * np.cos(q1 + q2)])
            y = np.cumsum([0.0, a * np.sin(q1), b * np.sin(q1 + q2)])
            hand = np.array(motion["path"])
            axes.plot(place + hand[:, 0], hand[:, 1], color="#d9d9d9", lw=0.8)
            axes.plot(x[:2], y[:2], color="#08306b", lw=3.0, solid_capstyle="round")
            axes.plot(x[1:], y[1:], color="#c1570a", lw=3.0, solid_capstyle="round")
            axes.plot(x[:2], y[:2], ".", color=INK, ms=4)
            axes.text(place, -1.3 * reach, f"{t:.2f} s", ha="center", fontsize=7.5, color=SOFT)
        axes.set(xlim=(-1.1 * reach, 2.1 * reach * FRAMES - reach), ylim=(-1.4 * reach, 1.1 * reach), aspect="equal")
        axes.set_axis_off()
        axes.set_title(f"{motion['title']}: effort {motion['effort']:.2f}", fontsize=9.5, loc="left", color=INK)
    save(figure, path)
