"""A stage that is too long.

MuJoCo at a refined step goes elsewhere, as the plan's own integrator predicts it; or gains that were made for controls
that are held over a stage shake a machine that swings to and fro within one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.base.diagnostic import Quantity
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.rediscretize import FIRST_ORDER
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix
from planner.proof.error_propagation import FACTOR
from planner.proof.original_model import OPEN_LOOP_MISSES
from planner.proof.step_convergence import NOMINAL
from planner.proof.verdict import Proof

TARGET_SHARE = 0.5  # of what passes: the error that is aimed at
MAX_DIVISION = 16  # times shorter: beyond, something else is wrong
MAX_SWING = (
    1.0  # of the fastest oscillation's rad/s times the stage: gains for a held control then act within its swing
)
_SHORT = 1e-4  # of a stage
_SLACK = 1.001  # a stage that is a tenth of a percent too long is not too long
_MANTISSAS = (5.0, 4.0, 2.5, 2.0, 1.0)  # of steps that people write


def shorter_stage(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The stage at which the integrator's error is half of what passes, by its order."""
    if proof is None or not all(one.passed for one in (proof.plan, proof.parity, proof.same_step)):
        return []
    if proof.refined_feedback.passed and (proof.mode is not None or proof.refined_open_loop.passed):
        return []
    dt, integrator = problem.dynamics.dt, getattr(problem.dynamics, "integrator", "rk4")
    ratio = proof.errors.ratio("feedback")
    share = float(proof.errors.measured["feedback"].max())
    predicted = float(proof.errors.predicted["feedback"].max())
    as_predicted = ratio is not None and ratio <= FACTOR
    if not (predicted > 1.0 or (as_predicted and max(share, _cost_share(proof)) > 1.0)):
        return []
    if integrator in FIRST_ORDER:
        return [fix(problem, "integrator", "rk4", "first_order", integrator=integrator, share=_times(share))]
    step_order = _order(proof, integrator)
    worst = max(one for one in (share, predicted, _cost_share(proof)) if math.isfinite(one) or one == predicted)
    parts = (worst / TARGET_SHARE) ** (1.0 / step_order) if math.isfinite(worst) else float(MAX_DIVISION)
    value = rounded_step(problem.duration, dt / min(max(parts, 2.0), MAX_DIVISION))
    values = {"dt": Quantity(dt, "s"), "share": _times(worst), "order": step_order}
    return [fix(problem, "dt", value, "stage_too_long", **values)]


def calmer_gains(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The stage whose gains follow the fastest oscillation, where gains alone keep the user's file from its goals."""
    if proof is None or not proof.refined_feedback.passed or proof.your_file.passed:
        return []
    open_loop_error = next((one.value for one in proof.your_file.measured if one.name == OPEN_LOOP_MISSES), math.nan)
    swing = float(np.abs(np.imag(rates_at_start(problem))).max())
    dt = problem.dynamics.dt
    if open_loop_error != 0.0 or not MAX_SWING < swing * dt < math.inf:
        return []
    value = rounded_step(problem.duration, max(MAX_SWING / swing, dt / MAX_DIVISION))
    values = {"dt": Quantity(dt, "s"), "swing": Quantity(swing * dt, "rad")}
    return [fix(problem, "dt", value, "gains_too_fast", **values)]


def rates_at_start(problem: Problem) -> np.ndarray:
    """The eigenvalues of the dynamics linearized at the start, 1/s, complex; infinite where there are none.

    The stage that they are taken from is so short that it is exp(h J) nearly.
    """
    dynamics = problem.dynamics
    with_step = getattr(dynamics, "with_step", None)
    if not callable(with_step):
        return np.zeros(1, dtype=complex)
    h = _SHORT * dynamics.dt
    finer: Any = with_step(h, getattr(dynamics, "integrator", None))
    A, _ = finer.linearize(np.stack([problem.x0, problem.x0]), problem.first_guess[:1])
    if not np.isfinite(A).all():
        return np.array([complex(math.inf, math.inf)])
    return np.log(np.linalg.eigvals(A[0]).astype(complex)) / h


def rounded_step(duration: float, most: float) -> float:
    """The longest stage up to `most` that people would write, of which the duration is a whole number."""
    power = 10.0 ** math.floor(math.log10(most))
    for scale in (power, power / 10.0, power / 100.0):
        for mantissa in _MANTISSAS:
            step = float(f"{mantissa * scale:.3g}")
            stages = duration / step
            if step <= most * _SLACK and abs(round(stages) - stages) < 1e-9 * stages:
                return step
    return duration / math.ceil(duration / most)


def _times(share: float) -> Quantity | str:
    return Quantity(share, "times") if math.isfinite(share) else "any number of times"


def _order(proof: Proof, integrator: str) -> float:
    nominal = NOMINAL.get(integrator, 4.0)
    observed = proof.convergence.observed
    known = observed is not None and np.isfinite(observed) and not proof.convergence.judged
    return float(min(max(observed, 1.0), nominal)) if known else nominal  # type: ignore[arg-type]


def _cost_share(proof: Proof) -> float:
    """The largest error of the cost over its bound, with the gains."""
    return max((one.value / one.bound for one in proof.refined_feedback.measured
                if one.name == "cost_error" and one.bound), default=0.0)  # fmt: skip
