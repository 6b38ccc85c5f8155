"""Machines in the loop with MuJoCo, as docs/loop.md shows them: how many loops succeed, and how fast their calls are.

Each is a function that yields its loops, one after another, every one 10 ms late with a controller that knows it. What
is random has the seed 0. A loop succeeds where its verdict is PASS.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from robots_problems import problem_text

import planner
from planner.control.judging import judge
from planner.control.simulating import ClosedLoopRun

ROOT = Path(__file__).parent.parent
LATE = 0.01  # s
HOPS, PEOPLE = 20, 6
LEGS = {f"{side}_{part}": 0.2 for side in ("right", "left") for part in ("thigh", "shank", "foot")}


class Driven(NamedTuple):
    """One loop, how long it took, s, and whether its plan succeeds with the gains alone, where that was tried."""

    loop: ClosedLoopRun
    took: float
    alone: bool | None = None


class Asked(NamedTuple):
    """What the command line asked for."""

    starts: int
    packages: Path | None


def run(controller: planner.Controller, alone: bool = False, **options: Any) -> Driven:
    """Drive a controller and, with `alone`, its plan with the gains alone."""
    began = time.perf_counter()
    loop = planner.simulate(controller, latency=LATE, **options)
    took = time.perf_counter() - began
    return Driven(loop, took, judge(planner.simulate(controller.plan, **options)).passed if alone else None)


def late(problem: planner.Problem, **options: Any) -> planner.Controller:
    """A controller that knows that it is late."""
    return planner.Controller(problem, latency=LATE, **options)


def task(name: str, **options: Any) -> planner.Controller:
    """A controller of a problem file in examples."""
    return late(planner.load_problem(ROOT / "examples" / f"{name}.toml"), **options)


def cart_pole(_: Asked) -> Iterator[Driven]:
    """It swings up, and is pushed with 20 N at 1 s and -20 N at 4 s."""
    pushes = [planner.Push("cart", 20.0, 1.0), planner.Push("cart", -20.0, 4.0)]
    yield run(task("loop/cart_pole"), alone=True, pushes=pushes, duration=7.0)


def acrobot(asked: Asked) -> Iterator[Driven]:
    """It swings up from random states, 2 % heavier than planned."""
    problem, rng = planner.cases.acrobot(), np.random.default_rng(0)
    for _number in range(asked.starts):
        x0 = np.concatenate([rng.uniform(-np.pi, np.pi, 1), rng.uniform(-1.0, 1.0, 1), rng.uniform(-0.5, 0.5, 2)])
        yield run(late(replace(problem, x0=x0)), duration=6.0, mass=0.02)


def two_link(_: Asked) -> Iterator[Driven]:
    """It is pushed with 20 N at 1 s."""
    yield run(late(planner.cases.two_link()), alone=True, pushes=[planner.Push("forearm", 20.0, 1.0)])


def two_link_follows(_: Asked) -> Iterator[Driven]:
    """Its goal moves at 0.4 rad/s; where it will be over the horizon is known."""
    problem, horizon = planner.cases.two_link(), 50

    def target(t: float) -> np.ndarray:
        ahead = t + problem.dynamics.dt * np.arange(horizon + 1)
        s, c = 0.4 * np.sin(ahead), 0.4 * np.cos(ahead)
        return np.stack([1.3 + s, -0.4 + c, c, -s], axis=1)

    yield run(late(problem, horizon=horizon), goal=target, duration=8.0)


def arm(_: Asked) -> Iterator[Driven]:
    """A hand goes to a place."""
    yield run(task("tasks/reach"))


def arm_follows(_: Asked) -> Iterator[Driven]:
    """A hand follows a target on a circle, at 0.2 m/s, within torques and ranges of joints."""

    def hand(t: float) -> dict[str, Any]:
        ahead = t + 0.01 * np.arange(41)
        return {"hand": np.stack([0.3 + 0 * ahead, 0.3 + 0.1 * np.cos(2 * ahead), 0.5 + 0.1 * np.sin(2 * ahead)], 1)}

    yield run(task("tasks/reach", horizon=40), goal=hand, duration=6.0)


def arm_limits(_: Asked) -> Iterator[Driven]:
    """A heavy part to the other side, no joint faster than 1.2 rad/s."""
    yield run(task("tasks/reach_within_limits"))


def hopper(_: Asked) -> Iterator[Driven]:
    """Hops to changing heights of 10 to 30 in, each from where the one before ended."""
    rng, controller = np.random.default_rng(0), late(planner.cases.hopper())
    x = controller.problem.x0
    for _number in range(HOPS):
        problem = planner.cases.hopper(height=rng.uniform(10.0, 30.0))
        driven = run(late(replace(problem, x0=x)), duration=problem.duration)
        x = driven.loop.xs[-1]
        yield driven


def monopod(_: Asked) -> Iterator[Driven]:
    """Hops half a metre again and again, each from where the one before landed, pushed with up to 20 N to and fro."""
    rng, x = np.random.default_rng(0), None
    controller = planner.Controller(moving("monopod-forward"), rate=50.0, latency=LATE)
    for _number in range(HOPS // 2):
        push = planner.Push("trunk", rng.uniform(-20.0, 20.0), 0.4)
        driven = run(controller, duration=controller.problem.duration, start=x, pushes=[push])
        x = driven.loop.xs[-1] - np.array([0.5, *np.zeros(7)])
        yield driven


def quadruped(_: Asked) -> Iterator[Driven]:
    """Rises on its four feet and stands, pushed with 50 N either way at 0.5 s."""
    controller = planner.Controller(moving("quadruped-rise"), rate=10.0, latency=LATE)
    for force in (50.0, -50.0):
        yield run(controller, alone=True, pushes=[planner.Push("trunk", force, 0.5)], duration=2.0)


def moving(name: str) -> planner.Problem:
    """A problem file beside this file."""
    return planner.load_problem(ROOT / "benchmarks" / "moving" / f"{name}.toml")


def human_step(_: Asked) -> Iterator[Driven]:
    """Patients of 50 to 90 kg and 1.6 to 1.9 m, whose legs are 20 % heavier than planned."""
    rng = np.random.default_rng(0)
    for _number in range(PEOPLE):
        problem = planner.cases.human_step(mass=rng.uniform(50.0, 90.0), height=rng.uniform(1.6, 1.9))
        yield run(late(problem), alone=True, duration=problem.duration, mass=LEGS)


def walker(asked: Asked) -> Iterator[Driven]:
    """dm-control's walker bends its knees, stands, and is pushed with 20 to 100 N at 1 s."""
    if asked.packages is None:
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "walker.toml"
        file.write_text(problem_text(asked.packages / "dm_control/suite/walker.xml", "legged", Path(folder)))
        controller = late(planner.load_problem(file))
        for force in (20.0, 50.0, 100.0, -20.0, -50.0, -100.0):
            yield run(controller, alone=True, pushes=[planner.Push("torso", force, 1.0)], duration=3.0)


SHOWN = {
    "cart-pole": cart_pole, "acrobot": acrobot, "two-link": two_link, "two-link-follows": two_link_follows,
    "arm": arm, "arm-follows": arm_follows, "arm-limits": arm_limits, "hopper": hopper, "monopod": monopod,
    "quadruped": quadruped, "human-step": human_step, "walker": walker,
}  # fmt: skip


def drive(names: list[str], starts: int, packages: Path | None) -> None:
    """Print a row of figures for each machine."""
    print(f"{'':18}{'succeed':>10}{'gains alone':>13}{'calls/s':>9}{'99 % ms':>9}{'failed':>8}{'real time':>11}")
    for name in names:
        passed, alone, calls, failed, simulated, took, off = [], [], [], 0, 0.0, 0.0, ""
        for loop, seconds, won in SHOWN[name](Asked(starts, packages)):
            verdict = judge(loop)
            passed.append(verdict.passed)
            alone += [] if won is None else [won]
            calls.append(loop.call_seconds)
            failed, simulated, took = failed + loop.controller.failures, simulated + loop.t[-1], took + seconds
            if "follows" in verdict.sections:
                off = "  " + "; ".join(map(str, verdict.sections["follows"].measured))
        if not passed:
            print(f"{name:18}is left out: it needs --packages")
            continue
        each = np.concatenate(calls)
        without = f"{sum(alone)} of {len(alone)}" if alone else ""
        print(
            f"{name:18}{f'{sum(passed)} of {len(passed)}':>10}{without:>13}{1.0 / np.median(each):9.0f}"
            f"{1e3 * np.percentile(each, 99):9.2f}{failed:8}{simulated / took:11.2f}{off}",
            flush=True,
        )
