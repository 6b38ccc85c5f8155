"""Read fixed tendons and equalities of a compiled model, and make equalities hard for a replay.

Linear equalities become couplings. MuJoCo's equality of joints is q_1 - q_1(0) = a_0 + a_1 (q_2 - q_2(0)) + ..., of
tendons the same of lengths, where (0) is qpos0; without a second joint or tendon only a_0 is read. Its equalities are
springs. A plan keeps them exactly, so it is replayed with the stiffest springs that MuJoCo takes, and "your file" with
the user's own.

Other equalities close chains. MuJoCo holds two positions together (connect), two frames (weld), or sites where the
equality names sites. A weld's first body times its relative quaternion has the second one's rotation; its positions are
the first three numbers on the second body and the next three on the first. A weld with torquescale 0 holds positions
alone. An equality of joints that is not linear is a polynomial coupling.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.couplings import Coupling, LoopClosure, PolynomialCoupling
from planner.model.mjcf.model_index import disabled, kind_word, named, pose
from planner.model.passive_forces import FixedTendon


def fixed(model: Any, tendon: int) -> bool:
    """Whether a tendon is a sum of joint coordinates."""
    return model.wrap_type[model.tendon_adr[tendon]] == load_mujoco().mjtWrap.mjWRAP_JOINT


def row_of(model: Any, tendon: int) -> np.ndarray:
    """(nv,) the coefficients of a fixed tendon."""
    first, row = model.tendon_adr[tendon], np.zeros(model.nv)
    wraps = slice(first, first + model.tendon_num[tendon])
    np.add.at(row, model.jnt_dofadr[model.wrap_objid[wraps]], model.wrap_prm[wraps])
    return row


def read_tendons(model: Any) -> tuple[FixedTendon, ...]:
    """The fixed tendons that have a force or a range."""
    spring, damper = (not disabled(model, name, "passive") for name in ("spring", "damper"))
    ends, found = not disabled(model, "constraint", "limit"), []
    for i in filter(lambda i: fixed(model, i), range(model.ntendon)):
        row = row_of(model, i)
        dofs = np.flatnonzero(row)
        limited = bool(ends and model.tendon_limited[i])
        low, high = model.tendon_range[i] if limited else (-np.inf, np.inf)
        tendon = FixedTendon(
            model.tendon(i).name, tuple(map(int, dofs)), tuple(map(float, row[dofs])),
            stiffness=float(model.tendon_stiffness[i] * spring),
            rest=(float(model.tendon_lengthspring[i, 0]), float(model.tendon_lengthspring[i, 1])),
            damping=float(model.tendon_damping[i] * damper), range=(float(low), float(high)),
        )  # fmt: skip
        if tendon.acts or limited:
            found.append(tendon)
    return tuple(found)


_NOTHING = 1e-8  # s
_HELD = 1e-9  # of a row: what no combination of equalities may leave of a tendon that they hold
HARD = {"solref": f"{_NOTHING!r} 1", "solimp": "0.9999 0.9999 0.001 0.5 2"}


def acting(model: Any) -> list[int]:
    """The equalities that act."""
    if disabled(model, "constraint", "equality"):
        return []
    return [int(i) for i in np.flatnonzero(model.eq_active0)]


def is_linear(model: Any, i: int) -> bool:
    """Whether an equality is linear in hinges and slides."""
    kinds, wraps = load_mujoco().mjtEq, load_mujoco().mjtWrap
    kind, data = model.eq_type[i], model.eq_data[i]
    if kind not in (int(kinds.mjEQ_JOINT), int(kinds.mjEQ_TENDON)):
        return False
    if model.eq_obj2id[i] >= 0 and np.any(data[2:5] != 0.0):
        return False
    if kind == int(kinds.mjEQ_JOINT):
        return True
    tendons = [int(t) for t in (model.eq_obj1id[i], model.eq_obj2id[i]) if t >= 0]
    return all(model.wrap_type[model.tendon_adr[t]] == int(wraps.mjWRAP_JOINT) for t in tendons)


def kind_of(model: Any, i: int) -> str:
    """An equality's kind for a sentence, and why it is not linear where its kind may be."""
    kind = kind_word(load_mujoco().mjtEq, model.eq_type[i])
    why = {"joint": "of joints, by a polynomial", "tendon": "of tendons, spatial or by a polynomial"}
    return why.get(kind, kind)


def read_couplings(model: Any) -> tuple[Coupling, ...]:
    """The linear equalities that act."""
    return tuple(_coupling(model, i) for i in acting(model) if is_linear(model, i))


def held_tendons(model: Any) -> frozenset[int]:
    """The fixed tendons whose lengths the linear equalities hold where they are."""
    rows = np.zeros((0, model.nv))
    for coupling in read_couplings(model):
        row = np.zeros(model.nv)
        row[list(coupling.dofs)] = coupling.coefficients
        rows = np.vstack([rows, row / np.abs(row).max()]) if np.any(row) else rows
    if not len(rows):
        return frozenset()
    found = []
    for i in filter(lambda i: fixed(model, i), range(model.ntendon)):
        row = row_of(model, i)
        row /= np.abs(row).max(initial=np.finfo(float).tiny)
        left = row - np.linalg.lstsq(rows.T, row, rcond=None)[0] @ rows
        found += [i] if np.abs(left).max(initial=0.0) < _HELD else []
    return frozenset(found)


def _coupling(model: Any, i: int) -> Coupling:
    """Moved to one side: first(q) - a_1 second(q) = first(q0) + a_0 - a_1 second(q0)."""
    sides = [_side(model, i, model.eq_obj1id[i])]
    if model.eq_obj2id[i] >= 0:
        sides.append([(dof, -float(model.eq_data[i, 1]) * x) for dof, x in _side(model, i, model.eq_obj2id[i])])
    total: dict[int, float] = {}
    for dof, coefficient in (term for side in sides for term in side):
        total[dof] = total.get(dof, 0.0) + coefficient
    home = {
        int(dof): float(model.qpos0[address]) for dof, address in zip(model.jnt_dofadr, model.jnt_qposadr, strict=True)
    }
    constant = float(model.eq_data[i, 0]) + sum(coefficient * home[dof] for dof, coefficient in total.items())
    terms = {dof: coefficient for dof, coefficient in total.items() if coefficient != 0.0}
    return Coupling(named(model, "equality", i), tuple(terms), tuple(terms.values()), constant)


def _side(model: Any, i: int, thing: int) -> list[tuple[int, float]]:
    """The degrees of freedom and coefficients of a joint, or of a fixed tendon."""
    if model.eq_type[i] == int(load_mujoco().mjtEq.mjEQ_JOINT):
        return [(int(model.jnt_dofadr[thing]), 1.0)]
    wraps = slice(model.tendon_adr[thing], model.tendon_adr[thing] + model.tendon_num[thing])
    dofs, coefficients = model.jnt_dofadr[model.wrap_objid[wraps]], model.wrap_prm[wraps]
    return [(int(dof), float(x)) for dof, x in zip(dofs, coefficients, strict=True)]


def harden(root: ElementTree.Element, model: Any) -> None:
    """Make the equalities of the text as hard as MuJoCo takes them at any step; `model` is compiled from it.

    MuJoCo raises a time constant to two steps of the simulation, so one that is next to nothing is always those two;
    but with its flag refsafe off it does not, and `set_hard` has to.
    """
    elements = equalities_of(root, model)
    for i in acting(model) if elements else ():
        elements[i].attrib.update(HARD)


def set_hard(model: Any, timestep: float) -> None:
    """Give the equalities that `harden` wrote the time constant of two steps, s, that they mean."""
    model.eq_solref[model.eq_solref[:, 0] == _NOTHING, 0] = 2.0 * timestep


def equalities_of(root: ElementTree.Element, model: Any) -> list[ElementTree.Element]:
    """The elements of all equalities in MuJoCo's order; none where the text has not all (<attach>, <replicate>)."""
    elements = [element for section in root.findall("equality") for element in section]
    names = [model.equality(i).name for i in range(model.neq)]
    return elements if [element.get("name", "") for element in elements] == names else []


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
