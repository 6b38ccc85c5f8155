"""The largest level that is survived: the same from any guess, and few tries where the guess is right."""

import pytest

from planner.proof.robustness.monte_carlo import largest_survived


@pytest.mark.parametrize("near", [None, *range(-1, 10)])
@pytest.mark.parametrize("most", range(-1, 10))
def test_every_guess_finds_it_and_no_level_is_tried_twice(most, near):
    tried = []
    assert largest_survived(10, lambda level: tried.append(level) or level <= most, near) == most
    assert len(tried) == len(set(tried))
    assert len(tried) <= (4 if near is None else 7)
    if near == most:
        assert len(tried) <= 2
