"""cures(): what to write so that a plan that failed will pass, with values computed from what was measured.

Each file looks for one kind of cause and returns cures of it; here they stand in the order in which causes come before
their effects: a motor that is too weak makes the end miss its goal, a joint beyond its range makes the replay differ.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

from planner.problem.plan import Plan, Status
from planner.proof.cures.avoid_contact import avoid_contact
from planner.proof.cures.balance import falling, standing_goal
from planner.proof.cures.cure import Cure
from planner.proof.cures.effort import longer, more_time
from planner.proof.cures.goals import larger_weights, without_ignored
from planner.proof.cures.limits import left_no_room, not_driven, wider_margin, within_limits
from planner.proof.cures.solving import first_guess, more_iterations, not_a_minimum, nothing_known, other_guesses
from planner.proof.cures.stage import calmer_gains, shorter_stage
from planner.proof.cures.velocity_weight import penalize_velocity
from planner.proof.verdict import Proof

__all__ = ["Cure", "cures", "in_order", "longer"]

_CAUSES = (
    standing_goal, first_guess, left_no_room, not_driven, avoid_contact, more_time, penalize_velocity, within_limits,
    without_ignored, more_iterations, shorter_stage, calmer_gains, wider_margin, larger_weights, other_guesses, falling,
    not_a_minimum,
)  # fmt: skip
_found: WeakKeyDictionary[Plan, tuple[str, tuple[Cure, ...]]] = WeakKeyDictionary()  # by the reason of the FAIL


def cures(plan: Plan, proof: Proof | None = None) -> tuple[Cure, ...]:
    """What to write so that a plan passes, the most likely first; empty for one that passed, or where nothing is known.

    Args:
        plan: With its problem.
        proof: Of the plan; None for a plan that was not replayed.
    """
    done = plan.status in (Status.CONVERGED, Status.GIVEN, Status.INTERRUPTED) and not plan.missed
    if done if proof is None else proof.verdict == "PASS":
        return ()
    if plan.problem is None or plan.problem.periodic is not None:
        return ()
    reason = "" if proof is None else proof.reason
    if plan in _found and _found[plan][0] == reason:
        return _found[plan][1]
    found: dict[str, Cure] = {}
    for cause in _CAUSES:
        for cure in cause(plan, plan.problem, proof):
            found.setdefault(cure.key, cure)
        if any(cure.value is None for cure in found.values()):  # what follows is its effect
            break
    return in_order(plan, proof, tuple(found.values()) or (nothing_known(plan, plan.problem, proof),))


def in_order(plan: Plan, proof: Proof | None, found: tuple[Cure, ...]) -> tuple[Cure, ...]:
    """The cures of a plan as whoever tried them knows them: what cures() says from now on."""
    _found[plan] = "" if proof is None else proof.reason, found
    return found
