"""What a controller says: what it is doing, and what happened on the way."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class ControllerStatus(StrEnum):
    """What a controller is doing, in a sentence."""

    PLANNING = "It follows the plan that it has just made."
    LAST_PLAN = "The last solve failed; it goes on with the plan before."
    HOLDING = "It holds the machine where it is, by gravity compensation and damping, until a solve succeeds."


class Event(NamedTuple):
    """Something that a controller has to say."""

    t: float  # s
    words: str

    def __str__(self) -> str:
        return f"t = {self.t:.4g} s: {self.words}"
