"""How far steps of a proof are from passing."""

import math

from planner.base.measured import Measured, Section, beyond_bounds


def test_the_worst_failure_counts_over_its_bound():
    passing = Section("a", (Measured("x", 0.5, "", 1.0), Measured("y", 9.0)))
    failing = Section("b", (Measured("x", 3.0, "", 2.0), Measured("z", 5.0, "", 2.0)))
    assert beyond_bounds([passing]) == 0.0
    assert beyond_bounds([passing, failing]) == 2.5


def test_what_is_no_number_or_may_not_be_at_all_is_furthest():
    assert beyond_bounds([Section("a", (Measured("x", math.nan, "", 1.0),))]) == math.inf
    assert beyond_bounds([Section("a", (Measured("warnings", 1.0, "", 0.0),))]) == math.inf
