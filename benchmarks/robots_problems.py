"""A problem file of four lines for a machine by others: one rule for all, never one for a machine.

    model     the file as it is; a machine with legs whose file has no floor is included into a scene with one
    start     the first keyframe, else the pose of the file; put within the ranges where it is outside
    goal      the start with the driven joints moved, to the side of more room: by 15 % of the range for arms and hands,
              3 % for machines with legs, 0.5 rad where there is no range; the cart of an underactuated machine by 0.5 m
    duration  1.5 s for arms, 2 s for underactuated machines, 1 s for the others

A joint that an equality ties to another one goes where that takes it. Joints that nothing drives end where they began.
Where shapes would meet on the straight line that are apart at the start, the way is halved, up to three times: nobody
asks an arm to go into its own base.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np

DURATION = {"arm": 1.5, "hand": 1.0, "legged": 1.0, "underactuated": 2.0}
SHARE = {"arm": 0.15, "hand": 0.15, "legged": 0.03}  # of a range
UNLIMITED = 0.5  # rad or m
HALVINGS, LINE = 3, 11
FLOOR = '<geom name="corpus floor" type="plane" size="0 0 0.05" pos="0 0 {:.9g}"/>'


def problem_text(file: Path, kind: str, folder: Path) -> str:
    """The text of a problem.toml for a machine's file; a scene with a floor is written into the folder."""
    if file.suffix == ".urdf":
        start, goal = _of_urdf(file, kind)
    else:
        model = mujoco.MjModel.from_xml_path(str(file))
        if kind == "legged" and not _has_floor(model):
            file = _with_floor(file, folder)
        start, goal = _of_model(model, kind)
    return f'model = "{file}"\nstart = {start}\ngoal = {goal}\nduration = {DURATION[kind]}\n'


def _of_model(model: mujoco.MjModel, kind: str) -> tuple[str, str]:
    """Start and goal as TOML values, of a compiled model."""
    first = model.key(0).name if model.nkey else ""
    start = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
    place = {int(model.jnt_qposadr[j]): j for j in range(model.njnt) if model.jnt_type[j] >= 2}  # slides, hinges
    for i, j in place.items():
        if model.jnt_limited[j]:
            start[i] = np.clip(start[i], *model.jnt_range[j])
    start = _tied(model, start)
    way, driven = np.zeros_like(start), _driven(model, start)
    for i, j in place.items():
        if driven[model.jnt_dofadr[j]]:
            way[i] = _way(start[i], model.jnt_range[j] if model.jnt_limited[j] else None, kind)
    for _ in range(HALVINGS):
        if not _meets(model, start, way):
            break
        way *= 0.5
    goal = _tied(model, start + way)
    unchanged = bool(first) and np.array_equal(start, model.key_qpos[0])
    return (f'"{first}"' if unchanged else _numbers(start)), _numbers(_tied(model, goal))


def _meets(model: mujoco.MjModel, start: np.ndarray, way: np.ndarray) -> bool:
    """Whether shapes touch on the straight line that do not at its start; a floor is no matter of the way."""
    data, known = mujoco.MjData(model), None
    for part in np.linspace(0.0, 1.0, LINE):
        data.qpos[:] = _tied(model, start + part * way)
        mujoco.mj_fwdPosition(model, data)
        planes = model.geom_type[data.contact.geom] == mujoco.mjtGeom.mjGEOM_PLANE
        touching = {frozenset(pair) for pair in data.contact.geom[~planes.any(axis=1)].tolist()}
        if known is None:
            known = touching
        elif touching - known:
            return True
    return False


def _of_urdf(file: Path, kind: str) -> tuple[str, str]:
    """The same, of the joints that a URDF gives an effort."""
    starts, goals = [], []
    for joint in ElementTree.parse(file).getroot().findall("joint"):
        limit = joint.find("limit")
        moves = joint.get("type") in ("revolute", "prismatic", "continuous") and joint.find("mimic") is None
        if not moves or limit is None or float(limit.get("effort", 0.0)) <= 0.0:
            continue
        lower, upper = (float(limit.get(side, 0.0)) for side in ("lower", "upper"))
        limits = None if joint.get("type") == "continuous" or lower >= upper else np.array([lower, upper])
        value = 0.0 if limits is None else float(np.clip(0.0, *limits))
        starts.append(f'"{joint.get("name")}" = {value:.9g}')
        goals.append(f'"{joint.get("name")}" = {value + _way(value, limits, kind):.9g}')
    return f"{{ {', '.join(starts)} }}", f"{{ {', '.join(goals)} }}"


def _way(value: float, limits: np.ndarray | None, kind: str) -> float:
    """How far a joint is to move."""
    way = UNLIMITED if kind == "underactuated" or limits is None else SHARE[kind] * (limits[1] - limits[0])
    return -way if limits is not None and value - limits[0] > limits[1] - value else way


def _driven(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Which degrees of freedom (nv,) an actuator pulls at."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return (np.abs(moment) > 1e-9).any(axis=0)


def _tied(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Positions with joints where equalities between joints take them."""
    qpos = qpos.copy()
    for i in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_active0 == 1)):
        first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        way = 0.0
        if second >= 0:
            way = qpos[model.jnt_qposadr[second]] - model.qpos0[model.jnt_qposadr[second]]
        address = model.jnt_qposadr[first]
        qpos[address] = model.qpos0[address] + np.polynomial.polynomial.polyval(way, model.eq_data[i, :5])
    return qpos


def _has_floor(model: mujoco.MjModel) -> bool:
    return bool(np.any((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.body_weldid[model.geom_bodyid] == 0)))


def _with_floor(file: Path, folder: Path) -> Path:
    """The machine's file with a floor at the lowest point of its start, in a folder; paths in it become absolute."""
    root = ElementTree.parse(file).getroot()
    compiler = root.find("compiler")
    compiler = ElementTree.SubElement(root, "compiler") if compiler is None else compiler
    for key in ("meshdir", "texturedir"):
        compiler.set(key, str(file.parent / compiler.get(key, compiler.get("assetdir", ""))))
    compiler.attrib.pop("assetdir", None)
    worldbody = root.find("worldbody")
    assert worldbody is not None
    worldbody.append(ElementTree.fromstring(FLOOR.format(_lowest(file))))
    option = root.find("option")
    option = ElementTree.SubElement(root, "option") if option is None else option
    if [float(part) for part in option.get("gravity", "0 0 -9.81").split()] == [0.0, 0.0, 0.0]:
        option.attrib.pop("gravity")  # its package gives it with the floor
    scene = folder / f"{file.parent.name}_{file.name}"
    scene.write_text(ElementTree.tostring(root, encoding="unicode"))
    return scene


def _lowest(file: Path) -> float:
    """Height of the lowest point of a machine's shapes that may touch, at its start, m."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
    mujoco.mj_forward(model, data)
    lowest = np.inf
    for geom in np.flatnonzero(
        (model.geom_contype | model.geom_conaffinity) & (model.body_weldid[model.geom_bodyid] > 0)
    ):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        else:
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
            points = centre + corners * half
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
                lowest = min(lowest, data.geom_xpos[geom, 2] - model.geom_size[geom, 0])
                continue
        lowest = min(lowest, (points @ data.geom_xmat[geom].reshape(3, 3)[2] + data.geom_xpos[geom, 2]).min())
    return float(lowest)


def _numbers(values: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.9g}' for value in values)}]"
