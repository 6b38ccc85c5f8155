"""Shapes that pass through each other between two steps of a replay, which MuJoCo's contacts do not see.

Two shapes whose half thicknesses add up to d overlap over a way of 2 d where one passes through the other. A step that
moves them further than d relative to each other may jump over that. Such steps are repeated in parts of d / 2 along the
line from one state to the next, with the distances of the shapes. Planes and height fields have no other side.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import contact_pairs, named
from planner.proof.replays.replaying import Replay

FASTER = 2.0  # ratio of the largest speed within a stage to the mean one, at most
MAX_PARTS = 200  # of one step
SEEN_DEPTH = 0.5  # of the thinner shape's half thickness: contacts that a step sees are shallower, or last longer


def passages(run: Replay) -> list[str]:
    """A sentence for each pair of geoms that passes through each other between two steps."""
    model, mujoco = run.compiled.model, load_mujoco()
    pairs = np.array(contact_pairs(model), dtype=int).reshape(-1, 2)
    half = _half_thickness(model)
    pairs = pairs[np.isfinite(half[pairs]).all(axis=1)]
    if not len(pairs) or not np.isfinite(run.qpos).all():
        return []
    data, found = mujoco.MjData(model), []
    for pair, stages in _fast_and_near(run, pairs, half):
        thin, at = half[pair].sum(), None
        for i in (step for stage in stages for step in range(stage * run.substeps, (stage + 1) * run.substeps)):
            depths = _depths(model, data, pair, run.qpos[i], run.qpos[i + 1], run.timestep, 0.5 * thin)
            if len(depths) > 2 and max(depths[0], depths[-1]) <= 0.0 and depths.max() > SEEN_DEPTH * half[pair].min():
                at = i if at is None else at
        if at is not None:
            names = " and ".join(named(model, "geom", int(geom)) for geom in pair)
            found.append(f"{names} pass through each other at t = {run.t[at]:.4g} s, between two steps of MuJoCo.")
    return found


def _half_thickness(model: Any) -> np.ndarray:
    """(ngeom,) m, of each shape where it is thinnest; infinite for one without another side."""
    kinds = load_mujoco().mjtGeom
    half = model.geom_aabb[:, 3:].min(axis=1)
    return np.where(np.isin(model.geom_type, [int(kinds.mjGEOM_PLANE), int(kinds.mjGEOM_HFIELD)]), np.inf, half)


def _fast_and_near(run: Replay, pairs: np.ndarray, half: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The pairs (2,) that may meet on some stages and move further in a step than they are thick, and these stages."""
    model, mujoco = run.compiled.model, load_mujoco()
    data, knots = mujoco.MjData(model), run.qpos[:: run.substeps]
    places, turns = np.empty((len(knots), model.ngeom, 3)), np.empty((len(knots), model.ngeom, 3, 3))
    for n, q in enumerate(knots):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        places[n], turns[n] = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)
    chord = np.sqrt(np.maximum(3.0 - np.einsum("ngij,ngij->ng", turns[1:], turns[:-1]), 0.0))  # of the turn
    swing = np.pi / 2.0 * chord * model.geom_rbound
    for pair in pairs:
        apart = places[:, pair[0]] - places[:, pair[1]]
        way = np.linalg.norm(np.diff(apart, axis=0), axis=1) + swing[:, pair].sum(axis=1)
        gap = np.linalg.norm(apart, axis=1) - model.geom_rbound[pair].sum()
        near = np.minimum(gap[:-1], gap[1:]) < FASTER * way
        stages = np.flatnonzero(near & (FASTER * way / run.substeps > half[pair].sum()))
        if len(stages):
            yield pair, stages


def _depths(
    model: Any, data: Any, pair: np.ndarray, q: np.ndarray, after: np.ndarray, h: float, part: float
) -> np.ndarray:
    """Depths, m, of two geoms in each other at equal parts of a step from q to `after` (nq,); the first alone if far.

    A part moves the two at most `part` relative to each other, m.
    """
    mujoco, velocity, between = load_mujoco(), np.empty(model.nv), np.empty(model.nq)
    mujoco.mj_differentiatePos(model, velocity, h, q, after)

    def placed(share: float) -> tuple[np.ndarray, np.ndarray, float]:
        between[:] = q
        mujoco.mj_integratePos(model, between, velocity, share * h)
        data.qpos[:] = between
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, int(pair[0]), int(pair[1]), 10.0, None)
        return data.geom_xpos[pair].copy(), data.geom_xmat[pair].reshape(2, 3, 3).copy(), -float(distance)

    (x, R, first), (y, S, last) = placed(0.0), placed(1.0)
    chord = np.sqrt(np.maximum(3.0 - np.einsum("gij,gij->g", R, S), 0.0))
    way = np.linalg.norm((y[0] - y[1]) - (x[0] - x[1])) + np.pi / 2.0 * float(chord @ model.geom_rbound[pair])
    if min(-first, -last) > way:
        return np.array([first])
    parts = int(np.clip(np.ceil(way / part), 1, MAX_PARTS))
    return np.array([first, *(placed(k / parts)[2] for k in range(1, parts)), last])
