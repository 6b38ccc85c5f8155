"""The Monte Carlo of a proof beside a bare mujoco.rollout: `python benchmarks/rollouts.py [CASE ...]`.

One JSON line per case: simulator steps a second of bare mujoco.rollout, of our open-loop rollouts and of those with
gains, all of the same 512 perturbed machines, and the ratios. The three take turns over the first stages of the plan,
and each ratio is the median of the turns': whatever else this machine does falls on all of them. Making the perturbed
models costs once per rollout, not per step; it is counted in the ratios as it weighs in the whole plan, half in each
mode.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import planner
from planner.base.gl import load_mujoco, load_rollout
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import MODES, RolloutBatch, Rollouts

CASES = ("two-link", "acrobot", "hopper")
ROLLOUTS = 512
STEPS = 400  # of the simulator per turn, about
TURNS = 7
TARGETS = {"open-loop": 0.85, "feedback": 0.5}


def first_stages(plan: planner.Plan, stages: int) -> planner.Plan:
    """The beginning of a plan."""
    return replace(plan, t=plan.t[: stages + 1], xs=plan.xs[: stages + 1], us=plan.us[:stages], K=plan.K[:stages])


def bare(simulator: Rollouts, batches: list[RolloutBatch]) -> Callable[[], Any]:
    """mujoco.rollout at its best: every array ready, one call per batch for all steps."""
    mujoco, model = load_mujoco(), simulator.nominal.model
    data = [mujoco.MjData(model) for _ in simulator._data]
    pool = load_rollout().Rollout(nthread=len(data) if len(data) > 1 else 0)
    calls = []
    for batch in batches:
        K, row = len(batch.models), np.tile(simulator._row, (len(batch.models), 1))
        row[:, 1 : 1 + batch.start.shape[1]] = batch.start
        ctrl = simulator._held(batch, 0, simulator.steps)
        calls.append((batch.models, row, ctrl, np.empty((K, simulator.steps, row.shape[1]))))

    def run() -> None:
        for models, row, ctrl, state in calls:
            pool.rollout(models, data, row, ctrl, nstep=simulator.steps, state=state, skip_checks=True)

    return run


def seconds(call: Callable[[], Any]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def measure(name: str) -> dict[str, Any]:
    """The figures of one case."""
    whole = planner.solve(planner.cases.build(name))
    assert whole.twin is not None
    with Rollouts(whole, CompiledTwin(whole.twin)) as simulator:
        steps, per_stage = simulator.steps, simulator.control_steps * simulator.substeps
    plan = first_stages(whole, max(2, round(STEPS / per_stage)))
    with Rollouts(plan, CompiledTwin(whole.twin)) as simulator:
        sizes, size = simulator.nominal.sizes, simulator.batch_size
        draws = [draw(Perturbation(), 0, k, sizes) for k in range(ROLLOUTS)]
        batches: list[RolloutBatch] = []
        making = seconds(lambda: batches.extend(simulator.batch(draws[k : k + size]) for k in range(0, ROLLOUTS, size)))
        runs = {"bare": bare(simulator, batches)}
        for mode in MODES:
            runs[mode] = lambda mode=mode: [simulator.run(batch, mode) for batch in batches]
        turns = [{kind: seconds(run) for kind, run in runs.items()} for _ in range(1 + TURNS)][1:]  # the first warms up
        done = ROLLOUTS * simulator.steps
        share = 0.5 * making * simulator.steps / steps
        ratios = {mode: statistics.median(turn["bare"] / (turn[mode] + share) for turn in turns) for mode in MODES}
        best = {kind: done / min(turn[kind] for turn in turns) for kind in runs}
        return {
            "case": name, "rollouts": ROLLOUTS, "steps": steps, "threads": len(simulator._data),
            "steps_per_second": {kind: round(speed) for kind, speed in best.items()},
            "ratio": {mode: round(ratio, 3) for mode, ratio in ratios.items()},
            "ratio_without_making_models": {
                mode: round(statistics.median(turn["bare"] / turn[mode] for turn in turns), 3) for mode in MODES
            },
            "model_ms": round(1e3 * making / ROLLOUTS, 3),
            "targets": TARGETS, "met": all(ratios[mode] >= TARGETS[mode] for mode in MODES),
            "seconds_for_all_open_loop_and_feedback": round(
                making + ROLLOUTS * steps * sum(1.0 / best[mode] for mode in MODES), 1
            ),
        }  # fmt: skip


def main() -> None:
    """One line per case."""
    for name in sys.argv[1:] or CASES:
        print(json.dumps(measure(name)), flush=True)


if __name__ == "__main__":
    main()
