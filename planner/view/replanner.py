"""Plan again for goals that change meanwhile: the newest from the plan before, then its proof if there is time."""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.problem.plan import Plan
from planner.proof import Proof, prove
from planner.solvers.slq import solve


class Outcome(NamedTuple):
    """What there is to show."""

    plan: Plan
    proof: Proof | None = None
    seconds: float = 0.0  # that building its problem and solving it took
    refusal: str = ""  # why there is no plan for the newest goals

    def __str__(self) -> str:
        if self.refusal:
            return self.refusal
        took = f" Planned in {1e3 * self.seconds:.0f} ms." if self.seconds else ""
        told = f"{self.plan.status.name}, not proved yet." if self.proof is None else f"**{self.proof.headline}**."
        return told + took


class Replanner:
    """Plans for the newest goals from the plan before, and proves that plan if no newer ones were given meanwhile.

    Attributes:
        goals: What can be changed, by name: positions (3,) of frames, m, or values of joints, rad or m.
        shown: The newest result.
    """

    def __init__(self, plan: Plan) -> None:
        """Take a plan; of one whose recipe has no goal nothing can be changed."""
        self.shown, self._plan, self._ended = Outcome(plan), plan, False
        self._goal = plan.parameters.get("goal")
        self._paths = _paths(self._goal)
        self.goals: dict[str, Any] = {name: _at(self._goal, path) for name, path in self._paths.items()}
        self._changed = threading.Event()
        self._changed.set()  # the first plan is to be proved

    def move(self, name: str, value: Any) -> None:
        """Ask for another value of a goal; takes no time."""
        self.goals[name] = value
        self._changed.set()

    def work(self) -> None:
        """Plan and prove until end() is called."""
        while self._changed.wait() and not self._ended:
            self._changed.clear()
            try:
                self._step()
            except PlannerError as error:  # out of reach, say
                self.shown = self.shown._replace(refusal=str(error))

    def end(self) -> None:
        """Let work() return."""
        self._ended = True
        self._changed.set()

    def _step(self) -> None:
        began, goal = time.monotonic(), self._asked()
        self.shown = self.shown._replace(refusal="")
        if goal != self._plan.parameters.get("goal"):
            assert self._plan.recipe is not None
            self._plan = solve(self._plan.recipe.rebuilt(goal=goal), warm_start=self._plan)
            self.shown = Outcome(self._plan, seconds=time.monotonic() - began)
        if not self._changed.is_set() and self.shown.proof is None and np.isfinite(self._plan.xs).all():
            self.shown = self.shown._replace(proof=prove(self._plan, rollouts=0))

    def _asked(self) -> Any:
        """The recipe's `goal` with the values as they are now."""
        goal = copy.deepcopy(self._goal)
        for name, (*path, last) in self._paths.items():
            _at(goal, path)[last] = self.goals[name]
        return goal


def _paths(goal: Any) -> dict[str, tuple[Any, ...]]:
    """Where the places and joints of a `goal` are in it, by name: a table of joints, or a list of [[goal]]."""
    if isinstance(goal, dict):
        return {joint: (joint,) for joint, value in goal.items() if isinstance(value, (int, float))}
    found = {}
    for i, one in enumerate(goal if isinstance(goal, list) else ()):
        if isinstance(one, dict) and "position" in one:
            found[f"goal {i + 1}: {one['frame']}"] = (i, "position")
        elif isinstance(one, dict) and isinstance(one.get("joints"), dict):
            inner = _paths(one["joints"])
            found |= {f"goal {i + 1}: {joint}": (i, "joints", *path) for joint, path in inner.items()}
    return found


def _at(goal: Any, path: Sequence[Any]) -> Any:
    for key in path:
        goal = goal[key]
    return goal
