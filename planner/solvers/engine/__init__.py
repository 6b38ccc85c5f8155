"""Engine: the memory and the arithmetic of one solve, compiled where dynamics and cost are, in NumPy otherwise."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from planner.dynamics import CompiledDynamics, PenalisedDynamics
from planner.problem.costs.penalty import PenaltyCost
from planner.problem.costs.tracking import SumCost, TrackingCost
from planner.problem.problem import Problem
from planner.solvers.engine.compiled import CompiledEngine
from planner.solvers.engine.in_numpy import NumpyEngine
from planner.solvers.engine.protocol import Engine, Outcome

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
    costs = compiled_costs(problem)
    if costs is not None and isinstance(problem.dynamics, CompiledDynamics) and ranges:
        return CompiledEngine(problem, problem.dynamics, *costs)
    return NumpyEngine(problem)


def compiled_costs(problem: Problem) -> tuple[TrackingCost, tuple[PenaltyCost, ...]] | None:
    """The one TrackingCost and the PenaltyCosts that a cost is the sum of, if it is and kernels have them all."""
    terms = problem.cost.costs if isinstance(problem.cost, SumCost) else (problem.cost,)
    tracking = [term for term in terms if isinstance(term, TrackingCost)]
    penalties = tuple(term for term in terms if isinstance(term, PenaltyCost))
    if len(tracking) != 1 or len(terms) != 1 + len(penalties):
        return None
    dynamics = problem.dynamics
    if not penalties:
        return tracking[0], ()
    if isinstance(dynamics, PenalisedDynamics) and all(term.mechanism is dynamics.mechanism for term in penalties):
        return tracking[0], penalties
    return None


def give_back(problem: Problem, engine: Engine) -> None:
    """Keep an engine for the next solve of the same problem."""
    _idle.setdefault(problem, []).append(engine)
