"""Controllers in the loop: the time of a call from x to u, its own Python, and Crocoddyl's one iteration beside it.

    python benchmarks/loop.py [--crocoddyl PYTHON] [--shown]

A call plans once with one iteration: the plan before is rolled out from x with its gains, then linearised, swept and
searched. Kernels are the compiled calls of it, timed alone at the same trajectory; the difference is Python's.
Crocoddyl has one iteration from a trajectory whose rollout it is given for nothing. One core each, by turns in one run,
medians and minima: on a computer that does other things, too, minima tell more.

--shown drives the machines that docs/loop.md shows, with figures of each.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from planner_worker import posed  # noqa: E402
from rigid_body_problems import EULER, iteration_problem, probes  # noqa: E402
from serving import Worker  # noqa: E402

import planner  # noqa: E402
from planner.control.judging import judge  # noqa: E402
from planner.kernels.lq import search  # noqa: E402

ROOT = Path(__file__).parent.parent
REPEATS, ROUNDS = 60, 5
LATE = 0.01  # s, of the machines that are shown; their controllers know it
SIZES = {"2r": 50, "arm7": 50, "humanoid": 40}


def problem_of(name: str) -> dict[str, Any]:
    """The problem of an iteration, as JSON, over so many stages."""
    problem = iteration_problem(name, EULER)
    N = SIZES[name]
    return problem | {"N": N, "us": problem["us"][:N]}


def controller_of(problem: dict[str, Any]) -> planner.Controller:
    """Our controller of it, begun with a plan of a few iterations."""
    own = posed(problem)
    return planner.Controller(own, plan=planner.solve(own, max_iterations=20))


def call_times(controller: planner.Controller, repeats: int, rng: np.random.Generator) -> np.ndarray:
    """Seconds of calls one stage apart, in the plan's own dynamics with a little noise."""
    dynamics, times = controller.problem.dynamics, np.empty(repeats)
    controller.reset()
    x, space = controller.problem.x0, controller.plan.space
    for k in range(repeats):
        began = time.perf_counter()
        u = controller(k * dynamics.dt, x)
        times[k] = time.perf_counter() - began
        x = space.integrate(dynamics.step(x[None], u[None])[0], 1e-4 * rng.standard_normal(space.ndx))
    if controller.failures:
        print(f"  {controller.failures} solves failed: {controller.events[0]}")
    return times


def kernel_times(controller: planner.Controller, repeats: int) -> np.ndarray:
    """Seconds of the compiled calls of a plan at the controller's trajectory, without anything around them."""
    engine: Any = controller._engine
    w, dynamics, memory, kernels = engine._w, engine._dynamics, engine._memory, engine._riccati
    from planner.kernels.lq.quadratic import gradients

    times = np.empty(repeats)
    for k in range(repeats):
        engine.follow(controller._xs[0], (controller._xs, controller._us, controller._K))
        began = time.perf_counter()
        cost = dynamics.search(w, memory, search.START, True, np.inf, 0.0)[1]
        dynamics.linearize_nominal(w, memory)
        gradients(w.table)
        kernels(w.table, 0.0, dynamics.dt)
        dynamics.search(w, memory, search.CLOSING, True, max(cost, 1.0) + 1.0, -1e-12)  # takes the full step, as a rule
        times[k] = time.perf_counter() - began
    return times


def compare(python: str) -> None:
    """The table of calls, kernels and Crocoddyl."""
    worker = Worker(python, "crocoddyl_worker.py", {"OMP_NUM_THREADS": "1"}, "Crocoddyl") if python else None
    if worker is not None:
        print(f"Crocoddyl {worker.hello.get('version', worker.hello)}")
    print("           stages   call us (least)    99 %  calls/s  kernels (least)  Python  Crocoddyl (least)   ratio")
    rng = np.random.default_rng(0)
    for name in SIZES:
        problem = problem_of(name)
        controller = controller_of(problem)
        known = False
        if worker is not None:
            known = "failed" not in worker.ask("load", problem=problem, probes=probes(problem))
        calls, kernels, theirs = [], [], []
        for _ in range(ROUNDS):
            calls.append(call_times(controller, REPEATS, rng))
            kernels.append(kernel_times(controller, REPEATS))
            if known:
                theirs += worker.ask("iterate", repeats=REPEATS, seconds=5.0)["times"]  # type: ignore[union-attr]
        call, kernel = (1e6 * np.concatenate(one) for one in (calls, kernels))
        other = 1e6 * np.array(theirs) if theirs else np.array([np.nan])
        python_us = call.min() - kernel.min()
        print(
            f"{name:10}{SIZES[name]:7}{np.median(call):9.0f} ({call.min():6.0f}){np.percentile(call, 99):8.0f}"
            f"{1e6 / np.median(call):9.0f}{np.median(kernel):8.0f} ({kernel.min():5.0f}){python_us:8.0f}"
            f"{np.median(other):11.0f} ({other.min():6.0f})"
            f"{np.median(other) / np.median(call):8.1f} ({other.min() / call.min():.1f})"
        )
    if worker is not None:
        worker.close()


def shown() -> None:
    """The machines of docs/loop.md."""
    print(f"\n{'':24}{'verdict':44}{'calls/s':>8}{'99 % us':>9}{'failed':>7}{'times real time':>16}")
    example = ROOT / "examples" / "tasks"
    two_link = planner.cases.two_link()
    push = planner.Push("forearm", 20.0, 1.0)

    def target(t: float) -> list[float]:
        return [1.3 + 0.4 * np.sin(t), -0.4 + 0.4 * np.cos(t), 0.4 * np.cos(t), -0.4 * np.sin(t)]

    def hand(t: float) -> dict[str, Any]:
        ahead = t + 0.01 * np.arange(41)
        return {"hand": np.stack([0.3 + 0 * ahead, 0.3 + 0.1 * np.cos(2 * ahead), 0.5 + 0.1 * np.sin(2 * ahead)], 1)}

    cart = planner.load_problem(ROOT / "examples" / "loop" / "cart_pole.toml")
    reach = planner.load_problem(example / "reach.toml")
    pushes = [planner.Push("cart", 20.0, 1.0), planner.Push("cart", -20.0, 4.0)]
    row("cart-pole", planner.Controller(cart, latency=LATE), pushes=pushes, duration=7.0)
    acrobot = planner.Controller(planner.cases.acrobot(), latency=LATE)
    row("acrobot", acrobot, pushes=[planner.Push("forearm", 3.0, 2.0)], duration=6.0)
    row("two-link", planner.Controller(two_link, latency=LATE), pushes=[push])
    row("two-link, moving goal", planner.Controller(two_link, horizon=50, latency=LATE), goal=target, duration=8.0)
    row("7 joints, reach", planner.Controller(reach, latency=LATE))
    row("7 joints, moving hand", planner.Controller(reach, horizon=40, latency=LATE), goal=hand, duration=6.0)
    limits = planner.load_problem(example / "reach_within_limits.toml")
    row("7 joints, limits", planner.Controller(limits, latency=LATE))
    row("hopper", planner.Controller(planner.cases.hopper(), latency=LATE))


def starts(count: int = 20) -> None:
    """The acrobot from random states, beside its plans with the gains alone."""
    problem, rng, won = planner.cases.acrobot(), np.random.default_rng(0), [0, 0]
    for _ in range(count):
        x0 = np.concatenate([rng.uniform(-np.pi, np.pi, 1), rng.uniform(-1.0, 1.0, 1), rng.uniform(-0.5, 0.5, 2)])
        controller = planner.Controller(replace(problem, x0=x0), latency=LATE)
        loop = planner.simulate(controller, latency=LATE, duration=6.0, mass=0.02)
        alone = planner.simulate(controller.plan, duration=6.0, mass=0.02)
        won[0] += judge(loop).passed
        won[1] += judge(alone).passed
    words = f"{won[0]} loops pass, and {won[1]} plans with their gains alone"
    print(f"\nacrobot from {count} random states, 2 % heavier, 10 ms late: {words}")


def row(name: str, controller: planner.Controller, **options: Any) -> None:
    """Drive one machine, and print its figures."""
    began = time.perf_counter()
    loop = planner.simulate(controller, latency=LATE, **options)
    took, verdict, us = time.perf_counter() - began, judge(loop), 1e6 * loop.call_seconds
    measured = verdict.sections.get("follows", verdict.sections["calls"]).measured
    follows = [one for one in measured if "from_its" in one.name]
    words = verdict.headline + (f", {follows[0].value:.3g} {follows[0].unit} off" if follows else "")
    print(
        f"{name:24}{words:44}{1e6 / np.median(us):8.0f}{np.percentile(us, 99):9.0f}{controller.failures:7}"
        f"{loop.t[-1] / took:16.1f}"
    )


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--crocoddyl", help="an interpreter that has Crocoddyl")
    arguments.add_argument("--no-table", action="store_true", help="without the table of times")
    arguments.add_argument("--shown", action="store_true", help="also drive the machines of docs/loop.md")
    arguments.add_argument("--starts", type=int, default=0, help="also drive the acrobot from so many random states")
    asked = arguments.parse_args()
    if not asked.no_table:
        compare(asked.crocoddyl or "")
    if asked.shown:
        shown()
    if asked.starts:
        starts(asked.starts)
