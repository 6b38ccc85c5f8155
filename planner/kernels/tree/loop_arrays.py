"""The arrays of a tree's closed chains, as kernels read them.

Rows of J come in threes: positions, rotations, and the row of a coupling with two rows of zeros behind it, which no
pivot of J W J' lets through. So products and eliminations work on blocks of 3 x 3, which stay in registers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.numba.lanes import WIDTH
from planner.model.couplings import Reduction, baumgarte_rate
from planner.model.mechanism import Mechanism

JOINED_SIZE = 15  # of one of two frames that are joined: its place (3), its tree's origin (3), its three axes
COUPLING_SIZE = 7  # offsets of follower and leader, and five coefficients


def loop_arrays(
    loops: Any, couplings: Any, chains: list[set[int]], mechanism: Mechanism, tree: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Frames and couplings (JOINED_SIZE, COUPLING_SIZE), and where the rows are not zero.

    `chains` has the dofs that move either frame of each loop, `tree` the kernels' frames.
    """
    link = np.array([link for loop in loops for link in loop.links], dtype=np.int64)
    value = np.zeros((len(link), JOINED_SIZE))
    for row, i, T in zip(value, link, [T for loop in loops for T in loop.frames], strict=True):
        own = np.linalg.inv(tree["frames"][i]) @ T if i >= 0 else T
        row[:3], row[6:] = own[:3, 3], own[:3, :3].T.ravel()
        if i >= 0:
            row[3:6] = tree["origin"][i]
    return {
        "joined_link": link, "joined_value": value,
        "joined_address": np.where(link >= 0, tree["floating_address"][link], -1) if len(link) else link,
        "loop_rigid": np.array([loop.rigid for loop in loops], dtype=np.int64), "loop_rate":
        np.array([baumgarte_rate()]),
        "coupling_dof": np.array([(one.follower, one.leader) for one in couplings], dtype=np.int64),
        "coupling_value": np.array([(*one.offsets, *one.coefficients) for one in couplings], dtype=float),
        **_triples(loops, couplings, chains, mechanism),
    }  # fmt: skip


def triples_of(loops: Any, couplings: Any) -> int:
    """How many threes of rows there are."""
    return sum(loop.rows // 3 for loop in loops) + len(couplings)


def _triples(loops: Any, couplings: Any, chains: list[set[int]], mechanism: Mechanism) -> dict[str, np.ndarray]:
    """Where three rows of J are not zero, and the blocks of dofs between which the mass matrix is.

    Per triple its kind (0 positions, 1 rotations, 2 couplings), its dofs with those that coupled dofs follow (moved),
    and those of their blocks, which a force along it accelerates (reach); per pair of triples the dofs where the reach
    of the one meets what the other moves; per four columns of J the rows that are not zero there; per dof its block.
    """
    nv, kinds, moved = mechanism.nv, list[int](), list[list[int]]()
    for loop, chain in zip(loops, chains, strict=True):
        kinds += [0, 1][: loop.rows // 3]
        moved += [_followed(chain, mechanism.reduction)] * (loop.rows // 3)
    for coupling in couplings:
        kinds.append(2)
        moved.append(_followed(set(coupling.dofs), mechanism.reduction))
    start, stop = _blocks(mechanism) if kinds else (np.zeros(nv, dtype=np.int64), np.full(nv, nv))
    reached = [np.flatnonzero(np.isin(stop, stop[dofs])) for dofs in moved]
    shared = [np.intersect1d(reached[k], moved[l]) for k in range(len(kinds)) for l in range(k + 1)]
    nonzero = np.zeros((3 * len(kinds), nv), dtype=bool)
    for k, dofs in enumerate(moved):
        nonzero[3 * k : 3 * k + (1 if kinds[k] == 2 else 3), dofs] = True
    bound = [np.flatnonzero(nonzero[:, j : j + WIDTH].any(axis=1)) for j in range(0, nv, WIDTH)]
    return {
        "triple_kind": np.array(kinds, dtype=np.int64), **_lists("moved", "dof", moved),
        **_lists("reach", "dof", reached), **_lists("shared", "dof", shared), **_lists("bound", "rows", bound),
        "block_start": start, "block_stop": stop,
    }  # fmt: skip


def _followed(dofs: set[int], reduction: Reduction | None) -> list[int]:
    """The dofs, and those that coupled ones among them follow."""
    if reduction is None:
        return sorted(dofs)
    return sorted({*dofs, *(int(reduction.independent[c]) for c in np.nonzero(reduction.G[sorted(dofs)])[1])})


def _lists(name: str, of: str, parts: Any) -> dict[str, np.ndarray]:
    """Lists behind each other, and where each of them starts."""
    return {
        f"{name}_start": np.cumsum([0, *(len(part) for part in parts)], dtype=np.int64),
        f"{name}_{of}": np.array([i for part in parts for i in part], dtype=np.int64),
    }


def _blocks(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
    """(nv,) where the block of each dof starts and ends: of its tree, and of all between trees that are coupled."""
    nv, first = mechanism.nv, np.arange(mechanism.nv)
    furthest = first.copy()
    for i, parent in enumerate(mechanism.parent):
        first[i] = i if parent < 0 else first[parent]
        furthest[first[i]] = i
    for coupling in mechanism.couplings:
        begin = min(first[list(coupling.dofs)])
        furthest[begin] = max(furthest[begin], *coupling.dofs)
    starts, stops, begin = np.empty(nv, dtype=np.int64), np.empty(nv, dtype=np.int64), 0
    while begin < nv:
        i, last = begin, begin
        while i <= last:
            last, i = max(last, int(furthest[i])), i + 1
        starts[begin:i], stops[begin:i] = begin, i
        begin = i
    return starts, stops
