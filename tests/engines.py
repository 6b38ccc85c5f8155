"""Two engines on one problem: the compiled one beside the one in NumPy, iteration by iteration."""

import pytest
from trees import relative_error

from planner.kernels.lq import line_search
from planner.kernels.lq.workspace import INDEFINITE
from planner.solvers.engine import CompiledEngine, NumpyEngine, acquire_engine


def both_engines(problem, kind=CompiledEngine):
    """The engine that a solve takes, which is of this kind, and NumPy's."""
    ours = acquire_engine(problem)
    assert type(ours) is kind
    return ours, NumpyEngine(problem)


def begun(engines, problem, us=None, penalties=None, exact=False):
    """The costs of both at the same controls, by default the first guess."""
    costs = []
    for engine in engines:
        if penalties is not None:
            engine.set_penalties(penalties)
        costs.append(engine.start_from_controls(problem.x0, problem.first_guess if us is None else us, exact))
    assert costs[0] == pytest.approx(costs[1], rel=1e-10)
    return costs


def assert_same_iterations(
    engines, problem, updates, *, us=None, penalties=None, exact=False, rule=line_search.ARMIJO, mus=(), within=1e-8
):
    """Iterations by both, with feedback or without in turn and each with its regularization `mus`, 0 by default.

    The sweep's numbers and the trajectories agree `within` their size, which sums by another order leave, the costs to
    a tenth of that. Gradients are small differences of large terms near a minimum: they are compared beside what they
    were at first. At the minimum itself rounding decides, and the comparison ends. Returns the step lengths.
    """
    ours, twin = engines
    costs, first, steps = begun(engines, problem, us, penalties, exact), None, []
    assert ours.largest_control_weight == pytest.approx(twin.largest_control_weight)
    for feedback, mu in zip(updates, mus or [0.0] * len(updates), strict=True):
        fresh = True
        while True:  # as a solve does where R + B'PB is not definite
            a, b = (
                engine.iterate(feedback, rule, mu, fresh, cost, 0.0, -1.0)
                for engine, cost in zip(engines, costs, strict=True)
            )
            assert (a.kind == INDEFINITE) == (b.kind == INDEFINITE)
            if a.kind != INDEFINITE:
                break
            mu, fresh = max(1.0, 10.0 * mu), False
        if first is None:
            first = b
            assert relative_error(ours.gradient(), twin.gradient()) < within
        assert a.gradient_norm == pytest.approx(b.gradient_norm, rel=within, abs=within * first.gradient_norm)
        assert a.slope == pytest.approx(b.slope, rel=10.0 * within, abs=1e-3 * within * abs(first.slope))
        assert relative_error(ours.gains(), twin.gains()) < within
        if abs(b.slope) < 1e-9 * abs(b.cost):
            break
        assert (a.kind, a.step) == (b.kind, b.step)
        assert a.expected == pytest.approx(b.expected, rel=10.0 * within)
        assert a.cost == pytest.approx(b.cost, rel=0.1 * within)
        for mine, other in zip(ours.trajectory(), twin.trajectory(), strict=True):
            assert relative_error(mine, other) < within
        costs = [a.cost, b.cost]
        steps.append(a.step)
    return steps
