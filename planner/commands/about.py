"""Commands about the package itself: list, warmup, versions."""

from __future__ import annotations

import argparse
import inspect
import time

from planner import cases
from planner.commands.parser import documented_arguments, summary
from planner.console import Console
from planner.kernels import hopper
from planner.kernels.jit import is_warm
from planner.plan import installed_versions
from planner.slq import solve


def list_cases(arguments: argparse.Namespace, console: Console) -> int:
    """The machines, what each shows and its parameters."""
    document = []
    for name, case in cases.CASES.items():
        texts = documented_arguments(case)
        console.say(f"{name}: {summary(case)}")
        rows = []
        for parameter in inspect.signature(case).parameters.values():
            default = "" if parameter.default is None else str(parameter.default)
            rows.append((f"  --{parameter.name.replace('_', '-')}", default, texts.get(parameter.name, "")))
        console.table(("  flag", "default", ""), rows)
        document.append(
            {"case": name, "summary": summary(case),
             "parameters": {p.name: p.default for p in inspect.signature(case).parameters.values()}}
        )  # fmt: skip
    console.document({"command": "list", "cases": document})
    return 0


def warmup(arguments: argparse.Namespace, console: Console) -> int:
    """Compile the numerical core, once; says so only if there is something to compile."""
    cold = not is_warm(hopper.iterate)
    began = time.perf_counter()
    problem = cases.hopper(horizon=8, duration=0.04)
    plan = solve(problem, max_iterations=2)
    problem.dynamics.step(plan.xs[:1], plan.us[:1])
    problem.dynamics.linearize(plan.xs, plan.us)
    if problem.requirements is not None:
        problem.requirements.rates(plan.xs[:1], plan.us[:1])
    seconds = time.perf_counter() - began
    if cold:
        console.say(f"compiled in {seconds:.1f} s")
    console.document({"command": "warmup", "compiled": cold, "seconds": seconds, "exit_code": 0})
    return 0


def versions(console: Console) -> int:
    """Versions of the package and of what its numbers depend on."""
    console.say("  ".join(f"{name} {version}" for name, version in installed_versions().items()))
    return 0
