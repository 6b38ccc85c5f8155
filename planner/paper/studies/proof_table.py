"""`planner paper --proofs`: what the proof says of machines of the paper and of others, PASS and FAIL, in one table."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.base.errors import PlannerError
from planner.base.measured import Measurement
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited
from planner.model.twin import Twin
from planner.paper.studies.study import row_of
from planner.problem.costs.tracking import TrackingCost
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof import Proof, prove
from planner.proof.error_scales import ranges_of_motion
from planner.proof.robustness.rollouts import MODES
from planner.proof.robustness.success_rate import SuccessRate
from planner.solvers.slq import solve

BUDGET = 20.0  # s of each perturbed step, so that the whole table takes less than five minutes
HEADS = (
    "machine", "verdict", "parity", "same step", "path error, open loop", "with gains", "goal", "success with gains",
    "mass margin", "growth, 1/s",
)  # fmt: skip


@dataclass(frozen=True)
class ProofExample:
    """One row: a problem, and edits of the model before the proof."""

    name: str  # in the table
    problem: Callable[[], Problem]
    faults: dict[str, dict[str, str]] | None = None  # edits of the model that is proved in


def _file(package: str, inside: str) -> Path:
    """Path of an MJCF file inside an installed package, which is found but not imported."""
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise PlannerError(f"{package} is not installed: pip install --no-deps {package.replace('_', '-')}.")
    return Path(spec.submodule_search_locations[0]) / inside


def _cart_pole(seconds: float) -> Problem:
    """dm-control's cart and pole, from hanging to upright."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(_file("dm_control", "suite/cartpole.xml")), 0.01)
    x0 = dynamics.mechanism.home.copy()
    x0[1] = np.pi
    return _reach(dynamics, x0, dynamics.mechanism.home, seconds)


def _double_pendulum() -> Problem:
    """Gymnasium's cart and two poles, one metre to the side, both poles up all the way."""
    file = _file("gymnasium", "envs/mujoco/assets/inverted_double_pendulum.xml")
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(file), 0.01)
    x0, goal = dynamics.mechanism.home.copy(), dynamics.mechanism.home.copy()
    x0[0], goal[0] = -0.5, 0.5
    return _reach(dynamics, x0, goal, 1.5)


def _reach(dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, seconds: float) -> Problem:
    N = round(seconds / dynamics.dt)
    cost = TrackingCost.joints(dynamics, goal, N, effort=1.0, final_position=200.0, final_velocity=200.0)
    return Problem(dynamics, cost, x0)


EXHIBITS = (
    ProofExample("hopper", cases.hopper),
    ProofExample("two-link", cases.two_link),
    ProofExample("acrobot", cases.acrobot),
    ProofExample("acrobot, from hanging", lambda: cases.acrobot(start="hanging")),
    ProofExample("cart and pole of dm-control, 3 s", lambda: _cart_pole(3.0)),
    ProofExample("double pendulum on a cart of Gymnasium", _double_pendulum),
    ProofExample("cart and pole in 2 s: beyond its ctrlrange", lambda: _cart_pole(2.0)),
    ProofExample("the paper's hopper: 50 steps of Euler", lambda: cases.hopper(integrator="euler", horizon=50)),
    ProofExample("acrobot, semi-implicit Euler at 0.02 s",
            lambda: cases.acrobot(integrator="semi-implicit-euler", horizon=150)),
    ProofExample("two-link, forearm 1 % heavier than planned", cases.two_link,
            faults={".//body[@name='forearm']/inertial": {"mass": "0.505"}}),
)  # fmt: skip


def proofs(
    rollouts: int = 256, budget: float | None = BUDGET, progress: Callable[[str], object] = lambda _: None
) -> list[dict[str, Any]]:
    """Plan and prove every exhibit with a number of rollouts and a budget in s; call `progress` with each name.

    A row for each has the machine's name, and the proof as JSON values or the reason why there is none.
    """
    rows = []
    for exhibit in EXHIBITS:
        progress(exhibit.name)
        try:
            plan = solve(exhibit.problem())
        except PlannerError as error:
            rows.append({"machine": exhibit.name, "missing": str(error)})
            continue
        proof = prove(plan, twin=_faulty(plan, exhibit), rollouts=rollouts, budget=budget)
        rows.append({"machine": exhibit.name, "cells": _cells(proof), **proof.to_dict()})
    return rows


def _faulty(plan: Plan, exhibit: ProofExample) -> Twin | None:
    """The plan's twin with the exhibit's faults, None for the plan's own."""
    if exhibit.faults is None or plan.twin is None:
        return None
    return replace(plan.twin, mjcf=edited(plan.twin.mjcf, exhibit.faults))


def _cells(proof: Proof) -> list[str]:
    """A row of the table after its name."""
    carlo, ranges = proof.monte_carlo, ranges_of_motion(proof.replay.plan)
    return [
        proof.headline,
        _value(
            max(
                (one.value for one in proof.parity.measured if one.name.endswith("error") and not one.unit), default=0.0
            )
        ),
        "not applicable" if proof.same_step.not_applicable else _value(proof.same_step.measured[0].value),
        *(_percent(float((np.abs(proof.replays[mode].error) / ranges).max())) for mode in MODES),
        _of_bounds(one for one in proof.goal.measured if one.name.startswith(("replayed", "final"))),
        "" if carlo is None else _rate(carlo.rates.get("feedback")),
        "" if carlo is None else _margin(carlo.margin.get("feedback", np.nan)),
        f"{proof.errors.rate('open-loop'):.1f}, {proof.errors.rate('feedback'):.1f}",
    ]


def _of_bounds(measured: Iterable[Measurement]) -> str:
    """The largest share of its bound that a measured value takes."""
    shares = [one.value / one.bound for one in measured if one.bound]
    return f"{_percent(max(shares))} of its tolerance" if shares else "not judged"


def _value(value: float) -> str:
    return f"{value:.1e}" if np.isfinite(value) else "runs away"


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %" if np.isfinite(share) else "runs away"


def _margin(margin: float) -> str:
    return f"{100.0 * margin:g} %" if np.isfinite(margin) else "no time"


def _rate(rate: SuccessRate | None) -> str:
    if rate is None:
        return ""
    low, high = rate.interval
    return f"{100.0 * rate.value:.0f} % ({100.0 * low:.0f} to {100.0 * high:.0f})"


def proofs_markdown(rows: list[dict[str, Any]]) -> str:
    """The table, and below it the reason of each failure."""
    lines = [row_of(HEADS), f"|{' --- |' * len(HEADS)}"]
    lines += [row_of([row["machine"], *(row.get("cells") or [row["missing"], *[""] * (len(HEADS) - 2)])])
              for row in rows]  # fmt: skip
    lines += ["", *(f"- {row['machine']}: {row['reason']}" for row in rows if row.get("verdict") == "FAIL")]
    return "\n".join(lines) + "\n"
