"""Reference [16] in numbers: somersaults and a twist from a tower, and what the angular momentum says of the plan.

The paper's sentence (section 2.2): "we have used this basic approach to solve for much more complex optimal high-dive
motions for a human-like diver in [16]". It gives no numbers, so nothing here can be off from it. The study shows two
things instead: the cost of a dive by its turns, and that a plan keeps the angular momentum to the integrator's order.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.high_dive.case import high_dive, misses, momentum_drift
from planner.cases.high_dive.flight import Diver
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.kinematics import angular_momentum
from planner.dynamics.protocol import rollout_states
from planner.paper.studies.study import Row, Study, plan_record, table, timed
from planner.problem.plan import Plan
from planner.proof.replays.replaying import replay
from planner.solvers.slq import solve
from planner.view.plots.style import HUES, INK, dress, grid_of, legend_below, save

DIVES = ((1.5, 0.0, 4.0), (1.5, 1.0, 4.0), (2.5, 0.0, 6.0))  # somersaults, twists, rad/s at take-off
SHOWN = 1  # the default one: it is drawn, and its momentum is followed
PARTS = (1, 2, 4, 8)  # of the plan's stage
MAX_ITERATIONS = 300
SHORT: dict[str, Any] = {"asked": DIVES[: SHOWN + 1], "most": 60}


def _run(asked: tuple[tuple[float, float, float], ...] = DIVES, most: int = MAX_ITERATIONS) -> dict[str, Any]:
    plans, dives = [], []
    for somersaults, twists, rate in asked:
        plan, seconds = timed(lambda: solve(
            high_dive(somersaults, twists, somersault_rate=rate),  # noqa: B023
            max_iterations=MAX_ITERATIONS,
        ))  # fmt: skip
        plans.append(plan)
        dives.append(_dive(plan, seconds))
    plan = plans[SHOWN]
    alone = solve(high_dive(twists=0.0, posture_weight=0.0, calm_weight=0.0), max_iterations=most)
    mechanism, run = _mechanism(plan), replay(plan, feedback=True)
    names = mechanism.joint_names[1:]
    return {
        "case": "high-dive", "dives": dives, "effort_alone": _dive(alone, None),
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
    }  # fmt: skip


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
        **{name: p[name] for name in ("somersaults", "twists", "somersault_rate")}, **plan_record(plan),
        "seconds": seconds,
        "effort": 0.5 * plan.problem.dynamics.dt * float(np.sum(plan.us**2)),
        "largest_torque": float(np.abs(plan.us).max()),
        "beyond_ranges": float(np.maximum(low - angles, angles - high).max()),
        "turn_miss": float(turn[0]), "joint_miss": float(joint[0]),
    }  # fmt: skip


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
        xs = rollout_states(dynamics, plan.xs[0], np.repeat(plan.us[: plan.N // 2], parts, axis=0))
        drifts.append(momentum_drift(mechanism, xs))
    orders = np.log2(np.array(drifts[:-1]) / drifts[1:])
    return {"dt": [whole / parts for parts in PARTS], "change": drifts, "orders": orders.tolist()}


def _rows(results: dict[str, Any]) -> list[Row]:
    dive, steps = results["dives"][SHOWN], results["momentum"]["by_step"]["rk4"]
    return [
        Row("2.2, ref. [16]", "optimal high-dive motions for a human-like diver; no numbers",
            f"{dive['somersaults']:g} somersaults, {dive['twists']:g} twist: {dive['status'].lower()}, entry "
            f"{dive['turn_miss']:.1g} rad from vertical, largest torque {dive['largest_torque']:.0f} N m",
            "solved by SLQ rather than by splines; body after Winter's tables; all numbers of the dive are ours"),
        Row("2.2, ref. [16]: conservation", "not stated",
            f"angular momentum changes by {results['momentum']['plan']:.1g} of itself along the plan, of order "
            f"{steps['orders'][-1]:.1f} in the step (RK4); {results['momentum']['mujoco']:.1g} in MuJoCo",
            "in flight it is constant: what changes is the integrator's error"),
    ]  # fmt: skip


def _page(results: dict[str, Any]) -> list[str]:
    alone, momentum = results["effort_alone"], results["momentum"]
    rk4, euler = momentum["by_step"]["rk4"], momentum["by_step"]["semi-implicit-euler"]
    steps = [
        {"ms": 1e3 * dt, "rk4": a, "rk4_order": p, "euler": b, "euler_order": q}
        for dt, a, p, b, q in zip(
            rk4["dt"], rk4["change"], _orders(rk4), euler["change"], _orders(euler), strict=True
        )
    ]  # fmt: skip
    return [
        "## The high dive (ref. [16])", "",
        "A diver of 10 bodies and 14 motors (`planner run high-dive`), tower of 10 m, masses and lengths after Winter.",
        "The paper names such dives and gives no numbers. Effort is the integral of u²/2, without its weight.", "",
        *table({
            "somersaults": "{somersaults:g}", "twists": "{twists:g}", "take-off, rad/s": "{somersault_rate:g}",
            "status": "{status}", "iterations": "{iterations}", "s": "{seconds:.1f}", "cost": "{cost:.1f}",
            "effort, N² m² s": "{effort:.0f}", "largest torque, N m": "{largest_torque:.0f}",
            "beyond a range, rad": "{beyond:.2f}", "off the vertical entry, rad": "{turn_miss:.1g}",
        }, (dive | {"beyond": max(dive["beyond_ranges"], 0.0)} for dive in results["dives"])),
        "", "Iterations are those after the path of goals that counts the turns; the seconds hold both.", "",
        f"**Effort alone** ({alone['status']}, no twist, no weights on posture and rates on the way): effort "
        f"{alone['effort']:.1f} N² m² s in place of {results['dives'][0]['effort']:.0f}, with a joint "
        f"{alone['beyond_ranges']:.1f} rad beyond its range: limbs swing like pendulums. So the case has weights on "
        "posture and rates on the way, and is not of effort alone.", "",
        f"**Momentum.** {np.linalg.norm(momentum['at_take_off']):.1f} kg m²/s at take-off. Along the plan it changes "
        f"by {momentum['plan']:.1g} of itself, in MuJoCo at a twentieth of the step by {momentum['mujoco']:.1g}. By "
        "step, over the first half of the plan's torques:", "",
        *table({
            "step, ms": "{ms:.3g}", "RK4": "{rk4:.2g}", "its order": "{rk4_order}",
            "semi-implicit Euler": "{euler:.2g}", "order": "{euler_order}",
        }, steps),
    ]  # fmt: skip


def _orders(kind: dict[str, Any]) -> list[str]:
    """The order that each step shows against the one before; the first has none."""
    return ["", *(f"{order:.2f}" for order in kind["orders"])]


_SIDES = {"left": HUES[0][1], "right": HUES[1][1]}


def _draw(results: dict[str, Any], path: Path) -> None:
    """Joint angles, torques, the change of momentum along the plan and by step, into a PNG."""
    shown = results["shown"]
    t, groups = np.array(shown["t_s"]), dict[str, list[str]]()
    for name in shown["angles_rad"]:  # the same joint at the left and at the right shares a panel
        groups.setdefault(name.replace("left_", "").replace("right_", "").replace("_", " "), []).append(name)
    figure, grid = grid_of(3, len(groups), 2.1 * len(groups), 7.2)
    for row, (key, unit) in zip(grid, (("angles_rad", "angle, rad"), ("torques_Nm", "torque, N m")), strict=False):
        for column, (joint, names) in enumerate(groups.items()):
            axes = row[column]
            axes.sharey(row[0])
            for name in names:
                values, side = shown[key][name], name.split("_")[0]
                axes.plot(t[: len(values)], values, lw=1.6, color=_SIDES.get(side, INK), label=side)
            dress(axes, joint, "" if column else unit, "time, s")
    handles = [next(line for axes in grid[0] for line in axes.lines if line.get_label() == side) for side in _SIDES]
    for axes in grid[2]:
        axes.remove()
    cells, half = grid[2][0].get_gridspec(), len(groups) // 2
    along, steps = figure.add_subplot(cells[2, :half]), figure.add_subplot(cells[2, half:])
    along.semilogy(t[1:], np.maximum(shown["change_of_momentum"][1:], 1e-17), lw=1.6, color=INK)
    dress(along, "Angular momentum along the plan", "change, relative", "time, s")
    for (kind, found), order, hue in zip(results["momentum"]["by_step"].items(), (1, 4), HUES, strict=False):
        dt, change = np.array(found["dt"]), np.array(found["change"])
        steps.loglog(dt, change, marker="o", ms=4, color=hue[1], label=kind)
        steps.loglog(dt, change[-1] * (dt / dt[-1]) ** order, ls=":", color=hue[0], label=f"order {order}")
    dress(steps, "Angular momentum by step", "change, relative", "step, s")
    steps.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    legend_below(figure, handles)
    save(figure, path)


STUDY = Study("dive", "a high dive (reference 16)", partial(_run, **SHORT), _page, _rows, {"dive.png": _draw},
              seconds=12, full=_run)  # fmt: skip
