"""The command `warmup`: compile the numerical core."""

from __future__ import annotations

import argparse
import time

from planner import cases
from planner.cli.console import Console
from planner.kernels.numba.jit import is_warm
from planner.kernels.precompile import KERNELS, SECOND_ORDER, compile_together
from planner.proof.compare.model_parity import parity
from planner.solvers.slq import solve


def warmup(arguments: argparse.Namespace, console: Console) -> int:
    """Compile the numerical core once; print the time only where something was compiled."""
    names = [name for name in KERNELS if arguments.all or name not in SECOND_ORDER]
    cold = not all(is_warm(*KERNELS[name]) for name in names)
    began = time.perf_counter()
    compile_together(names)
    for problem in (cases.hopper(horizon=8, duration=0.04), cases.acrobot(horizon=8, duration=0.04)):
        plan = solve(problem, max_iterations=2)
        problem.dynamics.step(plan.xs[:1], plan.us[:1])
        problem.dynamics.linearize(plan.xs, plan.us)
        parity(problem)  # rates, or every term of the mechanics
    seconds = time.perf_counter() - began
    if cold:
        console.write_result(f"compiled in {seconds:.1f} s")
    return console.finish("warmup", 0, compiled=cold, seconds=seconds)
