"""Reference [16] in numbers: somersaults and a twist from a tower, and what the angular momentum says of the plan.

The paper's sentence (section 2.2): "we have used this basic approach to solve for much more complex optimal high-dive
motions for a human-like diver in [16]". It gives no numbers, so nothing here can be off from it. Two things are shown
instead: what a dive costs by its turns, and that a plan keeps the angular momentum to the order of its integrator.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.high_dive.case import high_dive, misses, momentum_drift
from planner.cases.high_dive.diver import Diver
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.momentum import angular_momentum
from planner.problem.plan import Plan
from planner.proof.replaying import replay
from planner.solvers.slq import solve
from planner.view.plots.style import dress, save

DIVES = ((1.5, 0.0, 4.0), (1.5, 1.0, 4.0), (2.5, 0.0, 6.0))  # somersaults, twists, rad/s at take-off
SHOWN = 1  # the default one: it is drawn, and its momentum is followed
PARTS = (1, 2, 4, 8)  # of the plan's stage
MOST_ITERATIONS = 300


def dive_results() -> dict[str, Any]:
    """Dives by their turns, effort alone, and the change of angular momentum by step, as JSON values."""
    plans, dives = [], []
    for somersaults, twists, rate in DIVES:
        began = time.perf_counter()
        problem = high_dive(somersaults, twists, somersault_rate=rate)
        plans.append(solve(problem, max_iterations=MOST_ITERATIONS))
        dives.append(_dive(plans[-1], time.perf_counter() - began))
    plan = plans[SHOWN]
    alone = solve(high_dive(twists=0.0, posture_weight=0.0, calm_weight=0.0), max_iterations=MOST_ITERATIONS)
    mechanism, run = _mechanism(plan), replay(plan, feedback=True)
    names = mechanism.joint_names[1:]
    return {
        "case": "high-dive",
        "dives": dives,
        "effort_alone": _dive(alone, None),
        "momentum": {
            "at_take_off": angular_momentum(mechanism, plan.xs[0, : mechanism.nq], plan.xs[0, mechanism.nq :]).tolist(),
            "plan": momentum_drift(mechanism, plan.xs),
            "mujoco": momentum_drift(mechanism, run.xs[:: run.substeps]),
            "by_step": {kind: _by_step(plan, kind) for kind in ("semi-implicit-euler", "rk4")},
        },
        "shown": {
            "t_s": plan.t.tolist(),
            "angles_rad": {name: plan.xs[:, 7 + i].tolist() for i, name in enumerate(names)},
            "torques_Nm": {name: plan.us[:, i].tolist() for i, name in enumerate(names)},
            "change_of_momentum": _changes(plan).tolist(),
        },
    }


def _mechanism(plan: Plan) -> Any:
    assert plan.problem is not None  # just solved
    return plan.problem.dynamics.mechanism  # type: ignore[attr-defined]


def _dive(plan: Plan, seconds: float | None) -> dict[str, Any]:
    assert plan.problem is not None  # just solved
    p = plan.parameters
    diver = Diver(p["mass"], p["height"], p["tower"], p["gravity"])
    low, high = diver.ranges().T
    angles = plan.xs[:, 7 : diver.mechanism.nq]
    turn, joint, _ = misses(plan.xs[-1:], plan.problem.cost.x_ref[-1])  # type: ignore[attr-defined]
    return {
        "somersaults": p["somersaults"],
        "twists": p["twists"],
        "somersault_rate": p["somersault_rate"],
        "status": plan.status.name,
        "iterations": plan.nit,
        "seconds": seconds,
        "cost": plan.cost,
        "effort": 0.5 * plan.problem.dynamics.dt * float(np.sum(plan.us**2)),
        "largest_torque": float(np.abs(plan.us).max()),
        "beyond_ranges": float(np.maximum(low - angles, angles - high).max()),
        "turn_miss": float(turn[0]),
        "joint_miss": float(joint[0]),
    }


def _changes(plan: Plan) -> np.ndarray:
    """(N+1,) change of the angular momentum since take-off, relative."""
    mechanism = _mechanism(plan)
    L = angular_momentum(mechanism, plan.xs[:, : mechanism.nq], plan.xs[:, mechanism.nq :])
    return np.linalg.norm(L - L[0], axis=1) / np.linalg.norm(L[0])


def _by_step(plan: Plan, integrator: str) -> dict[str, list[float]]:
    """The change over the first half of the plan's torques at shorter and shorter steps, and the orders it shows.

    Half, since a dive is unstable without gains: later, another step is another motion.
    """
    mechanism, whole, drifts = _mechanism(plan), plan.t[1], []
    for parts in PARTS:
        dynamics = RigidBodyDynamics(mechanism, whole / parts, integrator)
        xs = [plan.xs[0]]
        for u in np.repeat(plan.us[: plan.N // 2], parts, axis=0):
            xs.append(dynamics.step(xs[-1][None], u[None])[0])
        drifts.append(momentum_drift(mechanism, np.array(xs)))
    orders = np.log2(np.array(drifts[:-1]) / drifts[1:])
    return {"dt": [whole / parts for parts in PARTS], "change": drifts, "orders": orders.tolist()}


def dive_rows(results: dict[str, Any]) -> list[dict[str, str]]:
    """The rows of the table "the paper says, we get, why it differs"."""
    dive, steps = results["dives"][SHOWN], results["momentum"]["by_step"]["rk4"]
    return [
        {
            "where": "2.2, ref. [16]",
            "paper": "optimal high-dive motions for a human-like diver; no numbers",
            "ours": (
                f"{dive['somersaults']:g} somersaults, {dive['twists']:g} twist: {dive['status'].lower()}, entry "
                f"{dive['turn_miss']:.1g} rad from vertical, largest torque {dive['largest_torque']:.0f} N m"
            ),
            "why": "solved by SLQ rather than by splines; body after Winter's tables; all numbers of the dive are ours",
        },
        {
            "where": "2.2, ref. [16]: conservation",
            "paper": "not stated",
            "ours": (
                f"angular momentum changes by {results['momentum']['plan']:.1g} of itself along the plan, of order "
                f"{steps['orders'][-1]:.1f} in the step (RK4); {results['momentum']['mujoco']:.1g} in MuJoCo"
            ),
            "why": "in flight it is constant: what changes is the integrator's error",
        },
    ]  # fmt: skip


def dive_markdown(results: dict[str, Any]) -> str:
    """The results as a section of Markdown."""
    alone, momentum = results["effort_alone"], results["momentum"]
    lines = [
        "## The high dive (ref. [16])", "",
        "A diver of 10 bodies and 14 motors (`planner run high-dive`), tower of 10 m, masses and lengths after Winter.",
        "The paper names such dives and gives no numbers. Effort is the integral of u²/2, without its weight.", "",
        "| somersaults | twists | take-off, rad/s | status | iterations | s | cost | effort, N² m² s "
        "| largest torque, N m | beyond a range, rad | off the vertical entry, rad |",
        "|---:|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|",
    ]  # fmt: skip
    for dive in results["dives"]:
        lines.append(
            f"| {dive['somersaults']:g} | {dive['twists']:g} | {dive['somersault_rate']:g} | {dive['status']} "
            f"| {dive['iterations']} | {dive['seconds']:.1f} | {dive['cost']:.1f} | {dive['effort']:.0f} "
            f"| {dive['largest_torque']:.0f} | {max(dive['beyond_ranges'], 0.0):.2f} | {dive['turn_miss']:.1g} |"
        )
    lines += [
        "", "Iterations are those after the path of goals that counts the turns; the seconds hold both.", "",
        f"**Effort alone** ({alone['status']}, no twist, no weights on posture and rates on the way): effort "
        f"{alone['effort']:.1f} N² m² s in place of {results['dives'][0]['effort']:.0f}, with a joint "
        f"{alone['beyond_ranges']:.1f} rad beyond its range: limbs swing like pendulums. So the case has weights on "
        "posture and rates on the way, and is not of effort alone.", "",
        f"**Momentum.** {np.linalg.norm(momentum['at_take_off']):.1f} kg m²/s at take-off. Along the plan it changes "
        f"by {momentum['plan']:.1g} of itself, in MuJoCo at a twentieth of the step by {momentum['mujoco']:.1g}. By "
        "step, over the first half of the plan's torques:", "",
        "| step, ms | RK4 | order | semi-implicit Euler | order |", "|---:|---:|---:|---:|---:|",
    ]  # fmt: skip
    rk4, euler = momentum["by_step"]["rk4"], momentum["by_step"]["semi-implicit-euler"]
    for i, dt in enumerate(rk4["dt"]):
        orders = ["", ""] if i == 0 else [f"{kind['orders'][i - 1]:.2f}" for kind in (rk4, euler)]
        lines.append(
            f"| {1e3 * dt:.3g} | {rk4['change'][i]:.2g} | {orders[0]} | {euler['change'][i]:.2g} | {orders[1]} |"
        )
    return "\n".join(lines) + "\n"


def draw_dive(results: dict[str, Any], path: Path) -> None:
    """Joint angles, torques, the change of momentum along the plan and by step, into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 8.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, 2)
    shown = results["shown"]
    t = np.array(shown["t_s"])
    for axes, key, title, unit in (
        (grid[0, 0], "angles_rad", "Joints", "angle, rad"), (grid[0, 1], "torques_Nm", "Motors", "torque, N m"),
    ):  # fmt: skip
        for i, (name, values) in enumerate(shown[key].items()):
            axes.plot(t[: len(values)], values, lw=1.4, color=f"C{i % 10}", ls="-" if i < 10 else "--",
                      label=name.replace("_", " "))  # fmt: skip
        dress(axes, title, unit)
        axes.set_xlabel("time, s")
    grid[0, 1].legend(frameon=False, fontsize=8, ncols=1, loc="center left", bbox_to_anchor=(1.0, 0.5))
    along = grid[1, 0]
    along.semilogy(t[1:], np.maximum(shown["change_of_momentum"][1:], 1e-17), lw=1.6)
    dress(along, "Angular momentum along the plan", "change, relative")
    along.set_xlabel("time, s")
    steps = grid[1, 1]
    for (kind, found), order in zip(results["momentum"]["by_step"].items(), (1, 4), strict=True):
        dt, change = np.array(found["dt"]), np.array(found["change"])
        (line,) = steps.loglog(dt, change, marker="o", label=kind)
        steps.loglog(dt, change[-1] * (dt / dt[-1]) ** order, ls=":", color=line.get_color(), label=f"order {order}")
    dress(steps, "Angular momentum by step", "change, relative")
    steps.set_xlabel("step, s")
    steps.legend(frameon=False)
    save(figure, path)
