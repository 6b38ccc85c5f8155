"""How far the joints of benchmarks/robots.py are to go, and to which side."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SHARE = {  # of a range, by the size of the goals
    "small": {"arm": 0.15, "hand": 0.15, "legged": 0.03},
    "moderate": {"arm": 0.4, "hand": 0.4, "legged": 0.08},
    "large": {"arm": 0.6, "hand": 0.6, "legged": 0.15},
}
MODERATE = 0.5  # rad or m, at most
INSIDE = 0.02  # of a range, that a goal stays away from its ends
REDRAWN = 1.0 / 3.0  # of the machines, with a seed
UNLIMITED = 0.5  # rad or m


class Goals(NamedTuple):
    """How far joints are to go."""

    size: str = "small"  # one of SHARE
    rng: np.random.Generator | None = None  # draws each way between that far to one side and to the other

    @classmethod
    def of(cls, size: str, seed: int | None, name: str) -> Goals:
        """Those of a machine: with a seed, a third of all names are drawn."""
        rng = None if seed is None else np.random.default_rng([seed, *name.encode()])
        return cls(size, rng if rng is not None and rng.random() < REDRAWN else None)

    def way(self, value: float, limits: np.ndarray | None, kind: str) -> float:
        """How far a joint is to move from a value."""
        if kind == "underactuated" or limits is None:
            far = UNLIMITED
        else:
            most = MODERATE if self.size == "moderate" else np.inf
            far = min(SHARE[self.size][kind] * np.ptp(limits), most)
        to_other_side = limits is not None and value - limits[0] > limits[1] - value
        far = far * (-1.0 if to_other_side else 1.0)
        if self.rng is not None:
            far *= self.rng.uniform(-1.0, 1.0)
        if limits is None or self == Goals():
            return float(far)
        inner = limits + INSIDE * np.ptp(limits) * np.array([1.0, -1.0])
        return float(np.clip(value + far, min(inner[0], value), max(inner[1], value)) - value)
