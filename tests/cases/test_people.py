"""Other people of the box that the human step is made for: they converge, and clear of the belt."""

import numpy as np
import people
import pytest

from planner.cases.human_step.cost import FASTER, SLOWER, USUAL, step_tolerances
from planner.cases.human_step.gait import NORMAL_GAIT
from planner.cases.human_step.walker import GaitPhase, Walker


@pytest.mark.slow
@pytest.mark.parametrize("person", people.people(4, seed=7), ids=lambda person: f"{person['cycle_time']:.2f} s")
def test_random_people_walk(person):
    row = people.attempt(person, "cycle", proof=False)
    assert row["success"], row["reasons"]


@pytest.mark.slow
@pytest.mark.parametrize("person", people.people(3, seed=8), ids=lambda person: f"{person['cycle_time']:.2f} s")
def test_random_people_swing(person):
    row = people.attempt(person, "swing", proof=False)
    assert row["success"], row["reasons"]


def step(duration):
    return GaitPhase(Walker(), NORMAL_GAIT, duration, 0.0, 240, duration / 240)


@pytest.mark.parametrize(("duration", "powers"), [(2.0 * USUAL, SLOWER), (0.5 * USUAL, FASTER)])
def test_tolerances_go_with_the_time_of_a_cycle(duration, powers):
    usual, other = (step_tolerances(step(time), "default", None, None) for time in (USUAL, duration))
    for name, power in powers.items():
        assert getattr(other, name) / getattr(usual, name) == pytest.approx((duration / USUAL) ** power)
    assert step_tolerances(step(duration), "study", None, None) == step_tolerances(step(USUAL), "study", None, None)


def test_a_share_has_an_interval():
    """Wilson's of 98 in 100, from the formula's own equation: |p - share| = z sqrt(p (1 - p) / n) at both ends."""
    for p in people.interval(98, 100):
        assert abs(p - 0.98) == pytest.approx(1.96 * np.sqrt(p * (1.0 - p) / 100.0))
