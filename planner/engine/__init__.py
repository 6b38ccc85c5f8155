"""Engine: the memory and the arithmetic of one solve, compiled where dynamics and cost are, in NumPy otherwise."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from planner.cost import TrackingCost
from planner.dynamics import CompiledDynamics
from planner.engine.compiled import CompiledEngine
from planner.engine.in_numpy import NumpyEngine
from planner.engine.protocol import Engine, Outcome
from planner.problem import Problem

__all__ = ["CompiledEngine", "Engine", "NumpyEngine", "Outcome", "borrow", "give_back"]

# Engines that no solve is using, so that a warm solve allocates nothing but its result.
_idle: WeakKeyDictionary[Problem, list[Engine]] = WeakKeyDictionary()


def borrow(problem: Problem) -> Engine:
    """An engine for a problem, for one solve."""
    idle = _idle.setdefault(problem, [])
    try:
        return idle.pop()
    except IndexError:
        pass
    ranges = problem.ranges is None or getattr(problem.dynamics, "has_ranges", True)
    if isinstance(problem.cost, TrackingCost) and isinstance(problem.dynamics, CompiledDynamics) and ranges:
        return CompiledEngine(problem, problem.dynamics, problem.cost)
    return NumpyEngine(problem)


def give_back(problem: Problem, engine: Engine) -> None:
    """Keep an engine for the next solve of the same problem."""
    _idle.setdefault(problem, []).append(engine)
