"""What a loop bears beside its plan with the gains alone: pushes at any time of its task, latency, other masses.

Each is the largest of some levels with which it still succeeds (passes_disturbed), as if less were
survived always. The search at one time begins at what was survived at the time before: neighbours are mostly alike, and
then two runs are enough where halving takes four.
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
    """How large a push at each time, latency and mass error the loop survives, beside the plan with its gains alone.

    Args:
        controller: To be judged; it is reset for each run.
        body: That is pushed.
        times: How many times of pushes, spread over the task.
        latency: s, of the runs that have pushes and masses. A controller that knows a latency is told that of each run.
        direction: (3,) of the pushes.
        duration: s, of each run; by default the task and two seconds.
        push_duration: s.
        progress: Called with (parts done, parts in all).

    Returns:
        The section, the map by who ("loop", "gains"), and the times.
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
            if isinstance(party, Controller) and known:  # it was told its latency: it is told this one
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
    """The largest level that is survived; 0 where not even the least is."""
    most = largest_survived(len(levels), lambda level: survived(levels[level]))
    return levels[most] if most >= 0 else 0.0
