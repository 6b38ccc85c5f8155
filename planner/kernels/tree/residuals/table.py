"""The residuals of a solve as kernels read them: one int64 table of sizes and addresses, and the arrays behind it.

A term has a kind, up to four points, some constants, references per stage, and up to six rows. Each row is compared
with a bound (or target) per stage, one-sided or not, and weighed per stage. What varies over the stages has them along
its last axis, so that four knots are one load. Points and frames are given in the kernels' frames of their links and
about the origins of their trees (see kernels.tree.mechanism_table).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.numba.lanes import WIDTH, lane_array, padded
from planner.kernels.tree.mechanism_table import chain_of
from planner.kernels.tree.residuals.kinds import DISTANCE, FAST, KINDS, MASS_CENTRE, SOLIDS
from planner.kernels.tree.residuals.layout import KEPT_SIZE, MAX_ROWS, PLACE_SIZE, RATE_SIZE, RESIDUALS, TURN_SIZE
from planner.kernels.tree.residuals.solids import FIRST_AXES, SECOND_AXES


class ResidualTable:
    """The ResidualArrays of a solve (problem.costs.residual_arrays) of a Model, and scratch for one evaluation.

    Bounds and weights may change between iterations of a solve; `changed` says so to the kernels.

    Attributes:
        bound: (M, N+1) of each row, a view of what the kernels read.
        weight: (M, N+1), likewise.
        columns: Of a row's derivative: nv, or 2 nv where velocities count.
        hessian: (N+1, columns, ld) upper triangles, as the last quadratization left them.
        bends: (N+1, columns, ld) upper triangles of the second derivatives of the rows that `bend` names, weighted by
            the gradient of the cost, which the Hessians do not have; empty for none.
        works: How many costs of the motors' work there are.
        solids: True where some terms are of two solids, else None: the kernels then do without their code.
    """

    def __init__(self, model: Any, measures: Any) -> None:
        m, parent, link, nv = measures, model.arrays["parent"], np.array(measures.link), model.nv
        stages, T = m.weight.shape[1], len(m.kind)
        fast = np.isin(m.kind, FAST)
        massive = bool(np.any(m.kind == MASS_CENTRE))
        columns = 2 * nv if fast.any() else nv  # of positions, and of velocities where these count
        stride, ld = padded(stages), padded(columns)
        carried = link >= 0
        own, world = _own_points(model, m, link, carried)
        chains = [chain_of(parent, i) for i in link]
        dofs = [_dofs(m.kind[t], m.ends[t], chains, nv) for t in range(T)]
        links = range(nv) if massive else sorted(set().union(*chains))
        arrays = {
            "links": np.array(links, dtype=np.int64), "point_link": link,
            "point_address": np.where(carried, model.floating_address[link], -1),
            "point_value": np.column_stack([own, m.share]),
            "world": _along_stages(np.swapaxes(world, 1, 2), stride),
            "kind": m.kind, "ends": m.ends, "first_row": m.first_row, "constant": _own_constants(model, m, link),
            "first_reference": m.first_reference, "reference": _along_stages(m.reference, stride),
            "bound": _along_stages(m.bound, stride), "weight": _along_stages(m.weight, stride),
            "active": np.zeros(stride), "on": np.zeros((T, stride)),
            "law": np.column_stack([m.side, m.ramp, _inverse(m.ramp)]),
            "start": np.cumsum([0, *(len(one) for one in dofs)]),
            "dof": np.array([dof for one in dofs for dof in one], dtype=np.int64),
            "tree_address": np.where(parent[:nv] < 0, model.floating_address, -1),
            "places": lane_array(PLACE_SIZE * len(link), WIDTH), "value": lane_array(MAX_ROWS, WIDTH),
            "kept": lane_array(KEPT_SIZE, WIDTH), "row": lane_array(MAX_ROWS * columns, WIDTH),
            "factor": lane_array(MAX_ROWS, WIDTH), "curvature": lane_array(MAX_ROWS, WIDTH),
            "scaled": lane_array(MAX_ROWS, WIDTH), "moments": lane_array(3 * nv if massive else 1, WIDTH),
            "gradient": lane_array(columns, WIDTH), "hessian": lane_array(columns * ld, WIDTH),
            "side": np.array([side for t, of in enumerate(dofs) for side in _sides(m.kind[t], m.ends[t], chains, of)]),
            "rates": lane_array(RATE_SIZE * nv, WIDTH), "bent": np.zeros(max(T, 1), dtype=np.int64),
            "bend": lane_array(columns * ld, WIDTH), "bends": np.zeros(0), "work": m.work,
            "way": lane_array(nv, WIDTH), "turns": lane_array(TURN_SIZE * len(model.arrays["ball_v"]), WIDTH),
            "work_slopes": lane_array(2 * (2 * nv + model.na) + model.nu + 3, WIDTH), "through": np.zeros(nv),
        }  # fmt: skip
        # contiguous, and kept alive: the kernels have their addresses
        self._arrays = {name: np.ascontiguousarray(arrays[name]) for name in RESIDUALS.arrays}
        self.columns, self._first_row = columns, np.array(m.first_row)
        self.works = len(m.work)
        self.solids = True if np.isin(m.kind, SOLIDS).any() else None
        self.bound, self.weight = (self._arrays[name][:, :stages] for name in ("bound", "weight"))
        self.active = self._arrays["active"]
        self.hessian, self.bends = lane_array(stages, columns, ld), np.zeros((0, columns, ld))
        sizes = {
            "points": len(link), "terms": T, "stride": stride, "constants": self._arrays["constant"].shape[1],
            "columns": columns, "ld": ld, "moved": len(arrays["links"]), "fast": fast.any(), "massive": massive,
            "bending": 0, "works": len(m.work),
        }  # fmt: skip
        self.table = RESIDUALS.table(sizes, self._arrays)
        self.changed()

    def bend(self, rows: slice) -> None:
        """Have `bends` of the terms of these rows, all of which are distances."""
        bent = self._arrays["bent"]
        bent[: len(self._first_row) - 1] |= (self._first_row[:-1] >= rows.start) & (self._first_row[:-1] < rows.stop)
        if not len(self.bends):
            self.bends, self.solids = lane_array(*self.hessian.shape), True  # their code is with that of solids
            self.table[RESIDUALS.bends], self.table[RESIDUALS.bending] = self.bends.ctypes.data, 1

    def changed(self) -> None:
        """Note which terms weigh something at which stage, after weights have been changed."""
        on, stages = self._arrays["on"], self.weight.shape[1]
        for t, row in enumerate(on):
            row[:stages] = np.any(self.weight[self._first_row[t] : self._first_row[t + 1]] > 0.0, axis=0)
        self.active[:] = np.any(on > 0.0, axis=0)
        self.hessian[:] = self.bends[:] = 0.0  # what is no longer active must not stay


def _own_points(model: Any, m: Any, link: np.ndarray, carried: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) in the kernels' frames, and what is added to them in the world (P, N+1, 3)."""
    frames = _inverse_frames(model, link)
    own = np.einsum("pij,pj->pi", frames[:, :3, :3], m.offset) + frames[:, :3, 3]
    at_rest = np.where(carried[:, None], model.origin[link], m.offset)
    return own, m.world + (m.share[:, None] * at_rest)[:, None]


def _inverse_frames(model: Any, link: np.ndarray) -> np.ndarray:
    """From each link's frame to the kernels' (P, 4, 4)."""
    if not len(model.own_frames):
        return np.tile(np.eye(4), (len(link), 1, 1))
    return np.where((link >= 0)[:, None, None], np.linalg.inv(model.own_frames[link]), np.eye(4))


def _own_constants(model: Any, m: Any, link: np.ndarray) -> np.ndarray:
    """Constants of the terms, with rotations and axes of frames in the kernels' frames."""
    constant, frames = np.array(m.constant), _inverse_frames(model, link)[:, :3, :3]
    for t, (kind, ends) in enumerate(zip(m.kind, m.ends, strict=True)):
        turn = frames[ends[0]] if 0 <= ends[0] < len(frames) else np.eye(3)  # one without points has none
        turned = KINDS[int(kind)].turned
        if turned:
            constant[t, :turned] = (turn @ constant[t, :turned].reshape(3, -1)).ravel()
        if kind == MASS_CENTRE:  # where the trees that do not float stand, and the inverse of the mass
            roots = np.flatnonzero((model.arrays["parent"][: model.nv] < 0) & (model.floating_address < 0))
            mass = model.arrays["subtree_mass"]
            total = mass[np.flatnonzero(model.arrays["parent"][: model.nv] < 0)].sum()
            constant[t, :3], constant[t, 3] = mass[roots] @ model.origin[roots] / total, 1.0 / total
        elif kind in SOLIDS:
            for end, first in zip(ends[:2], (FIRST_AXES, SECOND_AXES), strict=True):
                axes = constant[t, first : first + 9].reshape(3, 3)
                constant[t, first : first + 9] = (frames[end] @ axes).ravel()
    return constant


def _dofs(kind: int, ends: np.ndarray, chains: list[list[int]], nv: int) -> list[int]:
    """The columns of a term's derivative that are not zero, in order."""
    if kind == MASS_CENTRE:
        return list(range(nv))
    dofs = sorted(set().union(*(chains[p] for p in set(ends.tolist()))))
    return dofs + [nv + i for i in dofs] if kind in FAST else dofs


def _sides(kind: int, ends: np.ndarray, chains: list[list[int]], dofs: list[int]) -> np.ndarray:
    """Of a distance: 1 for dofs that move its first shape alone, -1 for those of the second; else zeros."""
    if kind != DISTANCE and kind not in SOLIDS:
        return np.zeros(len(dofs))
    first, second = chains[ends[0]], chains[ends[2 if kind == DISTANCE else 1]]
    return np.isin(dofs, first).astype(float) - np.isin(dofs, second)


def _inverse(ramp: np.ndarray) -> np.ndarray:
    """1 / ramp, so large for none that any error is beyond its end."""
    return 1.0 / np.where(ramp > 0.0, ramp, 1e-300)


def _along_stages(values: np.ndarray, stride: int) -> np.ndarray:
    """(..., N+1) with zeros up to the stride, and at least one row."""
    padding = [(0, 0)] * (values.ndim - 1) + [(0, stride - values.shape[-1])]
    return np.pad(values, padding) if values.size else np.zeros((1, stride))
