"""Engine: the memory and the arithmetic of one solve, compiled where dynamics and cost are, in NumPy otherwise.

`borrow` chooses the engine of a solve. It keeps no problem alive: an engine holds its parts, never the Problem.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

from planner.dynamics import CompiledDynamics, ResidualDynamics
from planner.kernels.lq import line_search
from planner.model.space import space_of
from planner.problem.costs.residuals.arrays import ResidualArrays, joined
from planner.problem.costs.residuals.cost import ResidualCost
from planner.problem.costs.terms import Cost, SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.solvers.engine.compiled import CompiledEngine, NoTracking
from planner.solvers.engine.constrained_engine import ConstrainedEngine
from planner.solvers.engine.hybrid_engine import HybridEngine
from planner.solvers.engine.in_numpy import NumpyEngine
from planner.solvers.engine.protocol import DefectStep, Engine, IterationResult

__all__ = [
    "CompiledEngine",
    "ConstrainedEngine",
    "DefectStep",
    "Engine",
    "HybridEngine",
    "IterationResult",
    "NumpyEngine",
    "acquire_engine",
    "release_engine",
]

# Engines that no solve is using, so that a warm solve allocates nothing but its result. They must not refer to their
# problem, or no problem would ever be freed.
_idle: WeakKeyDictionary[Problem, dict[bool, list[Engine]]] = WeakKeyDictionary()


def acquire_engine(problem: Problem, rule: int = line_search.ARMIJO) -> Engine:
    """An engine for one solve of a problem: compiled if kernels have all of it and of the line line_search."""
    try:
        return _idle_of(problem, rule).pop()
    except IndexError:
        pass
    dynamics, (known, own) = problem.dynamics, _split(problem)
    costs = _compiled(problem, known)
    if costs is not None and isinstance(dynamics, CompiledDynamics) and _has(dynamics, problem, rule, bool(own)):
        kept = problem.trajectory_constraints
        if kept is None or kept.rows is None:
            return HybridEngine(problem, dynamics, *costs, own) if own else CompiledEngine(problem, dynamics, *costs)
        if hasattr(dynamics, "nominal_jacobians"):
            return ConstrainedEngine(problem, kept, dynamics, *costs, own)
    return NumpyEngine(problem)


def _idle_of(problem: Problem, rule: int) -> list[Engine]:
    """Idle engines of a problem for a line search: those for the Wolfe rule may be others."""
    return _idle.setdefault(problem, {}).setdefault(rule == line_search.WOLFE, [])


def _has(dynamics: CompiledDynamics, problem: Problem, rule: int, own: bool) -> bool:
    """Whether the rollouts of compiled dynamics give what ranges, own costs and the line search need."""
    if problem.ranges is not None and not getattr(dynamics, "has_ranges", True):
        return False
    if own and (rule == line_search.WOLFE or not hasattr(dynamics, "take")):  # own costs have no slope at a candidate
        return False
    # A clipped control does not change with the step length, which the slopes of the kernels do not know.
    return rule != line_search.WOLFE or (dynamics.has_slopes and problem.bounds is None)


def compiled_costs(problem: Problem) -> tuple[TrackingCost | NoTracking, ResidualArrays | None] | None:
    """The TrackingCost and the residuals that a cost is the sum of, if it is and kernels have them all."""
    known, own = _split(problem)
    return None if own else _compiled(problem, known)


def _split(problem: Problem) -> tuple[list[Cost], list[Cost]]:
    """The terms of a cost of kinds that kernels may know, and others: a user's own."""
    terms = problem.cost.costs if isinstance(problem.cost, SumCost) else (problem.cost,)
    known: list[Cost] = [term for term in terms if isinstance(term, (TrackingCost, ResidualCost))]
    return known, [term for term in terms if not isinstance(term, (TrackingCost, ResidualCost))]


def _compiled(problem: Problem, terms: list[Cost]) -> tuple[TrackingCost | NoTracking, ResidualArrays | None] | None:
    """The TrackingCost and the residuals that terms are; None where there are none or kernels lack one."""
    tracking = [term for term in terms if isinstance(term, TrackingCost)]
    residuals = [term for term in terms if isinstance(term, ResidualCost)]
    dynamics = problem.dynamics
    if not terms or len(tracking) > 1:
        return None
    if not residuals:
        return tracking[0], None
    if isinstance(dynamics, ResidualDynamics) and all(term.mechanism is dynamics.mechanism for term in residuals):
        quadratic = tracking[0] if tracking else NoTracking(problem.N, space_of(dynamics), problem.dynamics.nu)
        return quadratic, joined([term.residual_arrays_for(problem.N) for term in residuals])
    return None


def release_engine(problem: Problem, engine: Engine, rule: int = line_search.ARMIJO) -> None:
    """Keep an engine for the next solve of the same problem with the same line line_search."""
    _idle_of(problem, rule).append(engine)
