"""Robustness margins of a closed loop and of its plan's fixed gains: push at each time of the task, latency, mass.

A margin is the largest of some levels with which the loop still succeeds (passes_disturbed), assuming that success is
monotonic in the level. The search at one push time starts from the margin at the previous time: two runs then often
suffice where bisection takes four.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from planner.base.measured import Measurement, Section
from planner.control.controller import Controller
from planner.control.judging import passes_disturbed
from planner.control.simulating import LATE, STAYS, simulate
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.monte_carlo import LEVELS, largest_survived
from planner.proof.robustness.pushes import DURATION, Push

PUSHES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)  # N
LATENCIES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # s
TIMES = 20
FIXED_PLAN = "plan with its gains alone"


def margins(
    controller: Controller, body: str, *, times: int = TIMES, latency: float = 0.0, direction: Any = (1.0, 0.0, 0.0),
    duration: float | None = None, push_duration: float = DURATION,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[Section, dict[str, np.ndarray], np.ndarray]:  # fmt: skip
    """Largest push at each time, latency and mass error that the loop, and the plan's fixed gains, survive.

    Args:
        controller: Reset for each run.
        body: The pushed body.
        times: Number of push times, uniform over the task.
        latency: s, of the runs with pushes and mass errors. A controller with `latency` > 0 gets that of each run.
        direction: (3,) of the push force in the world.
        duration: s, of each run; by default that of the task plus 2 s.
        push_duration: s.
        progress: Called with (searches done, all searches).

    Returns:
        The section; the largest survived push (times,), N, by "loop" and "gains"; the push times, s.
    """
    T = controller.problem.duration
    compiled = CompiledTwin(controller.problem.twin)  # type: ignore[arg-type]
    at, duration = np.linspace(0.0, T, times), T + LATE + STAYS if duration is None else duration
    along = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
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
                return run(pushes=[Push(body, PUSHES[level] * along, t, push_duration)])

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
