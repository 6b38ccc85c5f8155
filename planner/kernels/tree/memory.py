"""Scratch memory of the tree kernels on lanes, and the accelerations that linearization takes from rollouts."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.integrators import MAX_STAGES, ROSENBROCK, Integrator
from planner.kernels.numba.lanes import WIDTH, lane_array, neighbors, padded
from planner.kernels.numba.layout import Layout
from planner.kernels.tree.recursion import RECORD
from planner.kernels.tree.soft_contact import SOFT_MEMORY

MEMORY = Layout(
    "integrator stages ld columns first block substeps kept stride loop_width",
    "links x u tau scratch rates theta q_stage v_stages act_stage act_rates a trial_a accelerations M Dq Dv held "
    "by_stage turns direct chained Xa step product heavier pushed before asked rest "
    "loop_J loop_WJ loop_N loop_least loop_c loop_f loop_D loop_Y implicit behind own behind_rows method soft near "
    "guess loop_before",
)


class TreeMemory:
    """Arrays for a Model; accelerations of N stages of some substeps are kept, of none for single calls.

    States of a solve may have `appended` components behind the model's own.
    """

    def __init__(
        self, model: Any, integrator: Integrator, N: int, linearizing: bool = True, substeps: int = 1, appended: int = 0
    ) -> None:
        nv, nq, nu, na = model.nv, model.nq, model.nu, model.na
        stages = integrator.stages
        ld, first = padded(nv), padded(nu)
        columns = first + padded(2 * nv + na) + WIDTH  # products are written four columns at a time
        n = nv if linearizing else 0
        rows = model.loop_rows
        stride = nv + rows  # of a stage's accelerations, and the forces of its closed chains behind them
        kept = substeps * stages * stride  # of a whole stage
        loop_width = padded(2 * nv) + WIDTH  # tiles read past the end
        block = padded(nv) * (columns - WIDTH)  # of a knot's derivatives, one row an acceleration
        slack = 4 * columns  # tiles read past the end
        lanes = {
            "links": max(nv * RECORD, 2 * nv + nq + na), "x": nq + nv + na + appended, "u": nu, "tau": nv,
            "scratch": 16,
            "rates": na, "theta": nv,
            "q_stage": nq, "v_stages": MAX_STAGES * nv, "act_stage": na, "act_rates": MAX_STAGES * na, "a": kept,
            "trial_a": N * kept, "M": (nv if model.coupled or rows else n) * ld, "Dq": n * ld, "Dv": n * ld,
            "held": n * nu,
            "heavier": nv, "pushed": nv, "before": nv, "asked": nv, "rest": nv, "implicit": nv, "behind": nv,
            "own": nv, "guess": nv, "soft": SOFT_MEMORY * model.softs,
            "loop_J": rows * ld, "loop_WJ": rows * ld, "loop_N": rows * rows, "loop_c": rows,
            "loop_f": rows, "loop_before": rows,
            "loop_least": 3 if rows else 0, "loop_D": rows * loop_width, "loop_Y": rows * ld,
            "by_stage": n * columns, "turns": (MAX_STAGES + 1) * 18 * len(model.arrays["ball_v"]),
        }  # fmt: skip
        trial_a = lanes.pop("trial_a")  # the only large one
        flat = neighbors(**{name: WIDTH * (count + 1) for name, count in lanes.items()})
        self._arrays = {name: array.reshape(-1, WIDTH) for name, array in flat.items()}
        self._arrays["trial_a"] = lane_array(trial_a + 1, WIDTH)
        self._arrays["accelerations"] = np.zeros(N * kept + 1)
        self._arrays["Xa"] = np.zeros(4 * na + 1)
        blocks = block if linearizing else 0
        self._arrays["direct"] = lane_array(stages * WIDTH * blocks + slack)
        self._arrays["chained"] = lane_array((stages if integrator.has_substeps else 0) * blocks + slack)
        whole = padded(2 * nv + na) * (columns - WIDTH) if linearizing and substeps > 1 else 0  # (B | A) of a substep
        self._arrays["step"], self._arrays["product"] = lane_array(whole + slack), lane_array(whole + slack)
        behind = WIDTH * ld * ld if linearizing and integrator.form == ROSENBROCK else 0
        self._arrays["behind_rows"] = lane_array(behind + slack)
        self._arrays["method"] = integrator.numbers
        self._arrays["near"] = np.zeros(model.softs + 1)  # soft contacts that touch: how many, and which
        sizes = {
            "integrator": integrator.form, "stages": stages, "ld": ld, "columns": columns, "first": first,
            "block": block, "substeps": substeps, "kept": kept, "stride": stride, "loop_width": loop_width,
        }  # fmt: skip
        self.table = MEMORY.table(sizes, self._arrays)

    def take(self, lane: int) -> None:
        """Keep the accelerations of candidate `lane`, as Workspace.take its states."""
        self._arrays["accelerations"][:] = self._arrays["trial_a"][:, lane]
