"""The terms of PenaltyCosts as kernels read them: one int64 table of sizes and addresses, and the arrays behind it.

What varies over the stages has them along its last axis, so that four knots are one load. Points are given in the
kernels' frames of their links and about the origins of their trees (see kernels.tree.model).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.numba.lanes import WIDTH, lane_array, padded
from planner.kernels.numba.layout import Layout
from planner.kernels.tree.model import chain_of

HEIGHT, DISTANCE, VELOCITY = 0, 1, 2  # kinds of terms
PARALLEL = 1e-12
"""Share of the squared lengths that keeps the nearest points of parallel lines in their middles."""
TINY = 1e-40  # added to squares before their root or a division by them: a distance of zero has no direction
TERM_SIZE = 7  # of a term's constants: normal (3), level, side, ramp and its inverse
POINT_SIZE = 4  # of a point's: its place in the link's frame (3), share
PLACE_SIZE = 9  # of a point where it is: about its tree's origin (3), as terms see it (3); how its link moves it (3)

PENALTY = Layout(
    "points terms stride rows ld moved fast",
    "links point_link point_address point_value world active kind ends term bound weight start dof places row "
    "gradient hessian",
)


class PenaltyTable:
    """The PenaltyArrays of a solve (problem.costs.penalty_measures) of a Model, and scratch for one evaluation."""

    def __init__(self, model: Any, measures: Any) -> None:
        m, parent, link = measures, model.arrays["parent"], np.array(measures.link)
        T, stages = m.weight.shape
        fast = m.kind == VELOCITY
        rows = 2 * model.nv if fast.any() else model.nv  # of positions, and of velocities where these count
        stride, ld = padded(stages), padded(rows)
        carried = link >= 0
        frames = (
            np.linalg.inv(model.own_frames[link]) if len(model.own_frames) else np.tile(np.eye(4), (len(link), 1, 1))
        )
        own = np.einsum("pij,pj->pi", frames[:, :3, :3], m.offset) + frames[:, :3, 3]
        at_rest = np.where(carried[:, None], model.origin[link], m.offset)
        world = m.world + (m.share[:, None] * at_rest)[:, None]
        chains = [chain_of(parent, i) for i in link]
        dofs = [sorted(set().union(*(chains[p] for p in set(ends.tolist())))) for ends in m.ends]
        dofs = [one + [model.nv + i for i in one] if quick else one for one, quick in zip(dofs, fast, strict=True)]
        arrays = {
            "links": np.array(sorted(set().union(*chains)), dtype=np.int64), "point_link": link,
            "point_address": np.where(carried, model.floating_address[link], -1),
            "point_value": np.column_stack([own, m.share]),
            "world": _along_stages(np.swapaxes(world, 1, 2), stride),
            "active": _along_stages(np.any(m.weight > 0.0, axis=0).astype(float), stride),
            "kind": m.kind, "ends": m.ends,
            "term": np.column_stack([m.normal, m.level, m.side, m.ramp, 1.0 / m.ramp]),
            "bound": _along_stages(m.bound, stride), "weight": _along_stages(m.weight, stride),
            "start": np.cumsum([0, *(len(one) for one in dofs)]),
            "dof": np.array([dof for one in dofs for dof in one], dtype=np.int64),
            "places": lane_array(PLACE_SIZE * len(link), WIDTH), "row": lane_array(rows, WIDTH),
            "gradient": lane_array(rows, WIDTH), "hessian": lane_array(rows * ld, WIDTH),
        }  # fmt: skip
        self._arrays = {
            name: np.ascontiguousarray(arrays[name]) for name in PENALTY.arrays
        }  # keeps the addresses alive
        self.rows = rows
        sizes = {
            "points": len(link), "terms": T, "stride": stride, "rows": rows, "ld": ld, "moved": len(arrays["links"]),
            "fast": fast.any(),
        }  # fmt: skip
        self.table = PENALTY.table(sizes, self._arrays)


def _along_stages(values: np.ndarray, stride: int) -> np.ndarray:
    """(..., N+1) with zeros up to the stride."""
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, stride - values.shape[-1])])
