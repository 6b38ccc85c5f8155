"""Scratch memory of the tree kernels on lanes, and the accelerations that linearisation takes from rollouts."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.lanes import WIDTH, lane_array, padded
from planner.kernels.tree import RECORD

EULER, SEMI_IMPLICIT_EULER, RK4 = 0, 1, 2  # as planner.dynamics.INTEGRATORS

_SIZES = ("integrator", "stages", "ld", "columns", "first")
_ARRAYS = (
    "links", "x", "u", "tau", "scratch", "rates", "theta", "q_stage", "v_stages", "act_stage", "act_rates", "a",
    "trial_a", "accelerations", "M", "Dq", "Dv", "held", "direct", "chained", "Xq", "Xv", "Xa", "sum_q", "sum_v", "row",
)  # fmt: skip
INTEGRATOR, STAGES, LD, COLUMNS, FIRST_X = range(5)
(
    LINKS, X_LANES, U_LANES, TAU, SCRATCH, RATES, THETA, Q_STAGE, V_STAGES, ACT_STAGE, ACT_RATES, A_LANES,
    TRIAL_A, ACCELERATIONS, M_LANES, DQ, DV, HELD, DIRECT, CHAINED, XQ, XV, XA, SUM_Q, SUM_V, ROW,
) = range(5, 31)  # fmt: skip


class TreeMemory:
    """Arrays for a model and N stages.

    Args:
        model: A kernels.model.Model.
        integrator: EULER, SEMI_IMPLICIT_EULER or RK4.
        N: Stages whose accelerations are kept; 0 for single calls.
        linearizing: Whether derivatives will be asked for.
    """

    def __init__(self, model: Any, integrator: int, N: int, linearizing: bool = True) -> None:
        nv, nq, nu, na = model.nv, model.nq, model.nu, model.na
        stages = 4 if integrator == RK4 else 1
        ld, first = padded(nv), padded(nu)
        columns = first + padded(2 * nv + na) + WIDTH  # products are written four columns at a time
        n = nv if linearizing else 0
        chain = n if integrator == RK4 else 0
        lanes = {
            "links": max(nv * RECORD, 2 * nv + nq + na), "x": nq + nv + na, "u": nu, "tau": nv, "scratch": 16,
            "rates": na, "theta": nv,
            "q_stage": nq, "v_stages": 4 * nv, "act_stage": na, "act_rates": 4 * na, "a": stages * nv,
            "trial_a": N * stages * nv, "M": n * ld, "Dq": n * ld, "Dv": n * ld, "held": n * nu, "direct": n * columns,
            "chained": n * columns, "Xq": chain * columns, "Xv": chain * columns, "Xa": 4 * na,
            "sum_q": n * columns, "sum_v": n * columns, "row": columns,
        }  # fmt: skip
        self._arrays = {name: lane_array(count + 1, WIDTH) for name, count in lanes.items()}
        self._arrays["accelerations"] = np.zeros(N * stages * nv + 1)
        sizes = (integrator, stages, ld, columns, first)
        self.table = np.array([*sizes, *(self._arrays[name].ctypes.data for name in _ARRAYS)], dtype=np.int64)
