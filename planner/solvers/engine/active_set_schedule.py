"""When an engine looks for the set of controls at their bounds: seldom where the search has cycled."""

from __future__ import annotations

MAX_SETS = 20  # sweeps of one iteration; a set that settles does so in less than ten, or nearly always never
LONGEST = 16  # iterations that are left out


class ActiveSetSchedule:
    """Iterations that are left out after sets that did not settle, twice as many each time."""

    def __init__(self) -> None:
        self._left, self._next = 0, 1

    def due(self) -> bool:
        """Whether to look for it in this iteration."""
        self._left -= 1
        return self._left < 0

    def record_convergence(self) -> None:
        """It settled."""
        self._next = 1

    def record_cycle(self) -> None:
        """It did not."""
        self._left, self._next = self._next, min(2 * self._next, LONGEST)
