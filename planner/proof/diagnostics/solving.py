"""Diagnose a solve that did not converge, or whose stage is too long.

A first guess that diverges, too few iterations, no further progress; the error of the plan's step, or a cycle that is
not found or not followed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.base.measured import Quantity
from planner.dynamics.protocol import integrator_of
from planner.model.capabilities import capabilities_of
from planner.problem.plan import Iteration, Plan, Status
from planner.problem.problem import Problem
from planner.problem.recording import STEPS_PER_ROW
from planner.proof.diagnostics.suggested_fix import (
    ITERATIONS,
    SuggestedFix,
    fix,
    has_searched_duration,
    no_fix,
    of_file,
    rounded_up,
)
from planner.proof.error_propagation import FACTOR
from planner.proof.verdict import Proof, contact_error
from planner.solvers.options import EXPECTED_REDUCTION_TOLERANCE

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


MAX_RATE_STEP = 1.0  # of the fastest eigenvalue times the stage: RK4 is stable up to 2.8 and exact to a percent at 1
MAX_TIMES = 30.0  # upper limit of the factor on the iterations
MAX_WORK_TIMES = 10.0  # of the work that a solve was given: what needs more is too large, not cut too early
MANY_SUBSTEPS = 8  # of RK4 in a stage: on a mobile arm of 15 joints 16 of them cost 4.5 times as much as Rosenbrock's
STARTS = 8
_FEW = 8  # number of iterations below which no trend is fitted
_GAINED = 1e-3  # of the cost: smallest reduction in the second half of a solve that justifies more iterations


def first_guess(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The stage length for the machine's fastest eigenvalue, or another first guess, for a diverging first guess."""
    if plan.status is not Status.NOT_FINITE:
        return []
    dt, found = problem.dynamics.dt, []
    rate = float(np.abs(rates_at_start(problem)).max())
    if rate * dt > MAX_RATE_STEP:
        value = rounded_step(problem.duration, MAX_RATE_STEP / rate)
        found.append(fix(problem, "dt", value, "rate_too_fast", rate=rate, per_stage=rate * dt))
    if of_file(problem):
        other = {"hold": "zero", "zero": "hold"}.get(problem.parameters.get("guess", "hold"), "zero")
        found.append(fix(problem, "guess", other, "guess_runs_away"))
    return found


def more_iterations(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Number of iterations, extrapolated from the trend of the decrease."""
    if plan.status not in (Status.MAX_ITERATIONS, Status.WORK_LIMIT):
        return []
    if has_searched_duration(plan):  # which the budget cut, or its last solve
        more = rounded_up(2.0 * plan.options["work"]) if plan.status is Status.WORK_LIMIT else None
        return [] if more is None else [fix(problem, "work", more, "search_cut", tried=len(plan.options["tried"]))]
    lines = [line for line in plan.history if line.step > 0.0]
    needed = iterations_needed(lines, plan.cost)
    if needed is None:
        return []
    left = lines[-1].expected / max(1.0, abs(plan.cost))
    key, value = ITERATIONS, needed
    if plan.status is Status.WORK_LIMIT:
        times = max(needed / max(plan.nit, 1), 2.0)
        if times > MAX_WORK_TIMES:
            return [_cheaper_stages(plan, problem)]
        key, value = "work", rounded_up(plan.options["work"] * times)
    return [fix(problem, key, value, "more_iterations", iterations=plan.nit, left=left)]


def _cheaper_stages(plan: Plan, problem: Problem) -> SuggestedFix:
    """The implicit method, whose stage is cheaper than many substeps of RK4; else no value."""
    substeps = getattr(problem.dynamics, "substeps", 1)
    values = {"work": plan.options["work"], "iterations": plan.nit, "stages": plan.N, "substeps": substeps}
    mechanism = capabilities_of(problem.dynamics).mechanism
    able = mechanism is not None and not mechanism.has_closed_chains  # which the Rosenbrock method does not keep
    if able and of_file(problem) and getattr(problem.dynamics, "integrator", "") == "rk4" and substeps >= MANY_SUBSTEPS:
        return fix(problem, "integrator", "rosenbrock", "stages_cost_too_much", **values)
    return no_fix("work", "stages_cost_too_much", **values)


def other_guesses(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Several first guesses, for a solve that did not converge from one."""
    stalls = plan.status in (Status.MAX_ITERATIONS, Status.NO_DESCENT)  # what its work cut has none for several
    if not stalls or has_searched_duration(plan) or problem.parameters.get("starts", 1) != 1 or len(plan.starts) > 1:
        return []
    return [fix(problem, "starts", STARTS, "stalled", cost=plan.cost, gradient=plan.gradient_norm)]


def iterations_needed(lines: list[Iteration], cost: float) -> int | None:
    """Iterations until the expected decrease is below the tolerance, by its trend; None if it does not fall."""
    if not lines:
        return None
    half = lines[len(lines) // 2 :]
    gained = half[0].cost - cost
    expected = np.array([line.expected for line in half])
    if len(lines) < _FEW:  # stopped early
        return 1000 if len(lines) < 1000 else None
    if np.any(expected <= 0.0) or not np.isfinite(expected).all():
        return None
    slope = float(np.polyfit(np.arange(len(half)), np.log(expected), 1)[0])
    enough = EXPECTED_REDUCTION_TOLERANCE * max(1.0, abs(cost))
    if slope >= 0.0:
        return 10 * len(lines) if gained > _GAINED * abs(cost) else None
    more = max(0.0, math.log(expected[-1] / enough) / -slope)
    if more > MAX_TIMES * len(lines):
        return 10 * len(lines) if gained > _GAINED * abs(cost) else None
    return int(rounded_up(1.5 * more + len(lines)))


def not_a_minimum(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """For a solve that converged though its cost may still fall: how to go on, or to skip the optimality check."""
    if not plan.converged and plan.status not in (Status.INTERRUPTED, Status.NO_DESCENT):
        return []  # what kept it from converging is the cause
    if proof is not None and not proof.asked.get("optimal", True):
        return []  # feasibility alone is judged
    failures = {} if proof is None else {one.name: one.value for one in proof.optimality.failures}
    if "decrease_left" in failures:
        return [no_fix("optimal", "not_a_minimum", left=failures["decrease_left"])]
    if "negative_curvature" in failures:
        return [no_fix("optimal", "saddle", curvature=failures["negative_curvature"])]
    return []


def other_model(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The model that is replayed, where its numbers are not the plan's."""
    wrong: set[str] = set() if proof is None else {one.name for one in proof.parity.failures}
    numbers = {"mass_matrix_error", "bias_force_error", "actuator_force_error", "acceleration_error"}
    numbers |= {"driven_acceleration_error", "rate_error"}
    return [no_fix("model", "other_model")] if wrong & numbers and "unmodelled_elements" not in wrong else []


def nothing_known(plan: Plan, problem: Problem, proof: Proof | None) -> SuggestedFix:
    """The finding without a known cause: the first that failed, but of the replay that was judged."""
    failed = []
    if proof is not None:
        other = ("refined_open_loop", "order") if proof.replay.feedback else ("refined_feedback",)
        sections = [section for name, section in proof.sections.items() if name not in other]
        failed = [one for section in sections for one in section.failures]
    what = failed[0].name.replace("_", " ") if failed else "the end of the solve"
    code = "unknown_of_time" if has_searched_duration(plan) else "unknown"  # whose problem has no duration of its own
    code = "unknown_of_recording" if plan.status is Status.GIVEN else code
    return no_fix("", code, failed=what, duration=Quantity(problem.duration, "s"))
