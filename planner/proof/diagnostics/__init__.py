"""suggested_fixes(): changes of the problem that will make a failed plan pass, with values computed from measurements.

Each file detects one kind of cause and returns its fix; here they are in the order of causes before their effects: a
weak motor makes the end miss its goal, a joint outside its range makes the replay differ. suggested_fix.py has
the text of every code.
"""

from __future__ import annotations

from planner.problem.plan import Plan, Status
from planner.proof.diagnostics.avoid_contact import avoid_contact, no_way_around
from planner.proof.diagnostics.effort import longer, more_time, passing_duration, too_little_thrust
from planner.proof.diagnostics.goals import (
    falling,
    gait_needed,
    ignored_stance,
    jump_not_found,
    larger_weights,
    not_moved,
    standing_goal,
    untouched,
    without_ignored,
)
from planner.proof.diagnostics.limits import clamped_in_file, fixed_joints, soft_equalities, wider_margin, within_limits
from planner.proof.diagnostics.solving import (
    clamped_between,
    contacts_differ,
    cycle_not_found,
    failing_cycle,
    first_guess,
    more_iterations,
    not_a_minimum,
    nothing_known,
    other_guesses,
    other_model,
    shorter_stage,
    sparse_rows,
)
from planner.proof.diagnostics.suggested_fix import SuggestedFix
from planner.proof.verdict import Proof

__all__ = ["SuggestedFix", "longer", "standing_goal", "suggested_fixes"]

_CAUSES = (
    other_model, too_little_thrust, standing_goal, gait_needed, first_guess, jump_not_found, no_way_around,
    avoid_contact, fixed_joints, untouched, not_moved, more_time, passing_duration, within_limits,
    without_ignored, more_iterations, shorter_stage, clamped_between, wider_margin, ignored_stance, larger_weights,
    other_guesses, falling, contacts_differ, not_a_minimum, soft_equalities, clamped_in_file,
)  # fmt: skip
_OF_RECORDINGS = (
    other_model,
    sparse_rows,
    contacts_differ,
    soft_equalities,
    clamped_in_file,
)  # nobody chose weights or a duration
_OF_CYCLES = (
    cycle_not_found,
    avoid_contact,
    fixed_joints,
    within_limits,
    more_iterations,
    ignored_stance,
    clamped_in_file,
    failing_cycle,
)


def suggested_fixes(plan: Plan, proof: Proof | None = None) -> tuple[SuggestedFix, ...]:
    """Suggested fixes of a plan, the most likely first; empty for one that passed, or without a known cause.

    Args:
        plan: With its problem.
        proof: Of the plan; None for a plan that was not replayed.
    """
    done = (plan.converged or plan.status in (Status.GIVEN, Status.INTERRUPTED)) and not plan.missed_goals
    if done if proof is None else proof.passed:
        return ()
    if plan.problem is None:
        return ()
    found: dict[str, SuggestedFix] = {}
    causes = _CAUSES if plan.problem.periodic is None else _OF_CYCLES
    for cause in _OF_RECORDINGS if plan.status is Status.GIVEN else causes:
        for one in cause(plan, plan.problem, proof):
            found.setdefault(one.key, one)
        if any(one.value is None for one in found.values()):  # later findings are its effects
            break
    return tuple(found.values()) or (nothing_known(plan, plan.problem, proof),)
