"""Where an iteration's time goes: `python benchmarks/hopper.py --profile`.

A kernel of a microsecond cannot be timed from Python, where the call alone takes longer. Each phase runs in a compiled
loop on a solve's own memory; each layer above it (one compiled call, the engine, solve) is timed from Python, and
what a layer adds is the difference. All are taken in turn and the least of many is kept.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit
from problems import PROBLEMS

import planner
from planner.cases.hopper import PAPER
from planner.engine import CompiledEngine
from planner.kernels import hopper as kernels
from planner.kernels.riccati import gradients, riccati
from planner.kernels.workspace import accept

LOOP, ROUNDS = 200, 60  # calls in a compiled loop; how often each phase has its turn


@njit
def _linearize(count, code, dt, parameters, w):
    for _ in range(count):
        kernels.linearize(code, dt, parameters, w.xs, w.us, w.knots, w.F)


@njit
def _gradients(count, w):
    for _ in range(count):
        gradients(w)


@njit
def _riccati(count, w):
    for _ in range(count):
        riccati(w, 0.0)


@njit
def _rollout(count, code, dt, parameters, w):
    for _ in range(count):
        kernels.rollout(code, dt, parameters, w, True, False)


@njit
def _accept(count, w):
    for _ in range(count):
        accept(w, 0)


@njit
def _copy(count, w, xs, us):
    for _ in range(count):
        w.xs[:] = xs
        w.us[:] = us


@njit
def _iterate(count, code, dt, parameters, w, xs, us, cost):
    # From the same trajectory each time, so that the search does the same each time; _copy is taken off again.
    for _ in range(count):
        w.xs[:] = xs
        w.us[:] = us
        kernels.iterate(code, dt, parameters, w, 0, True, 0.0, True, cost, 0.0, 0.0)


@njit
def _nothing(code, dt, parameters, w, rule, feedback, mu, fresh, cost, gradient_tolerance, decrease_tolerance):
    return 0


def _least(actions: dict[str, tuple[Callable[[], Any], int]]) -> dict[str, float]:
    """Microseconds per call, the least over interleaved rounds; each action comes with the calls it stands for."""
    best = dict.fromkeys(actions, float("inf"))
    for action, _ in actions.values():
        action()  # compile
    for _ in range(ROUNDS):
        for name, (action, calls) in actions.items():
            repeats = 1 if calls > 1 else 20
            for _ in range(repeats):
                started = time.perf_counter()
                action()
                best[name] = min(best[name], 1e6 * (time.perf_counter() - started) / calls)
    return best


def measure(name: str) -> dict[str, Any]:
    """Times of one problem's phases, us."""
    problem = planner.cases.hopper(height=PROBLEMS[name].height, **PAPER)
    plan = planner.solve(problem)
    # Halfway through the solve: past the first full steps, not yet where every step is full again.
    halfway = planner.solve(problem, max_iterations=max(1, plan.nit // 2))
    dynamics = problem.dynamics
    engine = CompiledEngine(dynamics, problem.cost)
    cost = engine.start(problem.x0, halfway.us)
    xs, us = engine.trajectory()
    engine.iterate(True, 0, 0.0, True, cost, 0.0, 0.0)
    w, machine = engine._w, (dynamics._code, dynamics.dt, dynamics._parameters)

    def once(call: Callable[..., Any], *arguments: Any) -> None:
        w.xs[:], w.us[:] = xs, us
        call(*arguments)

    options = (0, True, 0.0, True, cost, 0.0, 0.0)
    loops = {
        "linearize": partial(_linearize, LOOP, *machine, w),
        "gradients": partial(_gradients, LOOP, w),
        "riccati": partial(_riccati, LOOP, w),
        "rollout": partial(_rollout, LOOP, *machine, w),
        "accept": partial(_accept, LOOP, w),
        "copy": partial(_copy, LOOP, w, xs, us),
        "iterate": partial(_iterate, LOOP, *machine, w, xs, us, cost),
    }
    calls: dict[str, Callable[[], Any]] = {
        "reset": partial(once, lambda: None),
        "dispatch": partial(_nothing, *machine, w, *options),
        "engine call": partial(once, engine.iterate, True, 0, 0.0, True, cost, 0.0, 0.0),
        "solve": partial(planner.solve, problem),
    }
    us_of = _least({k: (f, LOOP) for k, f in loops.items()} | {k: (f, 1) for k, f in calls.items()})
    us_of["iterate"] -= us_of.pop("copy")
    engine_call = us_of["engine call"] - us_of["reset"]
    last = plan.history[-1]  # the converged plan's own line: linearised and swept, but not searched
    searched = len(plan.history) - (last.step == 0.0)
    return {
        "problem": name, "iterations": len(plan.history), "full_steps": sum(i.step == 1.0 for i in plan.history),
        "rejected": sum(i.step == 0.0 for i in plan.history[:-1]),
        **{f"{k}_us": us_of[k] for k in loops if k in us_of},
        "dispatch_us": us_of["dispatch"],
        "engine_us": engine_call,
        "solve_us": us_of["solve"],
        "per_iteration_us": us_of["solve"] / len(plan.history),
        # What solve adds to its iterations: first rollout, history, plan, and search batches after the first.
        "around_us": us_of["solve"] - searched * engine_call - (len(plan.history) - searched) * (
            engine_call - us_of["rollout"] - us_of["accept"]
        ),
    }  # fmt: skip


def report(as_json: bool) -> None:
    """Print the profile of every problem."""
    for name in PROBLEMS:
        p = measure(name)
        if as_json:
            print(json.dumps(p), flush=True)
            continue
        rest = p["iterate_us"] - sum(p[f"{k}_us"] for k in ("linearize", "gradients", "riccati", "rollout", "accept"))
        count, each = p["iterations"], p["per_iteration_us"]
        print(f"{name}: {p['solve_us']:.1f} us = {count} iterations of {each:.2f} us, all told")
        for label, value in (
            ("linearize (Eq. 35)", p["linearize_us"]),
            ("gradients of the stage costs", p["gradients_us"]),
            ("Riccati sweep and costate", p["riccati_us"]),
            ("rollout of eight candidates", p["rollout_us"]),
            ("accept one", p["accept_us"]),
            ("choice of step, rest", rest),
            ("= whole iterate, compiled", p["iterate_us"]),
            ("Python to compiled code and back", p["dispatch_us"]),
            ("engine", p["engine_us"] - p["iterate_us"] - p["dispatch_us"]),
            ("= one iteration's engine call", p["engine_us"]),
            ("around them, per solve", p["around_us"]),
        ):
            print(f"    {label:<34} {value:7.2f} us")
        print()


if __name__ == "__main__":
    report("--json" in sys.argv)
