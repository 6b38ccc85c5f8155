"""Engine: memory and arithmetic of one solve; compiled if dynamics and cost are compiled, else in NumPy.

acquire_engine chooses the engine of a solve. An engine refers to parts of its Problem, never to the Problem itself.
"""

from __future__ import annotations

from dataclasses import fields
from weakref import WeakKeyDictionary

from planner.dynamics import CompiledDynamics, ResidualDynamics
from planner.kernels.lq import line_search
from planner.model.mechanism import Mechanism
from planner.model.space import space_of
from planner.problem.costs.least_squares import ResidualCost
from planner.problem.costs.motors import EnergyCost
from planner.problem.costs.residual_arrays import ResidualArrays, joined
from planner.problem.costs.terms import Cost, SumCost
from planner.problem.costs.tracking import NoTracking, TrackingCost
from planner.problem.problem import Problem
from planner.solvers.engine.compiled import CompiledEngine
from planner.solvers.engine.hybrid_engine import ConstrainedEngine, HybridEngine
from planner.solvers.engine.in_numpy import NumpyEngine
from planner.solvers.engine.protocol import DefectStep, Direction, Engine, IterationResult

__all__ = [
    "CompiledEngine",
    "ConstrainedEngine",
    "DefectStep",
    "Direction",
    "Engine",
    "HybridEngine",
    "IterationResult",
    "NumpyEngine",
    "acquire_engine",
    "is_in_numpy",
    "release_engine",
]

# Idle engines: a repeated solve allocates only its result. They must not refer to their problem, which could then not
# be freed.
_WITHOUT_RESIDUALS = {"contacts", "body_contacts", "friction_loss", "friction_inertia", "friction_rate"}
_KNOWN = (TrackingCost, ResidualCost, EnergyCost)
_idle: WeakKeyDictionary[Problem, dict[bool, list[Engine]]] = WeakKeyDictionary()


def acquire_engine(problem: Problem, rule: int = line_search.ARMIJO) -> Engine:
    """An engine for one solve of a problem: compiled if kernels support its dynamics, costs and line search.

    A reused engine is reset, so that a plan depends only on its problem.
    """
    try:
        engine = _idle_of(problem, rule).pop()
    except IndexError:
        return _new_engine(problem, rule)
    engine.reset()
    return engine


def _new_engine(problem: Problem, rule: int) -> Engine:
    dynamics, (known, own) = problem.dynamics, _split(problem)
    costs = _compiled(problem, known)
    if costs is not None and isinstance(dynamics, CompiledDynamics) and _has(dynamics, problem, rule, bool(own)):
        constraints = problem.trajectory_constraints
        if constraints is None or constraints.rows is None:
            return HybridEngine(problem, dynamics, *costs, own) if own else CompiledEngine(problem, dynamics, *costs)
        if hasattr(dynamics, "nominal_jacobians"):
            return ConstrainedEngine(problem, constraints, dynamics, *costs, own)
    return NumpyEngine(problem)


def is_in_numpy(problem: Problem, rule: int) -> bool:
    """Whether compiled dynamics have no kernels for a line search, so that NumPy solves the problem."""
    return isinstance(problem.dynamics, CompiledDynamics) and not _has(problem.dynamics, problem, rule, False)


def _idle_of(problem: Problem, rule: int) -> list[Engine]:
    """Idle engines of a problem for a line search: the Wolfe rule may need an engine of another class."""
    return _idle.setdefault(problem, {}).setdefault(rule == line_search.WOLFE, [])


def _has(dynamics: CompiledDynamics, problem: Problem, rule: int, own: bool) -> bool:
    """Whether compiled dynamics support the problem's state bounds, user-defined costs (`own`) and line search."""
    if problem.ranges is not None and not getattr(dynamics, "has_ranges", True):
        return False
    if own and (rule == line_search.WOLFE or not hasattr(dynamics, "take")):  # such costs have no slope at a candidate
        return False
    # The kernels' slopes ignore that a clipped control does not change with the step length.
    return rule != line_search.WOLFE or (dynamics.has_slopes and problem.bounds is None)


def _split(problem: Problem) -> tuple[list[Cost], list[Cost]]:
    """The terms of a cost that kernels may support, and the user-defined others."""
    terms = problem.cost.costs if isinstance(problem.cost, SumCost) else (problem.cost,)
    known: list[Cost] = [term for term in terms if isinstance(term, _KNOWN)]
    return known, [term for term in terms if not isinstance(term, _KNOWN)]


def _compiled(problem: Problem, terms: list[Cost]) -> tuple[TrackingCost | NoTracking, ResidualArrays | None] | None:
    """The TrackingCost and the residuals of some terms; None without terms or without kernels for one."""
    tracking = [term for term in terms if isinstance(term, TrackingCost)]
    residuals = [term for term in terms if isinstance(term, (ResidualCost, EnergyCost))]
    dynamics = problem.dynamics
    if not terms or len(tracking) > 1:
        return None
    if not residuals:
        return tracking[0], None
    if not isinstance(dynamics, ResidualDynamics):
        return None
    if not all(_moves_alike(term.mechanism, dynamics.mechanism) for term in residuals):
        return None
    quadratic = tracking[0] if tracking else NoTracking(problem.N, space_of(dynamics), problem.dynamics.nu)
    return quadratic, joined([term.residual_arrays_for(problem.N) for term in residuals])


def _moves_alike(one: Mechanism, other: Mechanism) -> bool:
    """Whether two mechanisms have the same parts but for contacts and friction, which no residual depends on."""
    parts = {part.name for part in fields(one)} - _WITHOUT_RESIDUALS
    return all(getattr(one, part) is getattr(other, part) for part in parts)


def release_engine(problem: Problem, engine: Engine, rule: int = line_search.ARMIJO) -> None:
    """Store an engine for the next solve of the same problem with the same line search."""
    _idle_of(problem, rule).append(engine)
