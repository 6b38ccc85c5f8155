"""Equalities of a compiled model that close chains: connect, weld, and those of joints that are not linear.

MuJoCo holds two places together (connect), two frames (weld), or sites where the equality names sites. A weld's first
body times its relative quaternion has the second one's rotation; its places are the first three numbers on the second
body and the next three on the first. A weld whose torques count nothing (torquescale 0) holds places alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.loops import LoopClosure, PolynomialCoupling
from planner.model.mjcf.couplings import acting, is_linear
from planner.model.mjcf.model_index import named, pose


def closes(model: Any, i: int) -> bool:
    """Whether an equality is one that this file reads."""
    return joins(model, i) or _is_cam(model, i)


def joins(model: Any, i: int) -> bool:
    """Whether an equality holds two places or frames together."""
    kinds = load_mujoco().mjtEq
    return model.eq_type[i] in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD))


def _is_cam(model: Any, i: int) -> bool:
    joint = model.eq_type[i] == int(load_mujoco().mjtEq.mjEQ_JOINT)
    return bool(joint and model.eq_obj2id[i] >= 0 and not is_linear(model, i))


def read_loops(model: Any, links: np.ndarray, poses: np.ndarray) -> tuple[LoopClosure, ...]:
    """The loops that act; links (nbody,) and poses (nbody, 4, 4) are those that carry MuJoCo's bodies."""
    return tuple(_loop(model, i, links, poses) for i in acting(model) if joins(model, i))


def _loop(model: Any, i: int, links: np.ndarray, poses: np.ndarray) -> LoopClosure:
    bodies, frames, rigid = joined(model, i)
    carried = np.array([poses[body] @ T for body, T in zip(bodies, frames, strict=True)])
    return LoopClosure(named(model, "equality", i), (int(links[bodies[0]]), int(links[bodies[1]])), carried, rigid)


def joined(model: Any, i: int) -> tuple[list[int], list[np.ndarray], bool]:
    """The bodies of a connect or a weld, the frames (4, 4) in them that are held together, and whether rotation is."""
    mujoco = load_mujoco()
    weld, things = model.eq_type[i] == int(mujoco.mjtEq.mjEQ_WELD), (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
    if model.eq_objtype[i] == int(mujoco.mjtObj.mjOBJ_SITE):
        frames = [pose(model.site_pos[site], model.site_quat[site]) for site in things]
        return [int(model.site_bodyid[site]) for site in things], frames, bool(weld)
    data, straight = model.eq_data[i], np.array([1.0, 0.0, 0.0, 0.0])
    places = (data[3:6], data[:3]) if weld else (data[:3], data[3:6])
    turns = (data[6:10] if weld else straight, straight)
    frames = [pose(place, turn) for place, turn in zip(places, turns, strict=True)]
    return [*things], frames, bool(weld and data[10] != 0.0)


def read_cams(model: Any) -> tuple[PolynomialCoupling, ...]:
    """The cams that act."""
    return tuple(_cam(model, i) for i in acting(model) if _is_cam(model, i))


def _cam(model: Any, i: int) -> PolynomialCoupling:
    joints = (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
    dofs, offsets = model.jnt_dofadr[list(joints)], model.qpos0[model.jnt_qposadr[list(joints)]]
    coefficients = tuple(float(x) for x in model.eq_data[i, :5])
    return PolynomialCoupling(
        named(model, "equality", i), int(dofs[0]), int(dofs[1]), (float(offsets[0]), float(offsets[1])), coefficients
    )
