"""Commands about the package itself: list, warmup, versions."""

from __future__ import annotations

import argparse
import inspect
import json
import time
from typing import get_type_hints

from planner import cases
from planner.base.versions import installed_versions
from planner.cases import problem_keys
from planner.cli.console import Console
from planner.cli.parser import PROBLEM_FILE, documented_arguments, has_flag, summary
from planner.kernels.numba.jit import is_warm
from planner.kernels.precompile import KERNELS, SECOND_ORDER, compile_together
from planner.proof.model_parity import parity
from planner.solvers.slq import solve


def list_cases(arguments: argparse.Namespace, console: Console) -> int:
    """The machines, what each shows and its parameters."""
    document = []
    for name, case in cases.CASES.items():
        texts, hints = documented_arguments(case), get_type_hints(case)
        shown = [p for p in inspect.signature(case).parameters.values() if has_flag(hints[p.name])]
        console.say(f"{name}: {summary(case)}")
        rows = []
        for parameter in shown:
            default = "" if parameter.default is None else str(parameter.default)
            rows.append((f"  --{parameter.name.replace('_', '-')}", default, texts.get(parameter.name, "")))
        console.table(("  flag", "default", ""), rows)
        document.append(
            {"case": name, "summary": summary(case),
             "parameters": {p.name: p.default for p in shown}}
        )  # fmt: skip
    keys = {**problem_keys.KEYS, **{f"weights.{name}": text for name, text in problem_keys.WEIGHTS.items()}}
    defaults = {**problem_keys.DEFAULTS, **{f"weights.{n}": v for n, v in problem_keys.DEFAULT_WEIGHTS.items()}}
    console.say(f"{PROBLEM_FILE}: A machine of your own, an MJCF file; see docs/own-machine.md")
    lines = [(f"  {key}", json.dumps(defaults[key]) if key in defaults else "", text) for key, text in keys.items()]
    console.table(("  key", "default", ""), lines)
    console.document({"command": "list", "cases": document, "problem_file": {"keys": keys, "defaults": defaults}})
    return 0


def warmup(arguments: argparse.Namespace, console: Console) -> int:
    """Compile the numerical core, once; says so only if there is something to compile."""
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
        console.say(f"compiled in {seconds:.1f} s")
    console.document({"command": "warmup", "compiled": cold, "seconds": seconds, "exit_code": 0})
    return 0


def versions(console: Console) -> int:
    """Versions of the package and of what its numbers depend on."""
    console.say("  ".join(f"{name} {version}" for name, version in installed_versions().items()))
    return 0
