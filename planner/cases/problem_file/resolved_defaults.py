"""What a problem file left to be chosen: for each, the values and the reason."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.cases.problem_file.keys import RESOLVED


def resolved_defaults(parameters: Mapping[str, Any]) -> dict[str, str]:
    """A sentence for each thing that was chosen by itself, by its key; none for plans without a problem file."""
    resolved = parameters.get(RESOLVED, {})
    weights, reasons = resolved.get("weights", {}), resolved.get("reasons", {})
    return {
        f"weights.{name}" if name in weights else name: f"{_values(weights.get(name))}{reason}"
        for name, reason in reasons.items()
    }


def _values(weight: Any) -> str:
    """The range of the numbers of a weight, and ": "."""
    numbers = np.atleast_1d(np.asarray(weight, dtype=float)) if isinstance(weight, (list, float, int)) else np.empty(0)
    if not numbers.size or not np.any(numbers):
        return ""
    low, high = numbers.min(), numbers.max()
    return f"{low:.3g}: " if low == high else f"{low:.3g} to {high:.3g}: "
