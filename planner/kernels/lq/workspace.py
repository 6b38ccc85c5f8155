"""The memory of one solve, allocated once: nothing is allocated inside iterations.

Kernels see one int64 table: sizes, then addresses (see `lanes`). Here each array has its name and shape. Rows and
columns of matrices are ordered z = (u | x), x in deviations, each padded to whole lanes: x begins at column `first`,
and a row has `width` columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import WIDTH, floats, lane_array, load, neighbors, padded, store
from planner.kernels.numba.layout import Layout

# Outcomes of one iteration
ACCEPTED, CONVERGED, INDEFINITE, NO_STEP = 0, 1, 2, 3

W = Layout(
    "N nx ndx nu width first structured vectors quaternions stage_terms stage_plain final_terms final_plain "
    "control_terms bounded stage_penalties penalties exact residual_columns servos has_defects outputs hessian_rows",
    "xs us x_ref u_ref vector_x vector_dx quaternion_x quaternion_dx ball stage_row stage_column stage_value "
    "final_row final_column final_value control_row control_column control_value error turn l F transport K k dus "
    "gradient H G S h costate dx trial_x trial_u deviations lower upper box penalty_dx penalty_lower penalty_upper "
    "penalty_weight penalty_active T costates residual_hessian residual_active range_lower range_upper servo_control "
    "servo_start servo_x servo_dx servo_at_start servo_at_end servo_low servo_high lower_share upper_share defects "
    "values dxs active_bounds active_row active_gradient penalty_e penalty_side rows",
)
_K = W.K
# Rows of the line search's array: step lengths, costs, slopes, the bracket, and what it is given: cost, slope, dt.
ALPHA, COSTS, SLOPES, BRACKET, GIVEN = range(5)


class Workspace:
    """Arrays of one solve, and the table that kernels take.

    Args:
        cost: A TrackingCost: Q (N+1, ndx, ndx), R (N, nu, nu), x_ref (N+1, nx), u_ref (N, nu).
        space: A StateSpace.
        structured: F holds accelerations only, (N, nv, width), for semi-implicit Euler: x+ = E (x + [0; dt F z]),
            where E adds dt times the velocity to the position. Else F = (B | A), (N, ndx, width).
        bounds: Lower and upper bounds of the controls, (N, nu) each; None for none.
        penalties: The components of deviations that have ranges (see quadratic), those of the end alone last, and how
            many those are.
        servos: A planner.problem.control_bounds.Servos, or None.
        outputs: How many of the last components of x only costs see: no later state depends on them, and a weight of
            one is on no other. The sweep of a dense F leaves their zeros out. A structured one has the rates of the
            last accelerations, x = (q, v, a, r), whose rows are not in F (see kernels.lq.stage_hessian).

    Attributes:
        table: The argument of kernels.
        search: (5, 4) the line search's arrays, by rows.
        given: The row of it that holds the cost and its slope at step length 0, and the length of a stage.
        xs: (N+1, nx).
        us: (N, nu).
        K: (N, nu, width) with the gains in the columns of x, from `first` on.
        k: (N, nu).
        dus: (N, nu) the LQ problem's own controls.
        gradient: (N, nu) of Eq. 19.
        F: (N, rows, width).
        transport: (N, quaternions, 18) T and J of E for each quaternion.
        l: (N+1, width) gradients of the stage costs.
        first: The first column of x.
        penalty_lower: (N+1, penalties) of the deviation from x_ref.
        penalty_upper: (N+1, penalties).
        penalty_weight: (N+1, penalties) zero until a solve sets them.
        T: (N+1, width, width) the second-order terms of the dynamics, upper triangles, zero at the end, and what
            rows of constraints add (solvers.engine.constrained_engine); empty until they are asked for.
        costates: (N+1, width) with Eq. 16 in the columns of x, from `first` on; empty until then.
        state_regularization: (N+1, width, width) what the sweep adds in place of T (see use_second_order).
        defects: (N, ndx) from the start of each stage's successor to its end; empty until asked for.
        values: (N, ndx, ndx+1) the value function (P | s) of the end of each stage, kept by a sweep across defects.
        dxs: (N+1, ndx) the deviations of the direction across defects.
        rows: (N, rows, width) whose squares are in the Hessians of the stages, from terms that are not of a state
            alone (see kernels.tree.residuals.motor_work).
        residuals: A kernels.tree.residuals.table.ResidualTable, or None.
        lower: (N, nu) bounds of the controls; those of servos at the nominal states.
        upper: (N, nu).
        lower_share: (N, nu, 2) the parts of a servo's two lines that bound it at the nominal states, 0 for numbers.
        upper_share: (N, nu, 2).
        active_bounds: (N, nu) the controls that a sweep with a chosen set holds, at the lower bound -1, at the upper
        one 1.
    """

    def __init__(
        self, cost: Any, space: Any, structured: bool, bounds: tuple[np.ndarray, np.ndarray] | None = None,
        penalties: tuple[np.ndarray, int] | None = None, servos: Any = None, outputs: int = 0,
    ) -> None:  # fmt: skip
        Q, R = cost.Q, cost.R
        N, nu = R.shape[:2]
        nx, ndx = space.nx, space.ndx
        self.ndx = ndx
        self.first = padded(nu)
        width = self.first + padded(ndx)
        quaternions = np.array(space.quaternions, dtype=np.int64).reshape(-1, 2)
        in_x, in_dx = np.ones(nx, dtype=bool), np.ones(ndx, dtype=bool)
        ball = np.full(ndx, -1)
        for number, (i, j) in enumerate(quaternions):
            in_x[i : i + 4], in_dx[j : j + 3], ball[j : j + 3] = False, False, number
        stage, final, control = _terms(Q[:-1], ball), _terms(Q[-1:], ball), _terms(R, np.full(nu, -1))
        states = ndx // 2 - outputs if structured else ndx
        self.xs, self.us, self.K = np.zeros((N + 1, nx)), np.zeros((N, nu)), lane_array(N, nu, width)
        self.search = lane_array(GIVEN + 1, WIDTH)
        self.given = self.search[GIVEN]
        slack = WIDTH  # rows are read four at a time, past their ends
        F, l = lane_array(N * states * width + slack), lane_array((N + 1) * width + slack)
        self.F, self.l = F[:-slack].reshape(N, states, width), l[:-slack].reshape(N + 1, width)
        self.k, self.dus, self.gradient = (np.zeros((N, nu)) for _ in range(3))
        self.transport = np.zeros((N, len(quaternions), 18))
        lower, upper = (np.empty((0, nu)), np.empty((0, nu))) if bounds is None else bounds
        self.lower, self.upper = (lower, upper) if servos is None else (lower.copy(), upper.copy())
        shares = (N, nu, 2) if servos is not None else (0, nu, 2)
        self.lower_share, self.upper_share = np.zeros(shares), np.zeros(shares)
        penalty_dx, at_end = (np.empty(0, dtype=np.int64), 0) if penalties is None else penalties
        self.penalty_lower, self.penalty_upper, self.penalty_weight, active = (
            np.zeros((N + 1, len(penalty_dx))) for _ in range(4)
        )
        self._arrays: dict[str, np.ndarray] = {
            "xs": self.xs, "us": self.us, "x_ref": cost.x_ref.copy(), "u_ref": cost.u_ref.copy(),
            "vector_x": np.flatnonzero(in_x), "vector_dx": np.flatnonzero(in_dx),
            "quaternion_x": quaternions[:, 0].copy(), "quaternion_dx": quaternions[:, 1].copy(), "ball": ball,
            "stage_row": stage[0], "stage_column": stage[1], "stage_value": stage[2],
            "final_row": final[0], "final_column": final[1], "final_value": final[2],
            "control_row": control[0], "control_column": control[1], "control_value": control[2],
            "error": np.zeros(max(nu, ndx)), "turn": np.zeros(((N + 1), len(quaternions), 9)),
            "l": l, "F": F,
            "transport": self.transport, "K": self.K, "k": self.k,
            "dus": self.dus, "gradient": self.gradient, "dx": np.zeros((3, ndx)),
            **neighbors(
                H=width * width + slack, G=(padded(ndx) + WIDTH) * width + slack,
                S=(width + 2 * WIDTH) * (padded(ndx) + WIDTH) + slack, h=3 * width + slack, costate=3 * width + slack,
            ),
            "trial_x": lane_array((N + 1) * nx, WIDTH),
            "trial_u": lane_array(N * nu, WIDTH), "deviations": lane_array(2 * ndx + nu + 8, WIDTH),
            "lower": self.lower, "upper": self.upper, "box": np.zeros(nu * (nu + 6)),
            "penalty_dx": np.array(penalty_dx, dtype=np.int64), "penalty_lower": self.penalty_lower,
            "penalty_upper": self.penalty_upper, "penalty_weight": self.penalty_weight, "penalty_active": active,
            "penalty_e": np.zeros_like(active), "penalty_side": np.zeros_like(active),
        }  # fmt: skip
        self.active_bounds = np.zeros_like(lower)
        rows = 0 if bounds is None else N * nu * width
        self._arrays |= {
            "active_bounds": self.active_bounds,
            "active_row": np.zeros(rows),
            "active_gradient": np.zeros_like(lower),
        }
        self._arrays |= {"range_lower": lower, "range_upper": upper, **_servo_arrays(servos)}
        self._arrays |= {"lower_share": self.lower_share, "upper_share": self.upper_share}
        self.T, self.costates = np.zeros((0, width, width)), np.zeros((0, width))
        self._arrays |= {"T": self.T, "costates": self.costates, "residual_hessian": np.zeros(0)}
        self._arrays |= {"residual_active": np.zeros(0), "rows": np.zeros(0)}
        self.state_regularization = self.T
        self.defects, self.values, self.dxs = np.zeros((0, ndx)), np.zeros((0, ndx, ndx + 1)), np.zeros((0, ndx))
        self._arrays |= {"defects": self.defects, "values": self.values, "dxs": self.dxs}
        self.residuals: Any = None
        self.rows = np.zeros((N, 0, width))
        sizes = {
            "N": N, "nx": nx, "ndx": ndx, "nu": nu, "width": width, "first": self.first, "structured": structured,
            "vectors": in_x.sum(), "quaternions": len(quaternions), "stage_terms": len(stage[0]),
            "stage_plain": stage[3], "final_terms": len(final[0]), "final_plain": final[3],
            "control_terms": len(control[0]), "bounded": bounds is not None, "stage_penalties": len(penalty_dx) -
            at_end,
            "penalties": len(penalty_dx), "exact": False, "residual_columns": 0,
            "servos": 0 if servos is None else len(servos.control), "has_defects": False,
            "outputs": outputs, "hessian_rows": 0,
        }  # fmt: skip
        self._arrays = {name: np.ascontiguousarray(array) for name, array in self._arrays.items()}  # keeps all alive
        self.table = W.table(sizes, self._arrays)

    def trial(self, lane: int) -> tuple[np.ndarray, np.ndarray]:
        """States (N+1, nx) and controls (N, nu) of candidate `lane`."""
        xs, us = self._arrays["trial_x"][:, lane], self._arrays["trial_u"][:, lane]
        return xs.reshape(self.xs.shape), us.reshape(self.us.shape)

    def take(self, lane: int) -> None:
        """Make candidate `lane` the nominal trajectory."""
        self.xs[:], self.us[:] = self.trial(lane)

    def use_gains(self, K: np.ndarray, address: int) -> None:
        """Have kernels read and write the gains in another array like K, at this address."""
        self.K, self.table[_K] = K, address

    def use_second_order(self, exact: bool, held: bool = False) -> None:
        """Whether the sweep adds T or, with `held`, `held` in its place. Memory is taken when it is first asked for."""
        N, width = len(self.us), self.T.shape[1]
        if exact and not len(self.T):
            rows = lane_array((N + 1) * width + WIDTH)  # read four at a time, past their ends
            self.T, self.costates = lane_array(N + 1, width, width), rows[:-WIDTH].reshape(N + 1, width)
            self._arrays |= {"T": self.T, "costates": self.costates}
            self.table[W.costates] = self.costates.ctypes.data
        if held and not len(self.state_regularization):
            self._arrays["state_regularization"] = self.state_regularization = lane_array(N + 1, width, width)
        self.table[W.exact] = exact or held
        self.table[W.T] = (self.state_regularization if held else self.T).ctypes.data

    def use_defects(self, has_defects: bool) -> None:
        """Whether the sweep and its direction have defects; their memory is taken when it is first asked for."""
        self.table[W.has_defects] = has_defects
        if has_defects and not len(self.defects):
            N, ndx = len(self.us), self.ndx
            self.defects, self.values, self.dxs = (
                np.zeros((N, ndx)),
                np.zeros((N, ndx, ndx + 1)),
                np.zeros((N + 1, ndx)),
            )
            self._arrays |= {"defects": self.defects, "values": self.values, "dxs": self.dxs}
            self.table[[W.defects, W.values, W.dxs]] = [
                array.ctypes.data for array in (self.defects, self.values, self.dxs)
            ]

    def use_residuals(self, residuals: Any) -> None:
        """Have the terms of a ResidualTable in every sweep and rollout."""
        self.residuals = residuals
        self.table[W.residual_columns] = residuals.columns
        self.table[W.residual_hessian] = residuals.hessian.ctypes.data
        self.table[W.residual_active] = residuals.active.ctypes.data
        if residuals.works:
            (N, nu), width = self.us.shape, self.l.shape[1]
            rows = lane_array(N * nu * width + WIDTH)  # read four at a time, past their ends
            self.rows, self._arrays["rows"] = rows[:-WIDTH].reshape(N, nu, width), rows
            self.table[W.hessian_rows], self.table[W.rows] = nu, rows.ctypes.data


def _servo_arrays(servos: Any) -> dict[str, np.ndarray]:
    """The lines that bound servos, as lists of their entries; a servo's begin at servo_start."""
    if servos is None:
        empty = {name: np.empty(0) for name in ("servo_at_start", "servo_at_end", "servo_low", "servo_high")}
        return empty | {f"servo_{name}": np.empty(0, dtype=np.int64) for name in ("control", "start", "x", "dx")}
    servo, entry = np.nonzero((servos.now != 0.0) | (servos.late != 0.0))
    return {
        "servo_control": np.array(servos.control, dtype=np.int64),
        "servo_start": np.searchsorted(servo, np.arange(len(servos.control) + 1)),
        "servo_x": servos.in_x[entry], "servo_dx": servos.in_dx[entry], "servo_at_start": servos.now[servo, entry],
        "servo_at_end": servos.late[servo, entry], "servo_low": servos.low, "servo_high": servos.high,
    }  # fmt: skip


def _terms(weights: np.ndarray, ball: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The upper entries of symmetric weights that are not always zero: row, column, value (stages, terms).

    Those that touch no rotation come first; how many they are is the last of what is returned.
    """
    row, column = np.nonzero(np.triu(np.any(weights != 0.0, axis=0)))
    turned = (ball[row] >= 0) | (ball[column] >= 0)
    order = np.argsort(turned, kind="stable")
    row, column = row[order], column[order]
    return row, column, weights[:, row, column], int(np.sum(~turned))


@inline
def accept(w, lane):
    """Make candidate `lane` the nominal trajectory."""
    take_lane(floats(w, W.xs), floats(w, W.trial_x), w[W.nx] * (w[W.N] + 1), lane)
    take_lane(floats(w, W.us), floats(w, W.trial_u), w[W.nu] * w[W.N], lane)


@inline
def take_lane(to, candidates, count, lane):
    """Copy one lane of `count` entries of four."""
    for i in range(count):
        store(to, i, load(candidates, i * WIDTH + lane))
