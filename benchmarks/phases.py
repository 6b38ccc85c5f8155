"""Where the time of one iteration goes, per case: linearization, gradients, Riccati sweep, rollouts, and the whole.

python benchmarks/phases.py [CASE ...]

One thread; minima over repetitions, in microseconds.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import planner
from planner.kernels.lq.quadratic import gradients
from planner.kernels.lq.riccati import riccati_dense, riccati_structured
from planner.solvers.engine import CompiledEngine, acquire_engine

REPEATS = 200


def shortest(call: Callable[[], object]) -> float:
    """Least time of a call, us."""
    best = math.inf
    for _ in range(REPEATS):
        began = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - began)
    return 1e6 * best


def phases(name: str) -> dict[str, float]:
    """Times of the pieces of an iteration from the case's first guess, and of the whole."""
    problem = planner.cases.build(name)
    engine = acquire_engine(problem)
    assert isinstance(engine, CompiledEngine)
    engine.start_from_controls(problem.x0, problem.first_guess)
    engine.sweep(0.0, True)
    w, dynamics, memory = engine._w, engine._dynamics, engine._memory
    sweep = riccati_structured if dynamics.structured else riccati_dense
    return {
        "linearize": shortest(lambda: dynamics.linearize_nominal(w, memory)),
        "gradients": shortest(lambda: gradients(w.table)),
        "riccati": shortest(lambda: sweep(w.table, 0.0, dynamics.dt)),
        "four rollouts": shortest(lambda: dynamics.search(w, memory, 0, True, math.inf, -1.0)),
        "iteration": shortest(lambda: engine.iterate(True, 0, 0.0, True, math.inf, 0.0, -1.0)),
    }


def main() -> None:
    """One line per case."""
    for name in sys.argv[1:] or planner.cases.CASES:
        print(f"{name:10s}", "  ".join(f"{phase} {time_:.1f}" for phase, time_ in phases(name).items()))


if __name__ == "__main__":
    main()
