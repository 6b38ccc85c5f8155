"""Rates of success, their confidence intervals, and the word that follows from them: how robust a plan is.

Rollouts are counted at fixed numbers of them (LOOKS), so that their number depends on no computer and no batch. They
end when the interval is tight, or all of it is below what is asked.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

ROBUST = 0.8  # the lower end of the interval that makes a plan robust
TIGHT = 0.07  # half the width of an interval that is tight enough
# Numbers of rollouts after which the rate is looked at: 16 is the first of which all is robust, at 160 every rate is
# settled.
LOOKS = (16, 32, 64, 96, 128, 160)
_Z = 1.959963984540054  # standard deviations: 95 % of a normal distribution lie within


@dataclass(frozen=True)
class SuccessRate:
    """Successes among rollouts."""

    successes: int  # How many there were
    of: int  # How many could have been

    @property
    def value(self) -> float:
        """The rate, 0 to 1; NaN of nothing."""
        return self.successes / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the true rate, from 0 to 1 (Wilson 1927)."""
        if self.of == 0:
            return 0.0, 1.0
        p, n, z2 = self.value, self.of, _Z**2
        middle = (p + z2 / (2.0 * n)) / (1.0 + z2 / n)
        half = _Z / (1.0 + z2 / n) * math.sqrt(p * (1.0 - p) / n + z2 / (4.0 * n * n))
        # At the ends the formula is exact, its rounding is not.
        low = 0.0 if self.successes == 0 else middle - half
        return low, 1.0 if self.successes == n else middle + half

    @property
    def is_decided(self) -> bool:
        """Whether more rollouts are of no use: the interval is tight, or all of it is below ROBUST."""
        low, high = self.interval
        return 0.5 * (high - low) <= TIGHT or high < ROBUST

    @property
    def word(self) -> str:
        """The word "robust" for a lower end of at least ROBUST; else "fragile" where settled; else "counting"."""
        if self.interval[0] >= ROBUST:
            return "robust"
        return "fragile" if self.is_decided else "counting"

    def to_dict(self) -> dict[str, float | int]:
        """As JSON values."""
        low, high = self.interval
        return {"successes": self.successes, "of": self.of, "low": low, "high": high}

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes} of {self.of}, 95 % interval {100.0 * low:.1f} to {100.0 * high:.1f} %"


def next_look(won: np.ndarray, most: int) -> int | None:
    """The number of rollouts to be had next, of successes (K,) so far; None where they are settled, or `most`."""
    return next((look for look, settled in _looks(won, most) if not settled), None)


def enough(won: np.ndarray, most: int) -> int:
    """How many of successes (K,) count: up to the look that settled them, at most `most`."""
    return next((look for look, settled in _looks(won, most) if settled), min(len(won), most))


def _looks(won: np.ndarray, most: int) -> Iterator[tuple[int, bool]]:
    """Each look up to the first that is settled or not there yet, and whether it is settled."""
    for look in (*(look for look in LOOKS if look < most), most):
        settled = len(won) >= look and SuccessRate(int(won[:look].sum()), look).is_decided
        if settled or len(won) < look:
            yield look, settled
            return
