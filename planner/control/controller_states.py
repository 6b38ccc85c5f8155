"""The states of a controller, what may go wrong with it, and its events.

    TRACKING  a plan was made in time from the last measurement
    LATE      no such plan: the solve failed, took too long, or the measurement was unusable; the plan before goes on
    HOLDING   no plan: gravity compensation and damping; solves continue, and the first success leads back to TRACKING
    STOPPED   as HOLDING, without solves, until reset()

The control is finite and within the bounds in each of them. Every transition is an Event.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, NamedTuple

PATIENCE = 10  # failed solves, or unusable measurements, in a row before it holds; plans in time before it is in time
BLIND = 10  # times `patience` of unusable measurements in a row before it stops
_MAX_EVENTS = 1000
_GOES_ON = "the plan before goes on"


class ControllerStatus(StrEnum):
    """State of a controller; its value is a sentence."""

    TRACKING = "It follows a plan that was made in time."
    LATE = "No plan came in time; it follows the plan before."
    HOLDING = "It holds the machine by gravity compensation and damping until a solve succeeds."
    STOPPED = "It holds the machine by gravity compensation and damping until it is reset."


class Fault(StrEnum):
    """What prevents a plan; its value says so in words."""

    # of a solve
    NOT_FINITE_START = "the measured state is not finite"
    RUNS_AWAY = "the plan before, followed from here, runs away"
    INDEFINITE = "the sweep is not definite"
    GAINS = "the gains are not finite"
    NOT_FINITE = "the plan is not finite"
    BUDGET = "no iteration fits in the budget"
    # of a measurement
    LENGTH = "the measured state is no array of numbers of its length"
    STATE = "the measured state is not finite"
    SIZE = "the measured state is far beyond the plan and the goal"
    CLOCK = "the time is not finite"
    CLOCK_BACK = "the clock went back"
    # of a goal
    GOAL_SIZE = "the goal is beyond all that can be computed"
    GOAL_REACH = "the goal is out of reach"
    GOAL_RANGE = "the goal is beyond the range of a joint"
    GOAL_COLLIDES = "at the goal shapes are closer than they may be"


class EventCode(StrEnum):
    """Kind of an event."""

    SOLVE_FAILED = "solve failed"
    OVERRUN = "overrun"
    UNUSABLE = "unusable measurement"
    GAP = "gap"
    GOAL = "goal refused"
    RECOVERED = "recovered"
    HOLDS = "holds"
    STOPS = "stops"


class Event(NamedTuple):
    """A message of a controller, in words and as data."""

    t: float  # s, time of the task; the last one where the clock has none
    words: str
    code: EventCode
    status: ControllerStatus  # after it
    values: dict[str, Any]  # numbers and the name of a Fault

    def __str__(self) -> str:
        return f"t = {self.t:.4g} s: {self.words}"

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {"t": self.t, "code": self.code.name, "status": self.status.name, "words": self.words, **self.values}


class StateMachine:
    """The status of a controller, its counts and its events; a Controller is one.

    Args:
        patience: Failed solves, or unusable measurements, in a row before it holds; plans in time before it recovers.
        most: s of wall time that a plan may take.
        how: How it holds the machine, in words.
    """

    def __init__(self, patience: int, most: float, how: str) -> None:
        self.patience, self._most, self._how = patience, most, how
        self.restart()

    def restart(self) -> None:
        """Track, without events and counts."""
        self.status, self.events = ControllerStatus.TRACKING, list[Event]()
        self.failures = self.faults = self.plans = self.overruns = 0
        self._failed_in_a_row = self._blind = self._in_time = 0
        self._slow, self._now = False, 0.0  # s, of the last measurement

    def ended(self, t: float, fault: Fault | None, seconds: float, iteration_seconds: float) -> bool:
        """A solve for time t ended after `seconds` of wall time, an iteration taking so many; whether it succeeded."""
        in_time = not self._overran(t, seconds)
        if fault is not None:
            self.failures, self._failed_in_a_row = self.failures + 1, self._failed_in_a_row + 1
            if self._failed_in_a_row == 1:
                values = {"fault": fault.name, "seconds": seconds, "iteration_seconds": iteration_seconds}
                words = f"a solve failed, {fault}"
                if fault is Fault.BUDGET:
                    words += f", an iteration takes {1e3 * iteration_seconds:.3g} ms"
                self._late(t, EventCode.SOLVE_FAILED, f"{words}; {_GOES_ON}", values)
            if self._failed_in_a_row == self.patience:
                self.hold(t, f"{self.patience} solves failed in a row")
            return False
        self.plans += 1
        failed, self._failed_in_a_row = self._failed_in_a_row, 0
        slow, self._slow = self._slow, self._slow and self._in_time < self.patience
        self.status = ControllerStatus.LATE if self._slow else ControllerStatus.TRACKING
        if failed:
            words = f"a solve succeeded after {failed} that failed."
            self._say(t, EventCode.RECOVERED, words, {"failed": failed})
        if in_time and slow and not self._slow:
            words = f"plans are in time again; {self.overruns} of {self.plans + self.failures} were not."
            self._say(t, EventCode.RECOVERED, words, {"overruns": self.overruns})
        return True

    def _overran(self, t: float, seconds: float) -> bool:
        """Whether a plan that took `seconds` of wall time is late."""
        if seconds <= self._most:
            self._in_time += 1
            return False
        self.overruns, self._in_time = self.overruns + 1, 0
        if not self._slow:
            words = f"plans are late, one took {1e3 * seconds:.3g} ms of wall time, beyond {1e3 * self._most:.3g} ms"
            self._late(t, EventCode.OVERRUN, words, {"seconds": seconds, "most": self._most})
        self._slow = True
        return True

    def unusable(self, t: float, fault: Fault) -> None:
        """A measurement at t cannot be used."""
        self.faults, self._blind, self._now = self.faults + 1, self._blind + 1, t
        if self._blind == 1:
            self._late(t, EventCode.UNUSABLE, f"{fault}; {_GOES_ON}", {"fault": fault.name})
        if self._blind == self.patience:
            self.hold(t, f"{self._blind} measurements in a row were unusable")
        if self._blind == BLIND * self.patience:
            self._stop(t, f"{self._blind} measurements in a row were unusable")

    def usable(self, t: float, period: float) -> None:
        """A measurement at t can be used; `period` s is the time from one plan to the next."""
        if self._blind:
            words = f"measurements are usable again after {self._blind} that were not."
            self._say(t, EventCode.RECOVERED, words, {"unusable": self._blind})
        missed, self._blind = t - self._now, 0
        if missed > self.patience * period:
            self._say(t, EventCode.GAP, f"nothing was measured for {missed:.3g} s.", {"seconds": missed})
        self._now = t

    def refused(self, t: float, fault: Fault) -> None:
        """A goal cannot be met: hold the machine until another one is set."""
        if self.status is not ControllerStatus.STOPPED:
            self.status = ControllerStatus.HOLDING
        words = f"{fault}; it holds the machine {self._how} until another is set."
        self._say(t, EventCode.GOAL, words, {"fault": fault.name})

    def hold(self, t: float, why: str) -> None:
        """Hold the machine, unless it does."""
        if self.status in (ControllerStatus.TRACKING, ControllerStatus.LATE):
            self.status = ControllerStatus.HOLDING
            self._say(t, EventCode.HOLDS, f"{why}; it holds the machine {self._how}.", {})

    def stop(self) -> None:
        """Hold the machine, without plans, until reset()."""
        self._stop(self._now, "it was told to stop")

    def _stop(self, t: float, why: str) -> None:
        if self.status is not ControllerStatus.STOPPED:
            self.status = ControllerStatus.STOPPED
            self._say(t, EventCode.STOPS, f"{why}; it holds the machine {self._how} until it is reset.", {})

    def _late(self, t: float, code: EventCode, words: str, values: dict[str, Any]) -> None:
        if self.status is ControllerStatus.TRACKING:
            self.status = ControllerStatus.LATE
        self._say(t, code, f"{words}.", values)

    def _say(self, t: float, code: EventCode, words: str, values: dict[str, Any]) -> None:
        if len(self.events) < _MAX_EVENTS:
            self.events.append(Event(t, words, code, self.status, values))
