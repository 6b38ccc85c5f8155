"""Same input, same plan, bit for bit; and nothing is allocated inside iterations."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from numba.core.runtime import _nrt_python, rtsys
from places import ROOT
from solves import (
    each_engine,
    engines,
    fingerprint,
    hopper,
    same_bits,
    stop_at,
)

import planner
from planner.kernels.lq.workspace import ACCEPTED
from planner.solvers.engine import acquire_engine
from planner.solvers.options import LINE_SEARCHES, UPDATES

FRESH = """
import hashlib, sys
sys.path.insert(0, {folder!r})
import solves
print(solves.fingerprint())
"""


def test_the_same_bits_again_and_in_another_process():
    ours = fingerprint()
    assert fingerprint() == ours
    program = FRESH.format(folder=str(ROOT / "tests"))
    fresh = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert fresh.stdout.strip() == ours


@each_engine
def test_a_used_engine_gives_the_same_bits(engine):
    """Solves of one problem share memory one after another; other updates and endings in between leave no trace."""
    problem = engines()[engine]
    first = planner.solve(problem)
    planner.solve(problem, update="open-loop", line_search="wolfe")
    planner.solve(problem, line_search="exact", max_iterations=2)
    planner.solve(problem, callback=stop_at(3, KeyboardInterrupt))
    same_bits(planner.solve(problem), first)


@each_engine
def test_threads_give_the_same_bits(engine):
    problem = engines()[engine]
    alone = {update: planner.solve(problem, update=update) for update in UPDATES}
    with ThreadPoolExecutor(4) as pool:
        jobs = [(update, pool.submit(planner.solve, problem, update=update)) for update in UPDATES * 4]
        for update, job in jobs:
            same_bits(job.result(), alone[update])


def test_a_solve_inside_a_solve():
    """A callback may solve the very problem that is being solved."""
    problem = hopper()
    alone, inner = planner.solve(problem), []
    outer = planner.solve(problem, callback=lambda line: inner.append(planner.solve(problem)))
    same_bits(outer, alone)
    for plan in inner:
        same_bits(plan, alone)


@pytest.fixture
def statistics():
    """Numba counts what compiled code allocates."""
    enabled = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    yield rtsys.get_allocation_stats
    if not enabled:
        _nrt_python.memsys_disable_stats()


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("line_search", LINE_SEARCHES)
def test_compiled_iterations_allocate_nothing(statistics, update, line_search):
    """Whatever N and however many batches; arrays that enter get no handles, as kernels count no references."""
    for N in (10, 300):
        problem = planner.cases.hopper(horizon=N)
        engine, rule = acquire_engine(problem), LINE_SEARCHES.index(line_search)
        cost = engine.start_from_controls(problem.x0, problem.first_guess)
        for _ in range(4):
            before = statistics()
            done = engine.iterate(update == "feedback", rule, 0.0, True, cost, 0.0, 0.0)
            after = statistics()
            assert done.kind == ACCEPTED
            cost = done.cost
            assert after.mi_alloc - before.mi_alloc == 0
            assert after.alloc - before.alloc == after.free - before.free == 0
