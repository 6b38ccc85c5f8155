"""Plans whose controls are mostly at bounds: what a sweep promises is tried there; what is no minimum still fails."""

from dataclasses import replace

import numpy as np
import pytest
from carts import cart
from rolled_out_plans import rolled_out

import planner
from planner import Limits
from planner.proof import consistency


def test_full_force_that_turns_too_late_is_no_minimum():
    """1 kg on a rail: three quarters of the time ahead and one back end far beyond the goal."""
    problem = replace(cart(N=60, duration=2.02, control=1.0), limits=Limits(control=1.0))
    problem = replace(problem, us=np.where(np.arange(60) < 45, 1.0, -1.0)[:, None])
    plan = rolled_out(problem)
    assert consistency._clamped(plan, plan.problem)
    left = {one.name: one for one in planner.prove(plan, rollouts=0).optimality.measured}["decrease_left"]
    assert not left.passed
    assert "more steps of SLQ gain" in left.note


@pytest.mark.parametrize(
    ("duration", "steps", "passes"), [(2.02, 0.0, True), (2.02, 0.5, False), (2.4, 0.0, False)],
    ids=["achieves nothing", "achieves half", "few at bounds"],
)  # fmt: skip
def test_what_is_promised_counts_as_far_as_steps_achieve_it(monkeypatch, duration, steps, passes):
    """Untried where few controls are at bounds: a quarter of them in 2.4 s."""
    plan = planner.solve(cart(N=60, duration=duration, control=1.0))
    assert consistency._clamped(plan, plan.problem) == (duration < 2.1)
    own = consistency.lq.riccati
    monkeypatch.setattr(consistency.lq, "riccati", lambda *given, **named: own(*given, **named)._replace(value=-0.05))
    monkeypatch.setattr(consistency, "remaining_decrease", lambda plan, problem: steps * plan.cost)
    left = {one.name: one for one in planner.prove(plan, rollouts=0).optimality.measured}["decrease_left"]
    assert left.passed == passes
