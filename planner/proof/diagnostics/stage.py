"""Diagnose a stage that is too long: the error of the plan's step, or a cycle that is not found or not followed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.base.measured import Quantity
from planner.dynamics.protocol import integrator_of
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.recording import STEPS_PER_ROW
from planner.proof.contact_errors import contact_error
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, no_fix, of_file
from planner.proof.error_propagation import FACTOR
from planner.proof.verdict import Proof

TARGET_SHARE = 0.5  # of the bound: the error to aim at
MAX_DIVISION = 16  # upper limit of the factor: with shorter stages the cause is another
_SHORT = 1e-4  # tolerance, relative to a stage
_SLACK = 1.001  # tolerance of 0.1 % by which a stage may be too long
_MANTISSAS = (5.0, 4.0, 2.5, 2.0, 1.0)  # of round step lengths


def shorter_stage(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The stage length at which the integrator's error is half of its bound, by the order of convergence."""
    if proof is None or not all(one.passed for one in (proof.plan, proof.parity, proof.same_step)):
        return []
    if proof.refined_feedback.passed and (proof.mode is not None or proof.refined_open_loop.passed):
        return []
    if contact_error(proof) is not None:
        return []
    dt, integrator = problem.dynamics.dt, getattr(problem.dynamics, "integrator", "rk4")
    ratio = proof.errors.ratio("feedback")
    share = float(proof.errors.measured["feedback"].max())
    predicted = float(proof.errors.predicted["feedback"].max())
    as_predicted = ratio is not None and ratio <= FACTOR
    if not (predicted > 1.0 or (as_predicted and max(share, _cost_share(proof)) > 1.0)):
        return []
    known = integrator_of(problem.dynamics)
    if known.order == 1:
        return [fix(problem, "integrator", known.finer, "first_order", integrator=integrator, share=_times(share))]
    step_order = _order(proof, problem)
    worst = max(one for one in (share, predicted, _cost_share(proof)) if math.isfinite(one) or one == predicted)
    parts = (worst / TARGET_SHARE) ** (1.0 / step_order) if math.isfinite(worst) else float(MAX_DIVISION)
    value = rounded_step(problem.duration, dt / min(max(parts, 2.0), MAX_DIVISION))
    values = {"dt": Quantity(dt, "s"), "share": _times(worst), "order": step_order}
    return [fix(problem, "dt", value, "stage_too_long", **values)]


def sparse_rows(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The rate of a recording at which as many steps from one row to the next would be short enough."""
    dt, parts = problem.dynamics.dt, plan.options.get(STEPS_PER_ROW, 1)  # a loop and older plans say none
    step = dt / getattr(problem.dynamics, "substeps", 1)
    return [
        no_fix(
            "recording", "rows_too_sparse", rate=Quantity(dt / (one.value * step * parts), "Hz"),
            **{**one.values, "dt": Quantity(step, "s")},
        )
        for one in shorter_stage(plan, problem, proof)
        if one.code == "stage_too_long"
    ]  # fmt: skip


def contacts_differ(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """That contacts put the replay off its path, where the step explains little of it."""
    if proof is None or not all(one.passed for one in (proof.plan, proof.parity, proof.same_step)):
        return []
    if proof.refined_feedback.passed or (found := contact_error(proof)) is None:
        return []
    return [no_fix("goal", "contacts_differ", **found._asdict())]


def clamped_between(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Half the stage, where all that fails is that forces which servos or gains add within a stage are clamped."""
    if proof is None or not proof.refined_feedback.passed or not (proof.plan.passed and proof.goal.passed):
        return []
    if [one.name for one in proof.your_file.failures] != ["clamped_actuators"]:
        return []
    dt = problem.dynamics.dt
    value = rounded_step(problem.duration, 0.5 * dt)
    return [fix(problem, "dt", value, "clamped_in_stage", dt=Quantity(dt, "s"))]


def rates_at_start(problem: Problem) -> np.ndarray:
    """Eigenvalues of the dynamics linearized at the start, 1/s, complex; infinite if there are none.

    Computed from a stage h so short that A is close to exp(h J).
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
    """The longest round stage length up to `most`, of which the duration is an integer multiple."""
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


def _order(proof: Proof, problem: Problem) -> float:
    nominal = float(integrator_of(problem.dynamics).order or 4)
    observed = proof.convergence.observed
    known = observed is not None and np.isfinite(observed) and not proof.convergence.judged
    return float(min(max(observed, 1.0), nominal)) if known else nominal  # type: ignore[arg-type]


def _cost_share(proof: Proof) -> float:
    """The largest error of the cost over its bound, with the gains."""
    return max((one.value / one.bound for one in proof.refined_feedback.measured
                if one.name == "cost_error" and one.bound), default=0.0)  # fmt: skip


def cycle_not_found(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Of a solve that ended without a cycle what may be asked for instead: what its plan touches is no cause."""
    ended = not plan.converged and not plan.status.cut
    return failing_cycle(plan, problem, proof) if ended else []


def failing_cycle(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Half the stage for a cycle that stages do not resolve; else what may be asked for instead."""
    if not of_file(problem) or problem.periodic is None:
        return []
    dt, table = problem.dynamics.dt, problem.parameters["periodic"]
    if plan.status is Status.UNRESOLVED:
        return [fix(problem, "dt", rounded_step(problem.duration, 0.5 * dt), "cycle_unresolved", dt=Quantity(dt, "s"))]
    travel = Quantity(float(np.linalg.norm(table.get("travel", 0.0))), "m")
    code = "cycle_not_followed" if plan.converged else "cycle_not_found"
    return [no_fix("periodic", code, travel=travel, duration=Quantity(problem.parameters["duration"], "s"))]
