"""How far steps of a proof are from passing."""

import math

import pytest

from planner.base.measured import Measurement, Section, bound_excess


def test_the_worst_failure_counts_over_its_bound():
    passing = Section("a", (Measurement("x", 0.5, "", 1.0), Measurement("y", 9.0)))
    failing = Section("b", (Measurement("x", 3.0, "", 2.0), Measurement("z", 5.0, "", 2.0)))
    assert bound_excess([passing]) == 0.0
    assert bound_excess([passing, failing]) == 2.5


def test_what_is_no_number_or_may_not_be_at_all_is_furthest():
    assert bound_excess([Section("a", (Measurement("x", math.nan, "", 1.0),))]) == math.inf
    assert bound_excess([Section("a", (Measurement("warnings", 1.0, "", 0.0),))]) == math.inf


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.97, "path angle error 0.97 rad (97 % of its bound 1)"), (0.0123, "path angle error 0.0123 rad (1 % of its "
        "bound 1)"), (1e-9, "path angle error 1e-09 rad (less than 0.1 % of its bound 1)"),
    ],
)  # fmt: skip
def test_a_value_says_what_share_of_its_bound_it_is(value, words):
    assert Measurement("path_angle_error", value, "rad", 1.0).bound_share_text == words
