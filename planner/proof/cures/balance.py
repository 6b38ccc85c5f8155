"""Machines on their feet: a goal on which one cannot stand, and one that falls on its way."""

from __future__ import annotations

from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.cures.cure import FILE, Cure, no_cure
from planner.proof.verdict import Proof

FALLS_BY = 5.0  # in a motion an error grows by exp(5), 150 times: more than from a hundredth to all of it
FALLS = (
    "goal is put on the ground, where it does not balance by itself: "  # as cases.problem_file.ground_placement says it
)


def standing_goal(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """The reason why a machine that ends elsewhere, or does not end, cannot stand where it was asked to."""
    if problem.case != FILE or (proof is not None and proof.goal.passed and proof.your_file.passed):
        return []
    _, falls, why = problem.parameters["resolved"]["reasons"].get("settle", "").partition(FALLS)
    return [no_cure("goal", f"No plan stays at the goal: {why.split(' goal goes ')[0]}")] if falls else []


def loses_balance(proof: Proof) -> bool:
    """Whether a machine on the ground falls whose gains keep its ranges: the stops that it meets then are no cause."""
    problem = proof.replay.plan.problem
    mechanism = getattr(getattr(problem, "dynamics", None), "mechanism", None)
    if mechanism is None or not mechanism.contacts or proof.mode is not None or not proof.plan.passed:
        return False
    kept = not any(one.name == "position_range_violation" for one in proof.refined_feedback.failures)
    return kept and _growth(proof) * proof.replay.plan.t[-1] > FALLS_BY


def _growth(proof: Proof) -> float:
    """The rate at which errors grow without gains, 1/s; NaN where it is not known."""
    return next((one.value for one in proof.growth.measured if one.name == "growth_rate_open_loop"), float("nan"))


def falling(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """That the machine does not balance on its way, after all cures that there are for it."""
    if proof is None or not loses_balance(proof):
        return []
    rate = _growth(proof)
    share = float(proof.errors.measured["feedback"].max())
    why = (
        f"The machine loses its balance: an error grows as exp({rate:.3g} t), t in s, and with the plan's gains it "
        f"becomes {share:.3g} times what passes; no key of the problem is known that mends it"
    )
    return [no_cure("goal", why)]
