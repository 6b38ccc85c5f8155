"""Rates of success, their confidence intervals, the word they become, and when counting ends."""

import numpy as np
import pytest

from planner.proof.robustness.success import LOOKS, SuccessRate, enough, next_look


@pytest.mark.parametrize(
    ("successes", "of", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (1, 29, 0.0061, 0.1718)],
)
def test_success_has_wilsons_interval(successes, of, low, high):
    np.testing.assert_allclose(SuccessRate(successes, of).interval, (low, high), atol=6e-5)


def test_a_rate_of_nothing_says_nothing():
    assert SuccessRate(0, 0).interval == (0.0, 1.0)


def test_wilson_covers_the_true_rate():
    """Of many samples, about 95 % have the true rate within."""
    wins = np.random.default_rng(0).binomial(60, 0.9, size=2000)
    inside = [low <= 0.9 <= high for low, high in (SuccessRate(int(w), 60).interval for w in wins)]
    assert 0.93 < np.mean(inside) < 0.98


@pytest.mark.parametrize(
    ("successes", "of", "word", "settled"),
    [
        # Of n of n the interval is n / (n + z^2) to 1: 80 % from 4 z^2 = 15.4 on, within 7 % from 6.14 z^2 = 23.6.
        (15, 15, "undecided", False), (16, 16, "robust", False), (24, 24, "robust", True),
        # Of 0 of n it is 0 to z^2 / (n + z^2): below 80 % from the first on.
        (0, 0, "undecided", False), (0, 1, "fragile", True),
        # Tight, and its lower end below 80 %; the same rate of fewer is not tight.
        (132, 160, "fragile", True), (33, 40, "undecided", False),
        (144, 160, "robust", True),
    ],
)  # fmt: skip
def test_a_rate_becomes_a_word(successes, of, word, settled):
    rate = SuccessRate(successes, of)
    assert (rate.word, rate.is_decided) == (word, settled)


def test_every_rate_is_settled_at_the_last_look():
    assert all(SuccessRate(k, LOOKS[-1]).is_decided for k in range(LOOKS[-1] + 1))


def test_counting_ends_at_the_look_that_settles_it():
    """However many are known already: the number that counts does not depend on how they came."""
    good, bad = np.ones(600, dtype=bool), np.zeros(600, dtype=bool)
    assert [next_look(good[:k], 512) for k in (0, 10, 16, 31, 32, 600)] == [16, 16, 32, 32, None, None]
    assert [enough(good[:k], 512) for k in (0, 10, 16, 31, 32, 600)] == [0, 10, 16, 31, 32, 32]
    assert (enough(bad, 512), next_look(bad, 512)) == (16, None)
    assert (enough(good, 20), next_look(good[:16], 20), next_look(good[:20], 20)) == (20, 20, None)
