"""A mechanism as kernels read it: one int64 table of sizes and addresses, and the arrays behind it.

The exponential of a screw is spelled out once, for revolute, prismatic and helical joints alike: with H the 4x4 matrix
of S, |w| = 1 or w = 0,

    T_home exp(S q) = C0 + sin(q) Cs + (1 - cos(q)) Cc + q Ct,
    C0 = T_home, Cs = -T_home H^3, Cc = T_home H^2, Ct = T_home (H + H^3),

three rows of rotation and one of translation each, with q_home already taken out. Each tree is described about an
origin of its own, the first joint's place at home or, for a floating tree, wherever it is: dynamics do not depend on
where a tree stands, but rounding does.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.lanes import WIDTH

SCREW, BALL, BALL_NEXT, FLOATING = 0, 1, 2, 3  # as in planner.mechanism, and a slide that moves a whole tree

# What the table holds: sizes first, then addresses.
_SIZES = ("nv", "nq", "nballs", "nu", "na", "inputs", "position_terms", "velocity_terms")
_ARRAYS = (
    "parent", "base", "kind", "first", "q_address", "C", "S", "inertia", "subtree_mass", "sliding", "armature",
    "base_acceleration", "damping", "stiffness", "rest", "ball_q", "ball_v", "ball_stiffness", "ball_rest", "constant",
    "input_dof", "input_index", "input_value", "position_row", "position_column", "position_value", "velocity_row",
    "velocity_column", "velocity_value", "activation_input", "activation_gain", "activation_rate", "prescribed",
    "related_start", "related_rows",
)  # fmt: skip
NV, NQ, NBALLS, NU, NA, INPUTS, POSITION_TERMS, VELOCITY_TERMS = range(len(_SIZES))
(
    PARENT, BASE, KIND, FIRST, Q_ADDRESS, C, S, INERTIA, SUBTREE_MASS, SLIDING, ARMATURE,
    BASE_ACCELERATION, DAMPING, STIFFNESS, REST, BALL_Q, BALL_V, BALL_STIFFNESS, BALL_REST, CONSTANT,
    INPUT_DOF, INPUT_INDEX, INPUT_VALUE, POSITION_ROW, POSITION_COLUMN, POSITION_VALUE, VELOCITY_ROW,
    VELOCITY_COLUMN, VELOCITY_VALUE, ACTIVATION_INPUT, ACTIVATION_GAIN, ACTIVATION_RATE, PRESCRIBED,
    RELATED_START, RELATED_ROWS,
) = range(len(_SIZES), len(_SIZES) + len(_ARRAYS))  # fmt: skip


class Model:
    """The arrays of a mechanism and the table of their addresses.

    Args:
        mechanism: A planner.Mechanism.
        prescribed: (nv,) True where the acceleration is an input instead of the force.
        actuated: Whether the actuators act; the public dynamics functions take applied forces instead.
    """

    def __init__(self, mechanism: Any, prescribed: np.ndarray | None = None, actuated: bool = True) -> None:
        nv = mechanism.nv
        prescribed = np.zeros(nv, dtype=bool) if prescribed is None else prescribed
        arrays: dict[str, np.ndarray] = {**_tree(mechanism), **_forces(mechanism, prescribed, actuated)}
        self.nv, self.nq = nv, mechanism.nq
        self.nu = (mechanism.nu if actuated else 0) + int(prescribed.sum())
        self.na = mechanism.na if actuated else 0
        coupled = np.zeros((nv, nv), dtype=bool)
        for name in ("position", "velocity"):
            coupled[arrays[f"{name}_row"], arrays[f"{name}_column"]] = True
        arrays["related_start"], arrays["related_rows"] = _related(mechanism.parent, coupled)
        sizes = {
            "nv": nv, "nq": mechanism.nq, "nballs": len(mechanism.quaternions), "nu": self.nu, "na": self.na,
            "inputs": len(arrays["input_dof"]), "position_terms": len(arrays["position_row"]),
            "velocity_terms": len(arrays["velocity_row"]),
        }  # fmt: skip
        self.arrays = {name: _plain(arrays[name]) for name in _ARRAYS}  # keeps the addresses alive
        addresses = [self.arrays[n].ctypes.data for n in _ARRAYS]
        self.table = np.array([*(sizes[n] for n in _SIZES), *addresses], dtype=np.int64)
        self.origin = arrays["origin"]  # (nv, 3) what world positions are relative to, but for floating trees
        self.floating = arrays["kind"] == FLOATING
        self.floating_address = arrays["floating_address"]  # (nv,) where qpos holds a floating tree's place, or -1


def _plain(array: np.ndarray) -> np.ndarray:
    kind = np.float64 if array.dtype.kind == "f" else np.int64
    result = np.array(array, dtype=kind, order="C").reshape(-1)
    return result if result.size else np.zeros(1, dtype=kind)


def _tree(mechanism: Any) -> dict[str, np.ndarray]:
    nv = mechanism.nv
    kind = np.array(mechanism.kind)
    first = np.arange(nv)
    for i in range(nv):
        if kind[i] == BALL_NEXT:
            first[i] = first[i - 1]
    for links in mechanism.joint_links:
        if links.stop - links.start == 6:  # a free joint
            kind[links.start : links.start + 3] = FLOATING
    roots = np.arange(nv)
    for i in range(nv):
        if mechanism.parent[i] >= 0:
            roots[i] = roots[mechanism.parent[i]]
    C = np.zeros((nv, 4, 12))
    for i in range(nv):
        for block, X in enumerate(_exponential(mechanism, i, kind[i])):
            C[i, block, :9], C[i, block, 9:] = X[:3, :3].ravel(), X[:3, 3]
    origin = np.zeros((nv, 3))
    for i in range(nv):
        if mechanism.parent[i] < 0 and kind[i] != FLOATING:
            origin[i] = C[i, 0, 9:]
            C[i, 0, 9:] = 0.0
        elif mechanism.parent[i] >= 0:
            origin[i] = origin[roots[i]]
    for address, i in mechanism.quaternions:
        S = mechanism.S[i : i + 3]  # (e_k, anchor x e_k)
        C[i, 1, 0:3] = [S[1, 5], S[2, 3], S[0, 4]]
        assert address == mechanism.q_address[i]
    subtree_mass = mechanism.mass.copy()
    for i in reversed(range(nv)):
        if mechanism.parent[i] >= 0:
            subtree_mass[mechanism.parent[i]] += subtree_mass[i]
    floating = np.where(kind[roots] == FLOATING, mechanism.q_address[roots], -1)
    balls = np.array(mechanism.quaternions, dtype=np.int64).reshape(-1, 2)
    return {
        "parent": mechanism.parent, "base": mechanism.base, "kind": kind, "first": first,
        "q_address": mechanism.q_address, "C": C, "S": mechanism.S, "inertia": _inertias(mechanism),
        "subtree_mass": subtree_mass, "sliding": np.any(C[:, 3] != 0.0, axis=1).astype(np.int64),
        "armature": mechanism.armature, "base_acceleration": -mechanism.gravity, "damping": mechanism.damping,
        "stiffness": mechanism.stiffness, "rest": mechanism.spring_rest, "ball_q": balls[:, 0], "ball_v": balls[:, 1],
        "ball_stiffness": mechanism.ball_stiffness, "ball_rest": mechanism.ball_rest, "origin": origin,
        "floating_address": floating,
    }  # fmt: skip


def _exponential(mechanism: Any, i: int, kind: int) -> list[np.ndarray]:
    """C0, Cs, Cc, Ct of link i."""
    T = mechanism.T_home[i]
    zero = np.zeros((4, 4))
    if kind == FLOATING:  # its own place is the origin
        return [np.eye(4), zero, zero, zero]
    if kind != SCREW:
        return [T, zero, zero, zero]
    w, v = mechanism.S[i, :3], mechanism.S[i, 3:]
    H = zero.copy()
    H[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    H[:3, 3] = v
    H2 = H @ H
    H3 = H2 @ H
    q = -float(mechanism.q_home[i])
    T = T @ (np.eye(4) + np.sin(q) * -H3 + (1.0 - np.cos(q)) * H2 + q * (H + H3))
    slide = H + H3
    slide[:3, :3] = 0.0  # exactly, for a unit axis; rounding would make every joint a sliding one
    if np.any(w):
        slide[np.abs(slide) < 1e-15 * max(1.0, float(np.abs(v).max()))] = 0.0
    return [T, -T @ H3, T @ H2, T @ slide]


def _inertias(mechanism: Any) -> np.ndarray:
    """(nv, 10) of each link: m, m c (3), second moment about the link's origin (xx, xy, xz, yy, yz, zz)."""
    m, c = mechanism.mass, mechanism.com
    square = np.einsum("ni,ni->n", c, c)[:, None, None] * np.eye(3) - c[:, :, None] * c[:, None, :]
    J = mechanism.inertia + m[:, None, None] * square
    rows, columns = np.triu_indices(3)
    return np.concatenate([m[:, None], m[:, None] * c, J[:, rows, columns]], axis=1)


def _related(parent: np.ndarray, coupled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each block of four columns, the rows of dtau/dq that are not zero: relatives, and what actuators couple."""
    n = len(parent)
    related = coupled | np.eye(n, dtype=bool)
    for i in range(n):
        j = parent[i]
        while j >= 0:
            related[i, j] = related[j, i] = True
            j = parent[j]
    blocks = [np.flatnonzero(related[:, j : j + WIDTH].any(axis=1)) for j in range(0, n, WIDTH)]
    return np.cumsum([0, *(len(rows) for rows in blocks)]), np.concatenate(blocks)


def _forces(mechanism: Any, prescribed: np.ndarray, actuated: bool) -> dict[str, np.ndarray]:
    """Applied forces as sums of terms: constant, by input (u, then act), by position and by velocity."""
    a, nv = mechanism.actuators, mechanism.nv
    nu = (mechanism.nu if actuated else 0) + int(prescribed.sum())
    constant, inputs = np.zeros(nv), np.zeros((nv, nu + (mechanism.na if actuated else 0)))
    by_position, by_velocity = np.zeros((nv, nv)), np.zeros((nv, nv))
    states = {"input": [], "gain": [], "rate": []}
    if actuated:
        moment = np.where(prescribed[None, :], 0.0, a.moment)  # a prescribed joint feels no force
        for k in range(mechanism.nu):
            constant += moment[k] * a.bias[k, 0]
            by_position += np.outer(moment[k], a.moment[k]) * a.bias[k, 1]
            by_velocity += np.outer(moment[k], a.moment[k]) * a.bias[k, 2]
            state = a.activation[k]
            inputs[:, k if state < 0 else nu + state] += moment[k] * a.gain[k]
        order = np.argsort(a.activation[a.activation >= 0])
        for k in np.flatnonzero(a.activation >= 0)[order]:
            filtering = a.dynamics[k] == 2
            states["input"].append(k)
            states["gain"].append(1.0 / a.time_constant[k] if filtering else 1.0)
            states["rate"].append(-1.0 / a.time_constant[k] if filtering else 0.0)
    which = np.full(nv, -1)
    which[prescribed] = (mechanism.nu if actuated else 0) + np.arange(int(prescribed.sum()))
    dof, index = np.nonzero(inputs)
    row, column = np.nonzero(by_position)
    vrow, vcolumn = np.nonzero(by_velocity)
    return {
        "constant": constant, "input_dof": dof, "input_index": index, "input_value": inputs[dof, index],
        "position_row": row, "position_column": column, "position_value": by_position[row, column],
        "velocity_row": vrow, "velocity_column": vcolumn, "velocity_value": by_velocity[vrow, vcolumn],
        "activation_input": np.array(states["input"], dtype=np.int64),
        "activation_gain": np.array(states["gain"], dtype=float),
        "activation_rate": np.array(states["rate"], dtype=float), "prescribed": which,
    }  # fmt: skip
