"""Which arm has the paper's efforts (section 2.1): 73.6 along the first guess, 9.9 at the minimum that BFGS finds.

The paper gives no masses, no lengths and no first guess beyond "smoothly". Torques are linear in the masses, so their
scale does not change the minimizing motion, and the effort of the first guess decides it. What is left are two lengths
and the ratio of the masses: for every pair of lengths the ratios are searched at which the minimum is 9.9.

Of these arms the nearest to Fig. 3 is taken. Its caption and text say: the arm swings down and folds the second link,
swings up once, and pumps the second link upright. The measure is how far the arm is from hanging and the second link
from folded at the lowest point, and how often the first link turns back beyond once.

On that arm stand Eq. 5 as it is printed and our reading: ends soft or met exactly, 12 amplitudes a joint or all of the
splines on 12 intervals, adaptive Simpson quadrature or Gauss's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.cases.planar_arm import UPRIGHT, Links, arm_cost, arm_text
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, written
from planner.paper.methods.splines import DEGREE, INTERVALS, Boundary, SplineMotion, SplineSpace, minimize_effort
from planner.paper.studies.motion import draw_frames, drawn
from planner.paper.studies.study import Row, Study, plan_record, table, timed
from planner.problem.initial_guess import inverse_dynamics_controls, minimum_jerk, quintic
from planner.problem.problem import Problem
from planner.solvers.slq import solve
from planner.view.plots.style import INK, dress, grid_of, save

FIRST, LAST = 73.6, 9.9  # section 2.1
AMPLITUDES = 12  # of each joint, section 2.1
SOFT = (100.0, 100.0)  # c1 and c2 of Eq. 5
DURATION, GRAVITY = 2.0, 9.81  # s, from the paper; m/s^2, ours
ENOUGH = 0.05  # of the second number: what rounds to it
SIMPSON = 1e-6  # Matlab's default tolerance
KINDS = {"rods": (0.5, 1.0 / 12.0), "points at the tips": (1.0, 0.0), "points halfway": (0.5, 0.0)}
"""Centre of mass over length, and inertia about it over mass length^2."""
SHORT = (np.array([1.6]), np.geomspace(0.5, 4.0, 4))
FULL = (np.geomspace(0.3, 2.4, 7), np.geomspace(0.125, 8.0, 9))
"""Lengths of each link, m, and ratios of the second mass to the first."""
RISES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "quintic": lambda s: minimum_jerk(s)[0],
    "cubic": lambda s: 3.0 * s**2 - 2.0 * s**3,
    "cosine": lambda s: 0.5 * (1.0 - np.cos(np.pi * s)),
}
"""Smooth ways from 0 to 1 for s from 0 to 1, at rest at both ends."""
STARTS, TRIALS = 8, 6

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


@cache
def _of_unit_masses(kind: str, length1: float, length2: float) -> Mechanism:
    return arm_mechanism(Arm(kind, 1.0, 1.0, length1, length2))


def _quick_mechanism(arm: Arm) -> Mechanism:
    """The dynamics of arm_mechanism() without compiling a file: for a search over masses. Its `mjcf` is another's."""
    unit, masses = _of_unit_masses(arm.kind, arm.length1, arm.length2), np.array(arm[1:3])
    return replace(unit, mass=masses * unit.mass, inertia=masses[:, None, None] * unit.inertia)


def by_splines(mechanism: Mechanism, rise: str = "quintic", **options: Any) -> SplineMotion:
    """The paper's direct method from the paper's first guess."""
    return minimize_effort(
        mechanism, Boundary(np.zeros(2), UPRIGHT, DURATION), gradient_tolerance=1e-4,
        guess=lambda t: RISES[rise](t / DURATION)[:, None] * UPRIGHT, **options,
    )  # fmt: skip


def with_first_effort(kind: str, ratio: float, length1: float, length2: float) -> Arm:
    """The arm whose first guess has the paper's 73.6."""
    arm = Arm(kind, 1.0, ratio, length1, length2)
    points, weights = np.polynomial.legendre.leggauss(64)
    share, rate, acceleration = minimum_jerk(0.5 * (1.0 + points)[:, None])
    q, qd, qdd = share * UPRIGHT, rate * UPRIGHT / DURATION, acceleration * UPRIGHT / DURATION**2
    power = 0.5 * np.sum(rnea(_quick_mechanism(arm), q, qd, qdd) ** 2, axis=1)
    mass = math.sqrt(FIRST / (0.5 * DURATION * float(weights @ power)))
    return Arm(kind, mass, ratio * mass, length1, length2)


def arms_with_both(kind: str, lengths: np.ndarray, ratios: np.ndarray) -> list[dict[str, Any]]:
    """Arms of a kind with both of the paper's efforts, between neighbours on a grid whose minima lie about 9.9."""
    from scipy.optimize import brentq

    found = []
    for length1, length2 in product(lengths, lengths):
        tried: dict[float, SplineMotion] = {}

        def beyond(exponent: float, at: tuple[float, float] = (length1, length2), tried: Any = tried) -> float:
            if exponent not in tried:
                tried[exponent] = by_splines(_quick_mechanism(with_first_effort(kind, math.exp(exponent), *at)))
            return tried[exponent].cost - LAST

        for low, high in pairwise(map(math.log, ratios)):
            if beyond(low) * beyond(high) < 0.0:  # where the minimum does not jump past 9.9
                brentq(beyond, low, high, xtol=1e-4, maxiter=TRIALS, disp=False)
            nearest = min((one for one in tried if low <= one < high), key=lambda one: abs(tried[one].cost - LAST))
            if abs(tried[nearest].cost - LAST) < ENOUGH:
                arm = with_first_effort(kind, math.exp(nearest), length1, length2)
                found.append(_motion(arm, tried[nearest]))
    return found


def _motion(arm: Arm, motion: SplineMotion) -> dict[str, Any]:
    """An arm and its motion."""
    t = np.linspace(0.0, DURATION, 201)
    q = motion.spline(t)
    record = {**arm._asdict(), "first": motion.first_cost, "last": motion.cost, "iterations": motion.iterations,
              **drawn(t, q, np.gradient(q[:, 0], t), list(arm[3:]))}  # fmt: skip
    hanging, folded = abs(record["lowest_q1"] + 0.5 * np.pi), abs(np.pi - abs(q[q[:, 0].argmin(), 1]))
    return record | {"off": float(hanging + folded + 2.0 * np.pi * abs(record["swings"] - 1))}


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
    return {
        **_motion(arm, motion), "seconds": seconds,
        "by_guess": {name: by_splines(mechanism, name).cost for name in RISES},
        "slq": slq_effort(arm, 1), "slq_starts": slq_effort(arm, STARTS),
    }  # fmt: skip


def _as_printed(arm: Arm) -> list[dict[str, Any]]:
    """Eq. 5 as printed and as we read it, with the number of amplitudes of a joint that are not fixed by the start."""
    found = []
    for ends, intervals, simpson in (
        (None, INTERVALS, None), (SOFT, INTERVALS, None), (SOFT, AMPLITUDES - DEGREE + 2, None),
        (SOFT, AMPLITUDES - DEGREE, None), (SOFT, AMPLITUDES - DEGREE, SIMPSON),
    ):  # fmt: skip
        run = partial(by_splines, arm_mechanism(arm), space=SplineSpace(intervals), end_weights=ends, simpson=simpson)
        motion, seconds = timed(run)
        found.append({
            "ends": "soft" if ends else "met", "intervals": intervals, "amplitudes": len(motion.spline.c),
            "free": len(motion.spline.c) - (2 if ends else 4), "quadrature": "Gauss" if simpson is None else "Simpson",
            "cost": motion.cost, "effort": motion.effort, "iterations": motion.iterations, "seconds": seconds,
        })  # fmt: skip
    return found


def _run(grid: tuple[np.ndarray, np.ndarray] = SHORT) -> dict[str, Any]:
    arms = [arm for kind in KINDS for arm in arms_with_both(kind, *grid)]
    nearest = [min(of_kind, key=lambda arm: arm["off"]) for kind in KINDS
               if (of_kind := [arm for arm in arms if arm["kind"] == kind])]  # fmt: skip
    chosen = min(nearest, key=lambda arm: arm["off"])
    named = [Arm(*(arm[key] for key in Arm._fields)) for arm in nearest]
    return {
        "searched": len(KINDS) * len(grid[0]) ** 2 * len(grid[1]), "arms": arms, "chosen": chosen,
        "candidates": [_described(arm) for arm in named], "as_printed": _as_printed(named[nearest.index(chosen)]),
        "ours": _described(Arm("rods", 0.5, 0.5, 1.0, 1.0)), "starts": STARTS,
    }  # fmt: skip


def _name(arm: dict[str, Any]) -> str:
    return (
        f"{arm['kind']}, {arm['mass1']:.4g} and {arm['mass2']:.4g} kg, {arm['length1']:.4g} and {arm['length2']:.4g} m"
    )


def _counts(results: dict[str, Any]) -> str:
    counts = ((kind, sum(arm["kind"] == kind for arm in results["arms"])) for kind in KINDS)
    return ", ".join(f"{count} with {kind}" for kind, count in counts)


def _page(results: dict[str, Any]) -> list[str]:
    return [
        "## Which arm has the efforts 73.6 and 9.9 (section 2.1)", "",
        f"{results['searched']} arms on a grid of two lengths and a ratio of masses, each with {FIRST} along the first",
        f"guess (a quintic in time, q2 = 0; g = {GRAVITY}), by the paper's method: quintic B-splines on {INTERVALS}",
        f"intervals, ends at rest. Between neighbours lie arms whose minimum is {LAST}: {_counts(results)}.",
        "The table has the nearest of each kind to Fig. 3, and ours. The number off Fig. 3 is in rad: of the first",
        "link from hanging and of the second from folded at the lowest point, and 2 pi for every turn of the first",
        "link beyond one. Other arms may have both numbers too, beyond the grid and between its lengths.", "",
        "![arms with both efforts](masses.png)", "", "![the motion nearest to Fig. 3](fig3.png)", "",
        *table({
            "arm": "{name}", "first": "{first:.2f}", "BFGS": "{last:.3f}", "off Fig. 3": "{off:.2f}",
            "lowest q1": "{lowest_q1:.2f} rad at {at:.2f} s", "q2 between": "{folds[0]:.2f} and {folds[1]:.2f} rad",
            "from a cubic": "{by_guess[cubic]:.1f}", "from a cosine": "{by_guess[cosine]:.1f}",
            "SLQ": "{slq[effort]:.1f}", f"of {results['starts']} starts": "{slq_starts[effort]:.1f}",
        }, ({"name": _name(arm), **arm} for arm in [*results["candidates"], results["ours"]])), "",
        f"Eq. 5 as printed, on {_name(results['chosen'])}. It has soft ends (c1 = c2 = {SOFT[0]:g}) and {AMPLITUDES}",
        f"amplitudes a joint; quintic splines on {INTERVALS} intervals have {INTERVALS + DEGREE}, of which the start",
        f"fixes two, and met ends two more. {AMPLITUDES} in all are those of {AMPLITUDES - DEGREE} intervals:", "",
        *table({
            "ends": "{ends}", "intervals": "{intervals}", "amplitudes": "{amplitudes}", "free": "{free}",
            "quadrature": "{quadrature}", "J": "{cost:.6g}", "effort": "{effort:.6g}", "iterations": "{iterations}",
            "s": "{seconds:.2f}",
        }, results["as_printed"]),
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    ours, found, chosen, printed = (results[key] for key in ("ours", "candidates", "chosen", "as_printed"))
    *_, gauss, simpson = printed
    return [
        Row("2.1", f"Quintic B-splines and BFGS: effort {FIRST} to {LAST}; no masses given",
            "; ".join(f"{_name(c)}: {c['first']:.2f} to {c['last']:.3f}" for c in found),
            "the paper gives no masses or lengths, nor which smooth guess. Between the neighbours of a grid of "
            f"{results['searched']} arms lie {_counts(results)} with both numbers; these are the nearest to Fig. 3 of "
            "each kind. Two numbers do not determine an arm, and another guess can lead to another minimum"),
        Row("2.1, Fig. 3",
            "The arm swings down while folding the second link, then swings up and pumps the second link upright",
            f"{_name(chosen)}, by the paper's method: swings down to q1 = {chosen['lowest_q1']:.2f} rad at "
            f"{chosen['at']:.2f} s while it folds to q2 = {max(chosen['folds'], key=abs):.2f} rad, then up, and the "
            "second link follows",
            "the nearest to the words of the print among the arms found; nearer ones may lie beyond the grid. The "
            "figure has no scale"),
        Row("2.1, Eq. 5", "Soft ends, c = 100, and 12 amplitudes a joint of quintic splines on 12 intervals",
            "; ".join(f"ends {p['ends']}, {p['intervals']} intervals: effort {p['effort']:.4g}" for p in printed[:4]),
            f"the numbers of the print do not fit: quintics on {INTERVALS} intervals have {INTERVALS + DEGREE} "
            f"amplitudes, {INTERVALS + DEGREE - 2} with the start met. Our default meets both ends and has the other "
            f"{INTERVALS + DEGREE - 4} free"),
        Row("2.1", "Adaptive Simpson quadrature",
            f"effort {simpson['effort']:.8g} at {SIMPSON:g}, by Gauss's nodes {gauss['effort']:.8g}",
            f"it does not matter, but for time: {simpson['seconds']:.2g} s in place of {gauss['seconds']:.2g} s"),
        Row("2.1", f"{FIRST} to {LAST}, on our own arm (rods of 0.5 kg and 1 m)",
            f"{ours['first']:.1f} to {ours['last']:.1f} by BFGS; SLQ {ours['slq']['effort']:.1f}, "
            f"of {results['starts']} starts {ours['slq_starts']['effort']:.1f}",
            "another arm, and the nearest of many local minima"),
        Row("2.1", "The direct method takes about 2 minutes on a PIII-800",
            f"{ours['seconds']:.2f} s, {ours['iterations']} iterations",
            "a processor of today, compiled dynamics, and an exact gradient by quadrature at fixed nodes"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """All arms with both efforts by kind, length and ratio of masses; the stars are the nearest to Fig. 3."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure, grid = grid_of(1, len(KINDS), 13.5, 4.0)
    forearms = [arm["length2"] for arm in results["arms"]]
    norm = Normalize(min(forearms), max(forearms))
    for axes, kind in zip(grid[0], KINDS, strict=True):
        arms = [arm for arm in results["arms"] if arm["kind"] == kind]
        best = [arm for arm in results["candidates"] if arm["kind"] == kind]
        dress(axes, f"{kind}: {len(arms)} arms", "mass of the forearm / of the upper arm", "length of the upper arm, m")
        places = [([arm["length1"] for arm in some], [arm["mass2"] / arm["mass1"] for arm in some])
                  for some in (arms, best)]  # fmt: skip
        axes.scatter(*places[0], norm=norm, cmap="viridis", s=45, c=[arm["length2"] for arm in arms])
        axes.plot(*places[1], "*", ms=16, mfc="none", color=INK)
        axes.set_yscale("log")
        for labels in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            labels("{x:g}")
        axes.tick_params(axis="y", which="both", labelsize=8)
    bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=grid[0, -1])
    bar.set_label("length of the forearm, m", size=8)
    bar.ax.tick_params(labelsize=8)
    save(figure, path)


def _draw_motion(results: dict[str, Any], path: Path) -> None:
    draw_frames([{**arm, "title": _name(arm), "effort": arm["last"]} for arm in results["candidates"]], path)


STUDY = Study("masses", "the direct method, and which arm has the paper's efforts (2.1)",
              _run, _page, _rows, {"masses.png": _draw, "fig3.png": _draw_motion}, seconds=40,
              full=partial(_run, FULL))  # fmt: skip
