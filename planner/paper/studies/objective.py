"""The criteria that the paper names, on its own machines: effort, energy, jerk and time.

The two-link arm moves from horizontal to upright by each, with bounds on its torques and its goal met exactly. Least
times stand beside what is known without a solver: 2 s of a cart in closed form, and for the arm motions with full
torques, whose switching times are the roots of the four equations of its end.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.paper.studies.study import Row, Study, plan_record, table
from planner.problem.costs.jerk import JerkCost
from planner.problem.costs.motors import EnergyCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.limits import Limits
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.free_time import solve_for
from planner.view.plots.style import HUES, dress, grid_of, legend_below, save

BOUND = 15.0
"""N m of both motors: the arm stretched out needs 9.8 to be held, its motion of least jerk 12.7."""
SWITCHED = 10.0
"""N m, where the least time is compared with motions of full torques whose switching times are roots."""
ELBOW = 5.0  # N m, of the acrobot
OBJECTIVES: dict[str, Any] = {
    "effort": "effort", "energy": "energy", "jerk": "jerk", "time": "time",
    "effort + 20 time": {"effort": 1.0, "time": 20.0},
}  # fmt: skip
MEASURES = {"effort": "N^2 m^2 s", "energy": "J", "jerk": "rad^2/s^5", "time": "s"}
AT_BOUND = 1e-3  # relative: nearer than that counts as on it

CART = """
<mujoco model="cart">
  <option gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1e-6 1e-6 1e-6"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
</mujoco>
"""


def _measured(plan: Plan) -> dict[str, float]:
    """Every criterion of one plan, neither weighted nor smoothed."""
    assert plan.problem is not None
    dynamics = plan.problem.dynamics
    return {
        "effort": 0.5 * plan.dt * float(np.sum(plan.us**2)),
        "energy": EnergyCost(dynamics).work(plan.xs, plan.us),
        "jerk": JerkCost(dynamics, plan.N).value(plan.xs, plan.us),
        "time": float(plan.t[-1]),
    }


def _motion(plan: Plan, bound: float) -> dict[str, Any]:
    return {
        **plan_record(plan), "values": _measured(plan), "t_s": plan.t.tolist(), "q_rad": plan.xs[:, :2].tolist(),
        "u_Nm": plan.us.tolist(), "stages_on_a_bound": _on_a_bound(plan, bound),
    }  # fmt: skip


def _on_a_bound(plan: Plan, bound: float) -> float:
    """The share of stages with a torque on its bound."""
    return float((np.abs(plan.us) > (1.0 - AT_BOUND) * bound).any(axis=1).mean())


def _least_time(problem: Problem, bound: float, longest: float) -> Plan:
    bounded = replace(problem, limits=Limits(control=bound, final="exact"))
    return solve_for(bounded, "time", durations=(0.1 * longest, longest))


def switched(problem: Problem, bound: float, pause: tuple[float, float] | None = None) -> np.ndarray | None:
    """Switching times, s, of the arm's motion with full torques; the last is its end. None where there are none.

    The shoulder switches once, from up to down; the elbow twice, down, up, down. Four unknowns for the four equations
    of the end, integrated by RK4 between switches. Both torques are bounded, N m; `pause` is the middle and length, s,
    of a time within the elbow's middle arc in which it pulls down.
    """
    dynamics: Any = problem.dynamics
    goal, (middle_of, length) = np.array([0.5 * np.pi, 0.0, 0.0, 0.0]), (0.0, 0.0) if pause is None else pause
    inside = (middle_of - 0.5 * length, middle_of + 0.5 * length)

    def end(switches: np.ndarray) -> np.ndarray:
        shoulder, down, up, last = switches
        x = problem.x0
        for begin, stop in pairwise(sorted([0.0, shoulder, down, up, last, *(inside if length else ())])):
            middle = 0.5 * (begin + stop)
            raised = down < middle < up and not inside[0] < middle < inside[1]
            u = bound * np.array([1.0 if middle < shoulder else -1.0, 1.0 if raised else -1.0])
            for _ in range(20):
                x = dynamics.step(x[None], u[None], np.array([(stop - begin) / 20]))[0]
        return x - goal

    # the first guess is read off our own motion: only the roots are independent of it
    from scipy.optimize import root

    found = root(end, [0.5, 0.12, 0.54, 0.74])
    return found.x if found.success else None


def fewest_seconds(problem: Problem, bound: float, most: int = 60) -> float | None:
    """The least time, s, of motions with five switches, over middle and length of the pause; `most` are tried."""

    def last(pause: np.ndarray) -> float:
        times = None if pause[1] <= 0.0 else switched(problem, bound, (float(pause[0]), float(pause[1])))
        return 10.0 if times is None else float(times[-1])

    from scipy.optimize import minimize

    found = minimize(last, [0.36, 0.02], method="Nelder-Mead", options={
        "initial_simplex": [[0.36, 0.02], [0.34, 0.02], [0.36, 0.03]], "xatol": 1e-3, "fatol": 1e-6, "maxfev": most,
    })  # fmt: skip
    return float(found.fun) if found.fun < 10.0 else None


def cart_problem(N: int = 50) -> Problem:
    """1 kg on a rail, a metre from rest to rest."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(CART), 4.0 / N)
    cost = TrackingCost.joints(dynamics, [1.0, 0.0], N, effort=1.0, final_position=1e3, final_velocity=1e3)
    return Problem(dynamics, cost, np.zeros(2))


def _run(pauses: int = 60) -> dict[str, Any]:
    arm = cases.two_link(horizon=100)
    limited = replace(arm, limits=Limits(control=BOUND, final="exact"))
    motions = {}
    for name, objective in OBJECTIVES.items():
        durations = (0.2, 3.0) if "time" in name else None
        motions[name] = _motion(solve_for(limited, objective, durations=durations), BOUND)
    cart = _least_time(cart_problem(), 1.0, 8.0)
    fast = _least_time(arm, SWITCHED, 2.0)
    acrobot = _least_time(cases.acrobot(horizon=150), ELBOW, 4.0)
    return {
        "bound_Nm": BOUND, "units": MEASURES, "motions": motions,
        "best": {name: min(motions, key=lambda m: motions[m]["values"][name]) for name in MEASURES},
        "least_times": [
            {"machine": "cart, 1 m, 1 kg, 1 N", "known_s": 2.0, "known": "bang-bang, in closed form",
             **_time_facts(cart, 1.0)},
            {"machine": f"two-link arm, {SWITCHED:g} N m", "known_s": fewest_seconds(arm, SWITCHED, pauses),
             "known": f"best with five switches, by root finding; with three {_last(switched(arm, SWITCHED))}",
             **_time_facts(fast, SWITCHED)},
            {"machine": f"acrobot, {ELBOW:g} N m", "known_s": None, "known": "", **_time_facts(acrobot, ELBOW)},
        ],
        "acrobot": _motion(acrobot, ELBOW), "acrobot_bound_Nm": ELBOW,
    }  # fmt: skip


def _last(times: np.ndarray | None) -> str:
    return "none" if times is None else f"{times[-1]:.4f}"


def _time_facts(plan: Plan, bound: float) -> dict[str, Any]:
    return {
        "found_s": float(plan.t[-1]), "status": plan.status.name, "stages_on_a_bound": _on_a_bound(plan, bound),
        "durations_tried": len(plan.options["tried"]),
    }  # fmt: skip


def _page(results: dict[str, Any]) -> list[str]:
    values = {f"{name}, {unit}": f"{{{name}}}" for name, unit in results["units"].items()}
    motions = []
    for name, motion in results["motions"].items():
        cells = {}
        for measure, value in motion["values"].items():
            mark = "**" if results["best"][measure] == name else ""
            cells[measure] = f"{mark}{value:.4g}{mark}"
        motions.append({"objective": name, "share": 100 * motion["stages_on_a_bound"], **cells})
    times = [
        {"seconds": "" if row["known_s"] is None else f"{row['known_s']:.4f}", "share": 100 * row["stages_on_a_bound"]}
        | row for row in results["least_times"]
    ]  # fmt: skip
    return [
        "## The criteria the paper names: effort, energy, jerk, time", "",
        f"The two-link arm from horizontal to upright, torques within {results['bound_Nm']:g} N m, its goal met to",
        "1e-4. Effort is half the integral of the squared torques. Energy is the work of both motors, positive or "
        "negative,",
        "as a positive number. Jerk is half the integral of the squared jerk of both joints. The least of each "
        "column is bold.", "",
        *table({"objective": "{objective}", **values, "on a bound": "{share:.0f} %"}, motions),
        "", "![motions and torques by each criterion](objectives.png)", "",
        "The new height costs the motors at least 9.81 J, whatever the motion: what the motion of least energy",
        "spends above that is mostly the smoothing's. The least jerk in closed form, by a quintic in time, is",
        f"360 (pi/2)^2 / 2^5 = {360.0 * (0.5 * np.pi) ** 2 / 2.0**5:.2f}; the sum over stages is of second order.",
        "Least times, by bisection over the length of a stage:", "",
        *table({
            "machine": "{machine}", "found, s": "{found_s:.4f}", "known, s": "{seconds}", "": "{known}",
            "stages on a bound": "{share:.0f} %",
        }, times), "",
        "SLQ finds local minima, so a least time found is an upper bound of the true one. The acrobot's is not",
        "bang-bang throughout: below it SLQ found no motion, which does not prove that there is none.",
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    best, cart, arm, acrobot = results["best"], *results["least_times"]
    values = {name: results["motions"][name]["values"] for name in results["motions"]}
    own = all(best[name] == name for name in MEASURES)
    return [
        Row("1", "Criteria: effort, energy, jerk, time",
            ", ".join(f"{name} {values[name][name]:.4g} {unit}" for name, unit in MEASURES.items())
            + f", each with torques within {BOUND:g} N m",
            "the paper names them; its arms are planned by effort, its step by nearness to a gait, its hopper by "
            "fuel. Two-link arm, "
            + ("each the least of its own criterion" if own else "not each the least of its own: local minima")),
        Row("1", "Minimum time",
            f"cart {cart['found_s']:.4f} s (exact: 2 s); arm {arm['found_s']:.4f} s with torques within "
            f"{SWITCHED:g} N m, "
            f"{100 * arm['stages_on_a_bound']:.0f} % of stages on a bound",
            "the paper shows none; bounds met exactly, stage length by bisection"),
        Row("2.2", "Acrobot swing-up, by effort",
            f"in least time {acrobot['found_s']:.3f} s with {ELBOW:g} N m",
            "the least found: a local minimum, and an upper bound"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Joint angles and torques by each criterion, and the acrobot's, with bounds where they are active."""
    motions = {name: (motion, results["bound_Nm"]) for name, motion in results["motions"].items()}
    motions["acrobot, time"] = results["acrobot"], results["acrobot_bound_Nm"]
    figure, grid = grid_of(2, len(motions), 3.0 * len(motions), 6.0)
    for (name, (motion, bound)), (top, bottom) in zip(motions.items(), grid.T, strict=True):
        t, q, u = (np.array(motion[key]) for key in ("t_s", "q_rad", "u_Nm"))
        for i, joint in enumerate(("shoulder", "elbow")):
            top.plot(t, q[:, i], color=HUES[i][1], label=joint)
        motors = ("shoulder", "elbow") if u.shape[1] == 2 else ("elbow",)
        for i, motor in enumerate(motors):
            colour = HUES[i + 2 - len(motors)][1]
            bottom.stairs(u[:, i], t, baseline=None, color=colour, label=motor)
        on = (np.abs(u) > (1.0 - AT_BOUND) * bound).any(axis=1)
        for begin, stop, active in zip(t[:-1], t[1:], on, strict=True):
            if active:
                bottom.axvspan(begin, stop, color="0.5", alpha=0.15, lw=0)
        for side in (-bound, bound):
            bottom.axhline(side, color="0.4", lw=0.8, ls="--")
        bottom.set_ylim(-1.15 * bound, 1.15 * bound)
        for axes in (top, bottom):
            axes.set_xlim(0.0, t[-1])
        first = top is grid[0, 0]
        dress(top, f"{name}\n{t[-1]:.3g} s", "joint angle, rad" if first else "")
        dress(bottom, "", "torque, N m" if first else "", "time, s")
    legend_below(figure, grid[0, 0].lines)
    figure.suptitle("dashed: bounds of the torques; grey: one of them is on its bound", fontsize="medium")
    save(figure, path)


STUDY = Study("objectives", "effort, energy, jerk and time (section 1)",
              partial(_run, 20), _page, _rows, {"objectives.png": _draw}, seconds=15, full=_run)  # fmt: skip
