"""Rates of success and their confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

_Z = 1.959963984540054  # standard deviations: 95 % of a normal distribution lie within


@dataclass(frozen=True)
class Rate:
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

    def to_dict(self) -> dict[str, float | int]:
        """As JSON values."""
        low, high = self.interval
        return {"successes": self.successes, "of": self.of, "low": low, "high": high}

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes} of {self.of}, 95 % interval {100.0 * low:.1f} to {100.0 * high:.1f} %"
