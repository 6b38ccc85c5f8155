"""Margins of a closed loop: pushes at each time of the task, latency and mass that it bears; the rate its calls allow.

A margin is the largest of some levels with which the loop still succeeds (passes_disturbed), assuming that success is
monotonic in the level. The search at one push time starts from the margin at the previous time: two runs then often
suffice where bisection takes four. The same margins of the plan's fixed gains stand beside them.

Latency and rate that a computer allows follow from processor time: what else runs on it now is not in it. The wall time
that it takes from a call, too, is counted as overruns.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.base.measured import Measurement, Section
from planner.control.controller import Controller
from planner.control.judging import CallTimes, passes_disturbed, times_of
from planner.control.simulating import LATE, STAYS, simulate
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.monte_carlo import LEVELS, largest_survived
from planner.proof.robustness.perturbation import Push

PUSHES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)  # N
LATENCIES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # s
TIMES = 20
FIXED_PLAN = "plan with its gains alone"


def margins(
    controller: Controller, body: str, *, times: int = TIMES, latency: float = 0.0,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[Section, dict[str, np.ndarray], np.ndarray]:  # fmt: skip
    """Largest push at each time, latency and mass error that the loop, and the plan's fixed gains, survive.

    Args:
        controller: Reset for each run.
        body: The pushed body, along x.
        times: Number of push times, uniform over the task.
        latency: s, of the runs with pushes and mass errors. A controller with `latency` > 0 gets that of each run.
        progress: Called with (searches done, all searches).

    Returns:
        The section; the largest survived push (times,), N, by "loop" and "gains"; the push times, s.
    """
    T = controller.problem.duration
    compiled = CompiledTwin(controller.problem.twin)  # type: ignore[arg-type]
    at, duration = np.linspace(0.0, T, times), T + LATE + STAYS
    parties: dict[str, Controller | Plan] = {"loop": controller, "gains": controller.plan}
    maps = {who: np.zeros(times) for who in parties}
    measured, done, total, known = [], 0, len(parties) * (times + 2), controller.latency

    def told() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for who, party in parties.items():

        def run(party: Controller | Plan = party, **errors: Any) -> bool:
            given: dict[str, Any] = {"latency": latency} | errors
            if isinstance(party, Controller) and known:  # it compensates latency: by that of this run
                party.latency = given["latency"]
            return passes_disturbed(simulate(party, duration=duration, compiled=compiled, **given))

        near = None
        for k, t in enumerate(at.tolist()):

            def stands(level: int, t: float = t, run: Callable[..., bool] = run) -> bool:
                return run(pushes=[Push(body, PUSHES[level], t)])

            near = largest_survived(len(PUSHES), stands, near)
            maps[who][k] = PUSHES[near] if near >= 0 else 0.0
            told()
        late = _largest(LATENCIES, lambda s, run=run: run(latency=s)) if who == "loop" else np.nan
        told()
        mass = _largest(LEVELS, lambda error, run=run: run(mass=error))
        told()
        words = "" if who == "loop" else f"; {FIXED_PLAN}"
        measured += [
            Measurement(
                f"{who}_least_push", float(maps[who].min()), "N", None, f"{body}, at any of {times} times{words}"
            ),
            Measurement(f"{who}_median_push", float(np.median(maps[who])), "N", None, f"of these times{words}"),
            Measurement(f"{who}_mass_margin", mass, "", None, f"all bodies heavier by this share{words}"),
        ]  # fmt: skip
        if who == "loop":
            measured.append(Measurement("loop_latency_margin", late, "s", None, "from asking for a plan until it acts"))
    controller.latency = known
    return Section("survives", tuple(measured)), maps, at


def _largest(levels: Sequence[float], survived: Callable[[float], bool]) -> float:
    """The largest survived level; 0 where the lowest one fails."""
    most = largest_survived(len(levels), lambda level: survived(levels[level]))
    return levels[most] if most >= 0 else 0.0


CALLS, SECONDS = 100, 2.0  # measured calls at most, and the wall time of all of them, s, after the first FEWEST
FEWEST = 10


def measured_calls(controller: Controller) -> CallTimes:
    """Processor times of planning calls, one per period, in the problem's own dynamics; resets the controller."""
    controller.reset()
    controller.simulated = True
    dynamics, x, taken, began = controller.problem.dynamics, controller.problem.x0, list[float](), time.perf_counter()
    period = 1.0 / controller.rate
    for k in range(CALLS):
        u = controller(k * period, x)
        taken.append(controller.processor_seconds)
        if len(taken) >= FEWEST and time.perf_counter() - began > SECONDS:
            break
        for part in np.full(max(round(period / dynamics.dt), 1), dynamics.dt):
            x = dynamics.step(x[None], u[None], np.array([part]))[0]
    controller.reset()
    return times_of(np.array(taken))


def fitting_rate(controller: Controller, latency: float) -> float:
    """The highest rate, Hz, of one plan every whole number of stages, whose period is not shorter than a latency, s.

    Raises:
        PlannerError: No plan of the controller's horizon lasts that long.
    """
    dt, H = controller.problem.dynamics.dt, controller.horizon
    stages = max(math.ceil(latency / dt - 1e-9), 1)
    if stages > H:
        raise PlannerError(
            f"a call takes {1e3 * latency:.3g} ms and a plan ends after {1e3 * H * dt:.3g} ms, expected a longer "
            "horizon, or a faster computer."
        )
    return 1.0 / (stages * dt)
