"""The gradient of Eq. 7 near convergence (section 2.2), on the paper's acrobot, and SLQ's beside it.

The paper: "the round-off errors encountered during the numerical solution of (1), (4), and (7) lead to large relative
errors in the gradient when the algorithm is near convergence". Here the same method runs from the same first guess; its
gradient at several tolerances is set against the gradient at a very tight one, at the first guess and where BFGS gave
up. SLQ's gradient is that of the sum it computes, at any step: set against differences of that sum.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.acrobot import acrobot
from planner.cases.planar_arm import UPRIGHT
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.paper.methods.underactuated import DrivenProblem, minimize_effort_underactuated
from planner.problem.problem import Problem
from planner.solvers.engine import borrow, give_back
from planner.solvers.lq import gradient
from planner.solvers.slq import solve
from planner.view.plots.style import dress, figure_of, save

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10)
REFERENCE = {"tolerance": 1e-11, "method": "DOP853"}
DESCENTS = ((1e-3, 40), (1e-4, 50))  # tolerance and iterations of BFGS from the first guess
POLISH = (1e-5, 25)  # and from where the last of these gave up
STAGES = (150, 300)  # of SLQ's discretisation
NEAR = 2e-3  # of the first gradient: as small as that of Eq. 7 gets here
DURATION = 3.0  # s, that of our acrobot

_WIDEST, _HALVINGS = 0.02, 16  # N m, the first of the differences, and how often it is halved


def _arm() -> tuple[Mechanism, np.ndarray]:
    """Our acrobot, and the pose (2,) it starts from."""
    problem = acrobot(duration=DURATION)
    assert isinstance(problem.dynamics, RigidBodyDynamics)  # it is one of ours
    return problem.dynamics.mechanism, problem.x0[:2]


def _problem(tolerance: float, method: str = "RK45") -> DrivenProblem:
    mechanism, start = _arm()
    return DrivenProblem(mechanism, start, UPRIGHT, DURATION, driven=("elbow",), tolerance=tolerance, method=method)


def _gradients(free: np.ndarray, name: str, tried: dict[float, DrivenProblem], exact: DrivenProblem) -> dict[str, Any]:
    """How wrong J and its gradient are at one point, against tolerance."""
    J, by_P = exact(free)
    values = [tried[tolerance](free) for tolerance in TOLERANCES]
    size = float(np.linalg.norm(by_P))
    return {
        "point": name, "cost": J, "gradient_norm": size,
        "cost_errors": [abs(value - J) / abs(J) for value, _ in values],
        "relative_errors": [float(np.linalg.norm(g - by_P)) / size for _, g in values],
        "cosines": [float(g @ by_P) / (size * float(np.linalg.norm(g))) for _, g in values],
    }  # fmt: skip


def _descent(tolerance: float, iterations: int, first: np.ndarray | None = None) -> tuple[dict[str, Any], np.ndarray]:
    mechanism, start = _arm()
    guess = None
    if first is not None:
        problem = _problem(tolerance)
        P = problem.amplitudes(first)
        guess = lambda t: problem.basis.matrix(t) @ P  # noqa: E731
    began = time.perf_counter()
    motion = minimize_effort_underactuated(
        mechanism, start, UPRIGHT, DURATION, driven=("elbow",), tolerance=tolerance, max_iterations=iterations,
        guess=guess,
    )  # fmt: skip
    return {
        "tolerance": tolerance, "first_cost": motion.first_cost, "cost": motion.cost, "iterations": motion.iterations,
        "evaluations": motion.evaluations, "success": motion.success, "message": motion.message,
        "gradient_norm": motion.gradient_norm, "seconds": time.perf_counter() - began,
        "angle_miss": float(np.abs(motion.q[-1] - UPRIGHT).max()),
        "t": motion.t[::5].tolist(), "shoulder": motion.q[::5, 0].tolist(), "elbow": motion.q[::5, 1].tolist(),
    }, motion.amplitudes[2:].ravel()  # fmt: skip


def discrete_error(problem: Problem, us: np.ndarray) -> dict[str, float]:
    """The costate gradient at controls us (N, nu) against differences of J along it, by Ridders' method."""
    engine = borrow(problem)
    J = engine.start(problem.x0, us)
    xs, _ = engine.trajectory()
    A, B = problem.dynamics.linearize(xs, us)
    by_u = gradient(A, B, problem.cost.quadratize(xs, us))
    size = float(np.linalg.norm(by_u))

    def slope(h: float) -> float:
        ends = [engine.start(problem.x0, us + side * h * by_u / size) for side in (1.0, -1.0)]
        return (ends[0] - ends[1]) / (2.0 * h)

    best, least, row = np.inf, np.inf, [slope(_WIDEST)]
    for level in range(1, _HALVINGS):
        previous, row = row, [slope(_WIDEST / 2.0**level)]
        for order, before in enumerate(previous, start=1):
            row.append(row[-1] + (row[-1] - before) / (4.0**order - 1.0))
            doubt = max(abs(row[-1] - row[-2]), abs(row[-1] - before))
            if doubt < least:
                best, least = row[-1], doubt
    give_back(problem, engine)
    return {"cost": J, "gradient_norm": size, "relative_error": abs(best - size) / size}


def _slq(stages: int) -> dict[str, Any]:
    problem = acrobot(duration=DURATION, horizon=stages)
    solve(problem, max_iterations=1)  # compiled
    began = time.perf_counter()
    plan = solve(problem)
    seconds = time.perf_counter() - began
    norms = np.array([line.gradient_norm for line in plan.history])
    near = int(np.argmax(norms < NEAR * norms[0]))
    return {
        "stages": stages, "dt": problem.dynamics.dt, "cost": plan.cost, "iterations": plan.nit, "seconds": seconds,
        "status": plan.status.name, "first": discrete_error(problem, problem.first_guess),
        "near": discrete_error(problem, solve(problem, max_iterations=max(1, near)).us),
    }  # fmt: skip


def elbow_results() -> dict[str, Any]:
    """Descents at several tolerances, errors of the gradient, and SLQ, as JSON values."""
    began = time.perf_counter()
    descents = []
    last = _problem(TOLERANCES[0]).first
    for tolerance, iterations in DESCENTS:
        found, last = _descent(tolerance, iterations)
        descents.append(found)
    polished, best = _descent(*POLISH, first=last)
    exact, tried = _problem(**REFERENCE), {tolerance: _problem(tolerance) for tolerance in TOLERANCES}
    points = [
        _gradients(exact.first, "first guess", tried, exact),
        _gradients(last, f"where BFGS ended at {DESCENTS[-1][0]:g}", tried, exact),
        _gradients(best, f"gone on from there at {POLISH[0]:g}", tried, exact),
    ]
    return {
        "tolerances": list(TOLERANCES), "reference": REFERENCE, "points": points, "descents": [*descents, polished],
        "slq": [_slq(stages) for stages in STAGES], "seconds": time.perf_counter() - began,
    }  # fmt: skip


def elbow_markdown(results: dict[str, Any]) -> str:
    """The results as a section of Markdown."""
    first = results["descents"][0]
    lines = [
        "## The acrobot by splines of the elbow and Eq. 7 (section 2.2)", "",
        "The elbow's motion is a quintic B-spline on 12 intervals, the control; the state is (q1, its rate); J,",
        "costate and gradient by an adaptive rule (RK45, that of Matlab's ode45). First guess: the elbow held, the arm",
        f"falls like a rigid pendulum from q1 = -1.0; its J is {first['first_cost']:.0f}.", "",
        "![error of the gradient](elbow_gradient.png)", "",
        "| tolerance | J from | J to | iterations | BFGS says | largest miss of an angle, rad | s |",
        "|---:|---:|---:|---:|---|---:|---:|",
        *(
            f"| {d['tolerance']:g} | {d['first_cost']:.4g} | {d['cost']:.4g} | {d['iterations']} | {d['message']} "
            f"| {d['angle_miss']:.3f} | {d['seconds']:.1f} |"
            for d in results["descents"]
        ), "",
        "The last row goes on from where the row before ended; limits of iterations are ours.", "",
        "Relative error of the gradient against one at",
        f"{results['reference']['tolerance']:g}:", "",
        "| at | gradient | " + " | ".join(f"{t:g}" for t in results["tolerances"]) + " |",
        "|---|---:|" + "---:|" * len(results["tolerances"]),
        *(
            f"| {p['point']} | {p['gradient_norm']:.3g} "
            + "".join(f"| {e:.1e} " for e in p["relative_errors"]) + "|"
            for p in results["points"]
        ), "",
        "SLQ on the same problem, the elbow's torque its control: the gradient (Eq. 16-19) against differences of J:",
        "",
        "| dt, s | J | iterations | s | gradient early | relative error | gradient near the end | relative error |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(
            f"| {s['dt']:g} | {s['cost']:.3f} | {s['iterations']} | {s['seconds']:.3f} "
            + "".join(f"| {s[at]['gradient_norm']:.3g} | {s[at]['relative_error']:.1e} " for at in ("first", "near"))
            + "|"
            for s in results["slq"]
        ), "", _said(results), "",
    ]  # fmt: skip
    return "\n".join(lines)


def _said(results: dict[str, Any]) -> str:
    """What the numbers say."""
    first, *_, last = results["points"]
    ratios = [b / a for a, b in zip(first["relative_errors"], last["relative_errors"], strict=True)]
    spoiled = [t for t, e in zip(results["tolerances"], last["relative_errors"], strict=True) if e > 0.1]
    most = max(s[at]["relative_error"] for s in results["slq"] for at in ("first", "near"))
    gave_up = [f"{d['tolerance']:g}" for d in results["descents"] if not d["success"]]
    return (
        f"At one and the same tolerance the relative error is {min(ratios):.0f} to {max(ratios):.0f} times that at the "
        "first guess: the error stays and the gradient shrinks. "
        + (f"At {max(spoiled):g} to {min(spoiled):g} it is above 10 %. " if spoiled else "")
        + (f"BFGS did not reach its tolerance at {', '.join(gave_up)}, in its iterations. " if gave_up else "")
        + "It is truncation, not round-off: a tighter tolerance takes it away, at a price in time. SLQ's gradient is "
        f"off by {most:.0e} at most at every step and as near to convergence, differences included."
    )


def elbow_rows(results: dict[str, Any]) -> list[dict[str, str]]:
    """Rows of the table: the paper says, we get, why it differs."""
    last, plan = results["descents"][-1], results["slq"][-1]
    errors = dict(zip(results["tolerances"], results["points"][-1]["relative_errors"], strict=True))
    seconds = sum(d["seconds"] for d in results["descents"][1:])
    return [
        {"where": "2.2", "paper": "Round-off leads to large relative errors of the gradient near convergence",
         "ours": ", ".join(f"{errors[t]:.0e} at tolerance {t:g}" for t in (1e-3, 1e-4, 1e-6)), "why": _said(results)},
        {"where": "2.2, Eq. 7", "paper": "Swing-up from q1 = -1.0 by splines, after tolerances were adjusted",
         "ours": f"J {last['cost']:.3g}, angles within {last['angle_miss']:.3f} rad; BFGS: {last['message']} "
                 f"SLQ: J {plan['cost']:.3g}",
         "why": "masses and t_f are ours; another parametrisation, another local minimum"},
        {"where": "2.2", "paper": "The acrobot takes about 5 minutes on a PIII-800 at best",
         "ours": f"{seconds:.1f} s by splines, {plan['seconds']:.3f} s by SLQ",
         "why": "the splines integrate adaptively in Python around compiled dynamics; SLQ is compiled"},
    ]  # fmt: skip


def draw_elbow(results: dict[str, Any], path: Path) -> None:
    """Error of the gradient against tolerance and against SLQ's step, and the motion found."""
    figure, cells = figure_of(2)
    errors, motion = (figure.add_subplot(cell) for cell in cells)
    dress(errors, "Gradient of Eq. 7: the same error, a smaller gradient", "relative error of the gradient")
    for index, point in enumerate(results["points"]):
        label = f"{point['point']}: gradient {point['gradient_norm']:.2g}"
        errors.loglog(results["tolerances"], point["relative_errors"], marker="o", ms=4, color=f"C{index}", label=label)
    worst = max(s["near"]["relative_error"] for s in results["slq"])
    errors.axhline(worst, color="k", lw=1.0, ls="--", label="SLQ near convergence, worst step length")
    errors.axhline(1.0, color="0.6", lw=0.8, ls=":")
    errors.set_xlabel("tolerance of the integration")
    errors.invert_xaxis()
    errors.legend(frameon=False, fontsize=7.5)
    found = results["descents"][-1]
    dress(motion, f"The swing found, J = {found['cost']:.3g}", "angle, rad")
    motion.plot(found["t"], found["shoulder"], label="shoulder")
    motion.plot(found["t"], found["elbow"], label="elbow")
    motion.axhline(UPRIGHT[0], color="0.6", lw=0.8, ls=":")
    motion.set_xlabel("time, s")
    motion.legend(frameon=False, fontsize=8)
    save(figure, path)
