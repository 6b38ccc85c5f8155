"""Which arm has the paper's efforts (section 2.1): 73.6 along the first guess, 9.9 at the minimum that BFGS finds.

The paper gives no masses, no lengths and no first guess beyond "smoothly". Torques are linear in the masses, so the
effort of the first guess decides the scale of the masses once lengths and the ratio of the masses are chosen: each
family of arms below has one parameter, and each of its arms has the 73.6. The other number, 9.9, then has to come out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.cases.planar_arm import UPRIGHT, Links, arm_cost, arm_text
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, written
from planner.paper.methods.splines import Boundary, SplineMotion, minimize_effort
from planner.paper.studies.study import Row, Study, plan_record, row_of, table, timed
from planner.problem.initial_guess import inverse_dynamics_controls, minimum_jerk, quintic
from planner.problem.problem import Problem
from planner.solvers.slq import solve
from planner.view.plots.style import HUES, INK, dress, panels_of, save

FIRST, LAST = 73.6, 9.9  # section 2.1
DURATION, GRAVITY = 2.0, 9.81  # s, from the paper; m/s^2, ours
ENOUGH = 0.05  # of the second number: what rounds to it
KINDS = {"rods": (0.5, 1.0 / 12.0), "points at the tips": (1.0, 0.0), "points halfway": (0.5, 0.0)}
"""Centre of mass over length, and inertia about it over mass length^2."""
LENGTHS = (0.3, 0.6, 1.0, 1.25, 1.5, 2.0)  # m, of both links with equal masses
RATIOS = (0.25, 0.5, 0.75, 1.0, 2.0, 4.0)  # of the forearm's mass to the upper arm's, at 1 m
RISES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "quintic": lambda s: minimum_jerk(s)[0],
    "cubic": lambda s: 3.0 * s**2 - 2.0 * s**3,
    "cosine": lambda s: 0.5 * (1.0 - np.cos(np.pi * s)),
}
"""Smooth ways from 0 to 1 for s from 0 to 1, at rest at both ends."""
STARTS, TRIALS = 8, 8

_POINT = 1e-6  # inertia of a point over mass length^2: MuJoCo refuses a body without any


class Arm(NamedTuple):
    """Two links: kind of KINDS, masses in kg, lengths in m."""

    kind: str
    mass1: float
    mass2: float
    length1: float
    length2: float


def arm_mechanism(arm: Arm) -> Mechanism:
    """The two-link model with these links."""
    centre, inertia = KINDS[arm.kind]
    text = arm_text("two_link", Links(*arm[1:], GRAVITY))
    edits = {}
    bodies = ("worldbody/body/inertial", "worldbody/body/body/inertial")
    for path, mass, length in zip(bodies, arm[1:3], arm[3:5], strict=True):
        across = max(inertia, _POINT) * mass * length**2
        edits[path] = {
            "pos": f"{written(centre * length)} 0 0",
            "diaginertia": f"{written(_POINT * mass * length**2)} {written(across)} {written(across)}",
        }
    return Mechanism.from_mjcf(edited(text, edits))


def by_splines(mechanism: Mechanism, rise: str = "quintic") -> SplineMotion:
    """The paper's direct method from the paper's first guess."""
    return minimize_effort(
        mechanism, Boundary(np.zeros(2), UPRIGHT, DURATION), gradient_tolerance=1e-4,
        guess=lambda t: RISES[rise](t / DURATION)[:, None] * UPRIGHT,
    )  # fmt: skip


def with_first_effort(kind: str, ratio: float, length: float) -> Arm:
    """The arm whose first guess has the paper's 73.6."""
    arm = Arm(kind, 1.0, ratio, length, length)
    points, weights = np.polynomial.legendre.leggauss(64)
    share, rate, acceleration = minimum_jerk(0.5 * (1.0 + points)[:, None])
    q, qd, qdd = share * UPRIGHT, rate * UPRIGHT / DURATION, acceleration * UPRIGHT / DURATION**2
    power = 0.5 * np.sum(rnea(arm_mechanism(arm), q, qd, qdd) ** 2, axis=1)
    mass = math.sqrt(FIRST / (0.5 * DURATION * float(weights @ power)))
    return Arm(kind, mass, ratio * mass, length, length)


def _arm(family: str, kind: str, parameter: float) -> Arm:
    return with_first_effort(kind, 1.0, parameter) if family == "length" else with_first_effort(kind, parameter, 1.0)


def _last(family: str, kind: str, parameter: float) -> float:
    return by_splines(arm_mechanism(_arm(family, kind, parameter))).cost


def _crossing(family: str, kind: str, low: float, high: float) -> float | None:
    """A parameter between two at which the minimum is 9.9; None where the minimum jumps past it."""
    from scipy.optimize import brentq

    tried: dict[float, float] = {}

    def beyond(parameter: float) -> float:
        tried[parameter] = _last(family, kind, parameter) - LAST
        return tried[parameter]

    brentq(beyond, low, high, xtol=1e-4, maxiter=TRIALS, disp=False)
    best = min(tried, key=lambda parameter: abs(tried[parameter]))
    return best if abs(tried[best]) < ENOUGH else None


def slq_effort(arm: Arm, starts: int) -> dict[str, Any]:
    """SLQ with the cost of Eq. 5 on the same arm from the same first guess."""
    N = round(100 * DURATION)
    dynamics = RigidBodyDynamics(arm_mechanism(arm), DURATION / N)
    us = inverse_dynamics_controls(dynamics.mechanism, *quintic(np.zeros(2), UPRIGHT, DURATION, N))
    plan = solve(Problem(dynamics, arm_cost(dynamics, N, 200.0, 200.0, 1.0), np.zeros(4), us), starts=starts)
    return {"effort": 0.5 * dynamics.dt * float(np.sum(plan.us**2)), **plan_record(plan)}


def _described(arm: Arm) -> dict[str, Any]:
    """One arm, and the efforts that every method finds for it."""
    mechanism = arm_mechanism(arm)
    motion, seconds = timed(lambda: by_splines(mechanism))
    q = motion.spline(np.linspace(0.0, DURATION, 201))
    return {
        **arm._asdict(), "first": motion.first_cost, "last": motion.cost, "seconds": seconds,
        "iterations": motion.iterations, "shoulder_lowest": float(q[:, 0].min()),
        "elbow_range": [float(q[:, 1].min()), float(q[:, 1].max())],
        "by_guess": {name: [m.first_cost, m.cost] for name in RISES for m in [by_splines(mechanism, name)]},
        "slq": slq_effort(arm, 1), "slq_starts": slq_effort(arm, STARTS),
    }  # fmt: skip


def _run() -> dict[str, Any]:
    families, candidates = [], []
    for family, parameters in (("length", LENGTHS), ("ratio", RATIOS)):
        for kind in KINDS:
            points = [(p, _last(family, kind, p)) for p in parameters]
            families.append({"family": family, "kind": kind, "parameters": list(parameters),
                             "masses": [list(_arm(family, kind, p)[1:3]) for p in parameters],
                             "last": [last for _, last in points]})  # fmt: skip
            for low, high in pairwise(points):
                if (low[1] - LAST) * (high[1] - LAST) < 0.0:
                    found = _crossing(family, kind, low[0], high[0])
                    if found is not None:
                        candidates.append(_described(_arm(family, kind, found)) | {"family": family})
    return {
        "paper": {"first": FIRST, "last": LAST}, "families": families, "candidates": candidates,
        "ours": _described(Arm("rods", 0.5, 0.5, 1.0, 1.0)), "starts": STARTS,
    }  # fmt: skip


def _name(arm: dict[str, Any]) -> str:
    return (
        f"{arm['kind']}, {arm['mass1']:.3f} and {arm['mass2']:.3f} kg, {arm['length1']:.3g} and {arm['length2']:.3g} m"
    )


def _page(results: dict[str, Any]) -> list[str]:
    lines = [
        "## Which arm has the efforts 73.6 and 9.9 (section 2.1)", "",
        "Every arm below has 73.6 along the first guess (a quintic in time, q2 = 0), which sets the scale of its",
        "masses; g = 9.81. The number is the effort of the minimum that BFGS finds from there, by the paper's own",
        "method: quintic B-splines on 12 intervals, ends at rest. The paper's is 9.9.", "",
        "![effort of the minimum](masses.png)", "",
    ]  # fmt: skip
    for family, head in (("length", "length of both links, m (equal masses)"), ("ratio", "mass ratio (links of 1 m)")):
        chosen = [f for f in results["families"] if f["family"] == family]
        lines += [
            row_of([head, *(f"{p:g}" for p in chosen[0]["parameters"])]),
            "|---|" + "---:|" * len(chosen[0]["parameters"]),
            *(row_of([f["kind"], *(f"{last:.1f}" for last in f["last"])]) for f in chosen), "",
        ]  # fmt: skip
    lines += [
        "Arms with both numbers, and ours. SLQ starts from the same guess and has soft ends (c1 = c2 = 100), alone and",
        f"the best of {results['starts']} starts.", "",
        *table({
            "arm": "{name}", "first": "{first:.1f}", "BFGS": "{last:.2f}", "from a cubic": "{by_guess[cubic][1]:.1f}",
            "from a cosine": "{by_guess[cosine][1]:.1f}", "SLQ": "{slq[effort]:.1f}",
            "SLQ, several starts": "{slq_starts[effort]:.1f}",
        }, ({"name": _name(arm), **arm} for arm in [*results["candidates"], results["ours"]])),
    ]  # fmt: skip
    return [*lines, "", _conclusion(results)]


def _conclusion(results: dict[str, Any]) -> str:
    kinds = sorted({c["kind"] for c in results["candidates"]})
    if not kinds:
        return "No arm of these families has both numbers."
    without = sorted(set(KINDS) - set(kinds))
    lower = all(c["slq_starts"]["effort"] < c["last"] for c in results["candidates"])
    return (
        f"Of the arms that are tried here, those with {', '.join(kinds)} have both numbers; none with "
        f"{' or '.join(without)} has them, from a quintic first guess. With other lengths such arms have both too. "
        "Two numbers do not determine an arm: several have both. And another smooth first "
        "guess can lead to another minimum of the same arm. So the 9.9 depends on the guess and the optimizer as "
        "much as on the arm." + (" Several starts of SLQ end lower on each." if lower else "")
    )


def _rows(results: dict[str, Any]) -> list[Row]:
    ours, found = results["ours"], results["candidates"]
    best = "; ".join(f"{_name(c)}: {c['first']:.1f} to {c['last']:.2f}" for c in found) or "no arm with both"
    return [
        Row("2.1", f"Quintic B-splines and BFGS: effort {FIRST} to {LAST}; no masses given", best,
            "the paper gives no masses or lengths, nor which smooth guess; " + _conclusion(results)),
        Row("2.1", f"{FIRST} to {LAST}, on our own arm (rods of 0.5 kg and 1 m)",
            f"{ours['first']:.1f} to {ours['last']:.1f} by BFGS; SLQ {ours['slq']['effort']:.1f}, "
            f"of {results['starts']} starts {ours['slq_starts']['effort']:.1f}",
            "another arm, and the nearest of many local minima"),
        Row("2.1", "The direct method takes about 2 minutes on a PIII-800",
            f"{ours['seconds']:.2f} s, {ours['iterations']} iterations",
            "a processor of today, compiled dynamics, and an exact gradient by quadrature at fixed nodes"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Effort of the minimum against the parameter of each family."""
    figure, panels = panels_of(2)
    heads = {"length": "Equal links", "ratio": "Links of 1 m"}
    labels = {"length": "length of both links, m", "ratio": "mass of the forearm over that of the upper arm"}
    for axes, family in zip(panels, heads, strict=True):
        title = f"{heads[family]}, masses such that the first guess has {FIRST}"
        dress(axes, title, "effort of BFGS's minimum", labels[family])
        for index, kind in enumerate(KINDS):
            for f in results["families"]:
                if (f["family"], f["kind"]) == (family, kind):
                    axes.plot(f["parameters"], f["last"], marker="o", ms=4, color=HUES[index][1], label=kind)
            for c in results["candidates"]:
                if (c["family"], c["kind"]) == (family, kind):
                    x = c["length1"] if family == "length" else c["mass2"] / c["mass1"]
                    axes.plot(x, c["last"], marker="*", ms=13, color=INK, ls="")
        axes.axhline(LAST, color="0.5", lw=0.8, ls=":", label=f"the paper's {LAST}")
        axes.set_ylim(0.0, None)
        axes.legend(frameon=False, fontsize=8)
    save(figure, path)


STUDY = Study("masses", "the direct method, and which arm has the paper's efforts (2.1)",
              _run, _page, _rows, {"masses.png": _draw}, seconds=20)  # fmt: skip
