"""refine(): solve again at a finer step where a proof fails because of the plan's step.

A plan is optimal for its own integrator, and an optimizer finds what an integrator gives away, energy for one. Then the
plan is sound, its model is MuJoCo's, MuJoCo agrees at the plan's own step, and at a refined one it goes elsewhere.

    until    the proof passes, or something else than the step is wrong
    repeat   take the next finer problem: RK4 in place of Euler, then half the stage
             its first guess: the plan followed there, or whatever else costs less
             solve, prove.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

from planner.base.arguments import count, short_repr
from planner.base.errors import PlannerError
from planner.problem.plan import Plan, Status
from planner.problem.rediscretize import finer
from planner.proof import Proof
from planner.proof import prove as full_proof
from planner.proof.error_propagation import FACTOR
from planner.proof.error_scales import shares_of_bounds
from planner.proof.original_model import OVERLAPS_THAT_PUSH
from planner.proof.replays.replaying import reached_by_plan
from planner.proof.verdict import FALLEN, contact_error
from planner.solvers.gains import warm_start
from planner.solvers.slq import solve
from planner.solvers.work import DEFAULT_WORK, WorkBudget, budget_of

SAME = 0.1  # of an end error beyond its bound: where half the step changes it by less, it is not of the step


class Refinement(NamedTuple):
    """One plan of a sequence of refinements.

    Attributes:
        integrator: Of the plan.
        dt: Length of a stage, s.
        horizon: N, number of stages.
        iterations: The solve took.
        cost: J of Eq. 9, the plan's.
        status: How the solve ended.
        verdict: "PASS" or "FAIL".
        mode: In which it passed, or None.
        end_error: The largest error of MuJoCo's end as a share of what passes of a path, in that mode, else open
            loop.
        seconds: Solve and proof took; nan for the plan that refine() was given.
    """

    integrator: str
    dt: float
    horizon: int
    iterations: int
    cost: float
    status: Status
    verdict: str
    mode: str | None
    end_error: float
    seconds: float

    def __str__(self) -> str:
        verdict = f"{self.verdict} ({self.mode})" if self.mode else self.verdict
        took = "" if math.isnan(self.seconds) else f"{self.seconds:.1f}"
        return (
            f"{self.integrator:>19}  {self.dt:9.4g}  {self.horizon:7d}  {self.iterations:10d}  {self.cost:13.6g}  "
            f"{self.end_error:15.2e}  {took:>7}  {verdict:<16}  {self.status.name}"
        )

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes."""
        return (
            f"{'integrator':>19}  {'stage, s':>9}  {'horizon':>7}  {'iterations':>10}  {'cost':>13}  "
            f"{'end error/bound':>15}  {'seconds':>7}  {'verdict':<16}  status"
        )


@dataclass(frozen=True, eq=False)
class Refined:
    """The result of refine().

    Attributes:
        plan: The last plan that was proved; the one that refine() was given where two in a row are further off.
        proof: Its proof.
        path: One Refinement per plan, the first of which is the one that refine() was given.
        reason: Why it ended there, in a sentence.
    """

    plan: Plan
    proof: Proof
    path: tuple[Refinement, ...]
    reason: str

    @property
    def passed(self) -> bool:
        """Whether the verdict on the plan is PASS."""
        return self.proof.passed

    def __str__(self) -> str:
        return f"Refined({self.proof.verdict} after {_counted(len(self.path) - 1)}: {self.reason})"

    __repr__ = __str__


def refine(
    plan: Plan, proof: Proof, *, limit: int = 4, budget: WorkBudget | float | None = None,
    prove: Callable[[Plan], Proof] | None = None, callback: Callable[[Refinement], object] | None = None,
    max_iterations: int = 1000, **options: Any,
) -> Refined:  # fmt: skip
    """Solve and prove again at finer steps, while the plan's step is the cause of a FAIL.

    Args:
        plan: A plan with its problem.
        proof: The proof of that plan.
        limit: The most refinements.
        budget: The work of the solves and proofs; by default DEFAULT_WORK. A solve that it cuts is forgotten.
        prove: The function that judges the refined plans; by default prove() without perturbed rollouts.
        callback: Called with each Refinement, that of the given plan included; print makes a table. It may raise
            StopIteration to end.
        max_iterations: Of each solve.
        options: Of solve(): update, line_search, hessian, gradient_tolerance, expected_reduction_tolerance,
            actual_reduction_tolerance.

    Returns:
        The plan to keep, and why there is no other. That it never passed is its proof's verdict, not an exception.

    Raises:
        PlannerError: A wrong argument; or a refined plan cannot be replayed at all.
    """
    if not isinstance(plan, Plan) or plan.problem is None:
        raise PlannerError(f"plan is {short_repr(plan)}, expected a Plan with its problem.")
    if not isinstance(proof, Proof):
        raise PlannerError(f"proof is {short_repr(proof)}, expected the Proof of the plan.")
    count("limit", limit, minimum=0)
    count("max_iterations", max_iterations)
    work = budget_of(budget) or WorkBudget(DEFAULT_WORK)
    prove = prove or partial(full_proof, rollouts=0)
    path: list[Refinement] = []
    with_gains: list[float] = []  # errors of the ends: open loop a machine that falls has any
    given = plan, proof

    def ended(plan: Plan, proof: Proof, seconds: float) -> bool:
        line = _line(plan, proof, seconds)
        path.append(line)
        with_gains.append(_end_error(proof, "feedback"))
        try:
            if callback is not None:
                callback(line)
        except StopIteration:
            return True
        return False

    interrupted = ended(plan, proof, math.nan)
    while True:
        reason = _done(proof, path, limit) or ("It was interrupted." if interrupted else "")
        if not (interrupted or proof.passed) and plan.status is not Status.UNRESOLVED and _grows(with_gains):
            reason, (plan, proof) = "Two finer steps end further off: the plan before them is kept.", given
        if reason or work.exhausted:
            reason = reason or work.end.value
            break
        began = time.monotonic()
        assert plan.problem is not None
        try:
            problem = finer(plan.problem, keep_substeps=plan.status is Status.UNRESOLVED)
        except PlannerError as error:
            reason = f"It cannot be refined: {error}"
            break
        work.charge_warm_start(problem)
        allowed = work.before_proof(problem)
        if allowed.exhausted:
            reason = work.end.value
            break
        better = solve(
            replace(problem, us=warm_start(plan, problem)), max_iterations=max_iterations, budget=allowed, **options
        )  # fmt: skip
        stage = f"at a stage of {problem.dynamics.dt:.3g} s"
        if better.status is Status.NOT_FINITE:
            reason = f"The plan's controls lead to infinite states {stage}."
            break
        if better.status in (Status.WORK_LIMIT, Status.TIME_LIMIT):
            reason = f"{better.status.value[:-1]}, {stage}."
            break
        work.charge_proof(problem)
        interrupted = better.status is Status.INTERRUPTED
        plan, proof = better, prove(better)
        interrupted |= ended(plan, proof, time.monotonic() - began)
    return Refined(plan, proof, tuple(path), reason)


def _done(proof: Proof, path: list[Refinement], limit: int) -> str:
    """The reason to end with this plan; "" to go on."""
    refinements = len(path) - 1
    if proof.passed:
        return f"It passed after {_counted(refinements)}." if refinements else "It passed as it was."
    if other := _other_cause(proof):
        return f"A finer step does not help where {other}"
    if refinements > 1 and proof.replay.plan.status is not Status.UNRESOLVED and _same(path[-2], path[-1]):
        return "A finer step does not help where half of it hardly changes the error of the end."
    return f"The limit of {_counted(limit)} was reached." if refinements >= limit else ""


def _grows(errors: list[float]) -> bool:
    """Whether the last two plans end beyond their bounds, and further off than the one that was given."""
    return len(errors) > 2 and min(errors[-2:]) > max(1.0, errors[0])


def _same(before: Refinement, now: Refinement) -> bool:
    """Whether half the step leaves an error of the end beyond its bound as it was, at which nothing has fallen."""
    if not (1.0 < now.end_error < FALLEN and before.end_error < FALLEN):
        return False
    return abs(before.end_error - now.end_error) <= SAME * before.end_error


def _counted(refinements: int) -> str:
    return f"{refinements} refinement{'' if refinements == 1 else 's'}"


def _other_cause(proof: Proof) -> str:
    """Say what else than the plan's step makes a proof FAIL; "" when the step does.

    It does where the plan is sound and its model MuJoCo's (steps 0 to 2), the plan itself gets where it should, and
    still MuJoCo does something else at a refined step: then only the steps differ.
    """
    reached = reached_by_plan(proof.replay)  # first: MuJoCo holds it there at its own step too
    if reached:
        return f"the plan itself goes where MuJoCo holds it: {reached[0]}"
    for section in (proof.plan, proof.parity, proof.same_step):
        if not section.passed:
            return f"{section.title} fails: {section.failures[0]}."
    goal_failures = [one for one in proof.goal.failures if one.name.startswith("planned")]
    if goal_failures:
        return f"the plan itself misses its goal: {goal_failures[0]}."
    if proof.replay.plan.status is Status.UNRESOLVED:
        return ""
    if any(one.name == OVERLAPS_THAT_PUSH for one in proof.your_file.measured):
        return f"shapes of the file overlap at the start: {proof.your_file.failures[0]}."
    for mode, section in (("open-loop", proof.refined_open_loop), ("feedback", proof.refined_feedback)):
        if section.passed:
            return f"MuJoCo repeats the plan ({mode}): {proof.reason}"
        ratio = proof.errors.ratio(mode)
        if ratio is not None and ratio > FACTOR:
            return f"the replay is {ratio:.3g} times worse than the step makes it ({mode})."
    if (found := contact_error(proof)) is not None:
        off, by_step = found
        return f"contacts put the replay {off:.3g} bounds off its path, the step only {by_step:.2g} (feedback)."
    return ""


def _end_error(proof: Proof, mode: str) -> float:
    """The largest error of a replay's end as a share of what passes of a path; infinite where MuJoCo ran away."""
    run = proof.replays[mode]
    error = float(shares_of_bounds(run.plan, run.error[-1:])[0])
    return error if error < math.inf else math.inf


def _line(plan: Plan, proof: Proof, seconds: float) -> Refinement:
    assert plan.problem is not None
    dynamics = plan.problem.dynamics
    return Refinement(
        getattr(dynamics, "integrator", ""), dynamics.dt, plan.N, plan.nit, plan.cost, plan.status, proof.verdict,
        proof.mode, _end_error(proof, proof.mode or "open-loop"), seconds,
    )  # fmt: skip
