"""A problem file of four lines for a machine by others: one rule for all, never one for a machine.

    model     the file as it is; a machine with legs whose file has no floor is included into a scene with one, and a
              file that says no unit of angles and whose ranges are radians gets that unit: its package merges it into
              a file that says so
    start     the first keyframe, else the pose of the file; put within the ranges where it is outside, and joints that
              their motors cannot hold there go to the nearest angle at which they can; legs that topple there with
              stiff joints lean at the ankles, as little as makes them stand
    goal      the start with the driven joints moved, to the side of more room, 0.5 rad where there is no range; the
              cart of an underactuated machine by 0.5 m. Small goals: by 15 % of the range for arms and hands, 3 % for
              machines with legs; moderate: 40 %, at most 0.5 rad, and 8 %; large: 60 % and 15 %. With a seed a third of
              the machines have other goals: each joint anywhere between that far to one side and to the other
    duration  1.5 s for arms, 2 s for underactuated machines, 1 s for the others

Joints that equalities tie to others go where those take them; joints that nothing drives end where they began. A joint
whose way would take one out of its range, or a tendon out of its own, moves half as far, up to three times, or stays;
one that its motor could not bring or hold there moves to the other side, or half as far, likewise. On legs a joint that
leans sideways or turns and has as much room on both sides stays: both legs would lean to the same side. A pose in which
legs with stiff joints topple is half as far away, likewise, where the start stands.
Where shapes would meet on the straight line that are apart at the start, the way is halved, up to three times: nobody
asks an arm to go into its own base.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from robots_goals import Goals

from planner.model.urdf.read import opened_model

DURATION = {"arm": 1.5, "hand": 1.0, "legged": 1.0, "underactuated": 2.0}
HALVINGS, LINE = 3, 11
TIES = 4  # Newton steps onto equalities
ON_IT = 1e-9  # rad or m: as far beyond a range is still on it
MIDDLE = 1e-3  # of a range
ACROSS = 0.7  # of an axis along y: it bends a leg forwards
STIFF = 2.0, 3000.0, 100.0  # kg m^2, N m/rad, N m s/rad
UPRIGHT = 2.0, 0.3  # s; rad: a machine that has turned as far has toppled
LEANS = [sign * 0.02 * (k + 1) for k in range(5) for sign in (1.0, -1.0)]  # rad
SOLE = 0.02  # m above the lowest shape
POSES = 20  # to try between the ends of a range
SMOOTH = 8.0  # times way / duration^2: the acceleration of a smooth motion, 5.8, with some to spare
SLIGHT = 0.02  # of the largest torque that holds a machine: less falls by little in a second
FULL_TURN = 6.3  # rad: ranges in degrees are wider
FLOOR = '<geom name="corpus floor" type="plane" size="0 0 0.05" pos="0 0 {:.9g}"/>'


def problem_text(file: Path, kind: str, folder: Path, goals: Goals | None = None) -> str:
    """The text of a problem.toml for a machine's file; a scene with a floor is written into the folder."""
    goals = goals or Goals()
    if file.suffix == ".urdf":
        start, goal = _of_urdf(file, kind, goals)
    else:
        model = mujoco.MjModel.from_xml_path(str(file))
        if _written_in_radians(file):
            file = _in_radians(file, folder)
            model = mujoco.MjModel.from_xml_path(str(file))
        if kind == "legged" and not _has_floor(model):
            file = _with_floor(file, folder)
            model = mujoco.MjModel.from_xml_path(str(file))
        start, goal = _of_model(model, kind, goals)
    return f'model = "{file}"\nstart = {start}\ngoal = {goal}\nduration = {DURATION[kind]}\n'


def _of_model(model: mujoco.MjModel, kind: str, goals: Goals) -> tuple[str, str]:
    """Start and goal as TOML values, of a compiled model."""
    first = model.key(0).name if model.nkey else ""
    start = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
    place = {int(model.jnt_qposadr[j]): j for j in range(model.njnt) if model.jnt_type[j] >= 2}  # slides, hinges
    for i, j in place.items():
        if model.jnt_limited[j]:
            start[i] = np.clip(start[i], *model.jnt_range[j])
    driven = _driven(model, start)
    start = _tied(model, start, driven)
    start = _leaned(model, start, driven) if kind == "legged" else start
    held = kind != "legged" and bool(driven.all() or kind in ("arm", "hand"))  # the ground holds legs, nothing a pole
    start = _held(model, start, driven, place) if held else start
    way = np.zeros_like(start)
    for i, j in place.items():
        limits = model.jnt_range[j] if model.jnt_limited[j] else None
        if driven[model.jnt_dofadr[j]] and not (kind == "legged" and _leans(model, j, start, limits)):
            way[i] = goals.way(start[i], limits, kind)
            way[i] *= _share_within(model, start, np.where(np.arange(model.nq) == i, way, 0.0), driven)
    way = _held_way(model, start, way, driven, place, DURATION[kind]) if held else way
    for _ in range(HALVINGS):
        if not _meets(model, start, way, driven):
            break
        way *= 0.5
    if kind == "legged" and _stands(model, start):
        for _ in range(HALVINGS):
            if _stands(model, _tied(model, start + way, driven)):
                break
            way *= 0.5
    goal = _tied(model, start + way, driven)
    unchanged = bool(first) and np.array_equal(start, model.key_qpos[0])
    return (f'"{first}"' if unchanged else _numbers(start)), _numbers(goal)


def _stands(model: mujoco.MjModel, qpos: np.ndarray) -> bool:
    """Whether a machine with a free base and a floor stays upright in MuJoCo with stiff joints."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free) != 1 or not _has_floor(model):
        return False
    stiff, joints = copy.copy(model), np.flatnonzero(model.jnt_type >= 2)
    places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    stiff.opt.timestep, stiff.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    stiff.dof_armature[dofs] += STIFF[0]
    data = mujoco.MjData(stiff)
    data.qpos[:] = qpos
    while data.time < UPRIGHT[0]:
        data.qfrc_applied[dofs] = STIFF[1] * (qpos[places] - data.qpos[places]) - STIFF[2] * data.qvel[dofs]
        mujoco.mj_step(stiff, data)
    first = int(model.jnt_qposadr[free[0]]) + 3
    return abs(float(data.qpos[first : first + 4] @ qpos[first : first + 4])) > np.cos(0.5 * UPRIGHT[1])


def _leaned(model: mujoco.MjModel, start: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """The start, or where that topples the nearest lean of its ankles at which it stands with some room, if any.

    An ankle is the last joint above the lowest shapes that bends forwards.
    """
    if not np.any(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE) or not _has_floor(model) or _stands(model, start):
        return start
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_kinematics(model, data)
    soles = _bottoms(model, data)
    ankles = set()
    for geom in np.flatnonzero(soles < soles.min() + SOLE):
        body = int(model.geom_bodyid[geom])
        while body:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            bends = [
                j for j in range(first, first + count) if model.jnt_type[j] >= 2 and abs(data.xaxis[j, 1]) > ACROSS
            ]
            bends = [j for j in bends if driven[model.jnt_dofadr[j]]]
            if bends:
                ankles.add(bends[-1])
                break
            body = int(model.body_parentid[body])
    for lean in LEANS:
        poses = []
        for share in (1.0, 1.5):  # some room
            pose = start.copy()
            for j in ankles:
                pose[model.jnt_qposadr[j]] += share * lean * np.sign(data.xaxis[j, 1])
                if model.jnt_limited[j]:
                    pose[model.jnt_qposadr[j]] = np.clip(pose[model.jnt_qposadr[j]], *model.jnt_range[j])
            poses.append(_tied(model, pose, driven))
        if all(_stands(model, pose) for pose in poses):
            return poses[0]
    return start


def _leans(model: mujoco.MjModel, joint: int, start: np.ndarray, limits: np.ndarray | None) -> bool:
    """Whether a joint leans sideways or turns, with as much room on both sides."""
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_kinematics(model, data)
    middle = limits is not None and abs(limits.sum() - 2.0 * start[model.jnt_qposadr[joint]]) < MIDDLE * np.ptp(limits)
    return middle and abs(data.xaxis[joint, 1]) < ACROSS


def _held(model: mujoco.MjModel, qpos: np.ndarray, driven: np.ndarray, place: dict[int, int]) -> np.ndarray:
    """The nearest pose, a joint at a time, that motors hold against gravity."""
    for _ in range(POSES):
        short = _short_of_force(model, qpos)
        worst = int(np.argmax(short))
        if short[worst] == 0.0:
            break
        i = next((i for i, j in place.items() if model.jnt_dofadr[j] == worst), None)
        if i is None or not model.jnt_limited[place[i]]:
            break
        poses = [qpos, qpos]
        limits = model.jnt_range[place[i]]
        for side, sign in enumerate((-1.0, 1.0)):
            moved = qpos.copy()
            moved[i] = np.clip(moved[i] + sign * np.ptp(limits) / POSES, *limits)
            poses[side] = _tied(model, moved, driven)
        best = min(poses, key=lambda pose: _short_of_force(model, pose)[worst])
        if _short_of_force(model, best)[worst] >= short[worst]:
            break
        qpos = best
    return qpos


def _held_way(
    model: mujoco.MjModel, start: np.ndarray, way: np.ndarray, driven: np.ndarray, place: dict[int, int], T: float
) -> np.ndarray:  # fmt: skip
    """The way with joints turned round, or moved less, whose motors could not bring or hold them there."""
    way, at_start = way.copy(), _short_of_force(model, start)
    for share in (-1.0, -0.5, -0.5, 0.5, 0.0):
        goal = _tied(model, start + way, driven)
        speeding = np.zeros(model.nv)
        for i, j in place.items():
            speeding[model.jnt_dofadr[j]] = SMOOTH * abs(way[i]) / T**2
        short = _short_of_force(model, goal, speeding) > at_start
        for i, j in place.items():
            limits = model.jnt_range[j] if model.jnt_limited[j] else (-np.inf, np.inf)
            if short[model.jnt_dofadr[j]]:
                way[i] = float(np.clip(start[i] + share * way[i], *limits)) - start[i]
    return way


def _short_of_force(model: mujoco.MjModel, qpos: np.ndarray, speeding: np.ndarray | float = 0.0) -> np.ndarray:
    """(nv,) what motors of one joint each, N m or N, lack to hold a pose, with a tenth to spare.

    `speeding` are accelerations of the joints (nv,) for which there is to be force too, either way.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    needed, short = data.qfrc_bias - data.qfrc_passive, np.zeros(model.nv)
    lower, upper = np.zeros(model.nv), np.zeros(model.nv)
    for a in range(model.nu):
        joint = int(model.actuator_trnid[a, 0])
        if model.actuator_trntype[a] != mujoco.mjtTrn.mjTRN_JOINT or model.actuator_gaintype[a] != 0:
            return short
        dof, gear = model.jnt_dofadr[joint], model.actuator_gear[a, 0]
        bias = model.actuator_biasprm[a, :2] @ [1.0, data.actuator_length[a]] if model.actuator_biastype[a] else 0.0
        ends = np.array([-np.inf, np.inf])
        if model.actuator_ctrllimited[a]:
            ends = np.sort(model.actuator_gainprm[a, 0] * model.actuator_ctrlrange[a]) + bias
        if model.actuator_forcelimited[a]:
            ends = np.clip(ends, *model.actuator_forcerange[a])
        ends = np.sort(ends * gear) if gear else np.zeros(2)
        lower[dof], upper[dof] = lower[dof] + ends[0], upper[dof] + ends[1]
    limited = np.flatnonzero(model.jnt_actfrclimited)
    dofs = model.jnt_dofadr[limited]
    lower[dofs], upper[dofs] = (np.clip(side[dofs], *model.jnt_actfrcrange[limited].T) for side in (lower, upper))
    pulled = (lower != 0.0) | (upper != 0.0)
    if np.any(speeding):
        columns = np.zeros((model.nv, model.nv))
        for i, row in enumerate(np.eye(model.nv)):
            mujoco.mj_mulM(model, data, columns[i], row)
        speeding = np.diag(columns) * speeding
    low, high = needed * 1.1 - speeding, needed * 1.1 + speeding
    short[pulled] = np.maximum(0.0, np.maximum(lower - low, high - upper))[pulled]
    short[np.abs(needed) + speeding < SLIGHT * np.abs(needed).max(initial=0.0)] = 0.0
    return short


def _share_within(model: mujoco.MjModel, start: np.ndarray, way: np.ndarray, driven: np.ndarray) -> float:
    """How much of a joint's way takes nothing further out of a range: all of it, a half ... or nothing."""
    before = _outside(model, start)
    for share in 0.5 ** np.arange(HALVINGS + 1):
        if np.all(_outside(model, _tied(model, start + share * way, driven)) <= before + ON_IT):
            return float(share)
    return 0.0


def _outside(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """How far each hinge, slide and tendon is out of its range, 0 within it."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    single = np.flatnonzero(model.jnt_limited & (model.jnt_type >= 2))
    limited = np.flatnonzero(model.tendon_limited)
    values = np.concatenate([qpos[model.jnt_qposadr[single]], data.ten_length[limited]])
    ranges = np.concatenate([model.jnt_range[single], model.tendon_range[limited]])
    return np.maximum(0.0, np.maximum(ranges[:, 0] - values, values - ranges[:, 1]))


def _meets(model: mujoco.MjModel, start: np.ndarray, way: np.ndarray, driven: np.ndarray) -> bool:
    """Whether shapes touch on the straight line that do not at its start; a floor is no matter of the way."""
    data, known = mujoco.MjData(model), None
    for part in np.linspace(0.0, 1.0, LINE):
        data.qpos[:] = _tied(model, start + part * way, driven)
        mujoco.mj_fwdPosition(model, data)
        planes = model.geom_type[data.contact.geom] == mujoco.mjtGeom.mjGEOM_PLANE
        touching = {frozenset(pair) for pair in data.contact.geom[~planes.any(axis=1)].tolist()}
        if known is None:
            known = touching
        elif touching - known:
            return True
    return False


def _of_urdf(file: Path, kind: str, given: Goals) -> tuple[str, str]:
    """The same, of a URDF's joints: each that follows no other has a motor, without limits where the effort is 0."""
    starts, ways = {}, {}
    for joint in ElementTree.parse(file).getroot().findall("joint"):
        limit = joint.find("limit")
        moves = joint.get("type") in ("revolute", "prismatic", "continuous") and joint.find("mimic") is None
        if not moves:
            continue
        lower, upper = (0.0 if limit is None else float(limit.get(side, 0.0)) for side in ("lower", "upper"))
        limits = None if joint.get("type") == "continuous" or lower >= upper else np.array([lower, upper])
        starts[joint.get("name")] = 0.0 if limits is None else float(np.clip(0.0, *limits))
        ways[joint.get("name")] = given.way(starts[joint.get("name")], limits, kind)
    share = _share_without_touch(file, starts, ways)
    goals = {name: value + share * ways[name] for name, value in starts.items()}
    texts = [", ".join(f'"{name}" = {value:.9g}' for name, value in one.items()) for one in (starts, goals)]
    return f"{{ {texts[0]} }}", f"{{ {texts[1]} }}"


def _share_without_touch(file: Path, starts: dict[str, float], ways: dict[str, float]) -> float:
    """How much of the way of a URDF is free of shapes that meet: halved as in _of_model."""
    model = opened_model(file)[0].survey.model
    start, way = model.qpos0.copy(), np.zeros(model.nq)
    for name, value in starts.items():
        address = model.jnt_qposadr[model.joint(name).id]
        start[address], way[address] = value, ways[name]
    driven = way != 0.0  # hinges and slides alone: a URDF's base is fixed here
    start = _tied(model, start, driven)
    for halvings in range(HALVINGS):
        if not _meets(model, start, 0.5**halvings * way, driven):
            return 0.5**halvings
    return 0.5**HALVINGS


def _driven(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Which degrees of freedom (nv,) an actuator pulls at."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return (np.abs(moment) > 1e-9).any(axis=0)


def _tied(model: mujoco.MjModel, qpos: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """Positions where equalities of joints, tendons and chains take the joints that nothing drives."""
    qpos, data = qpos.copy(), mujoco.MjData(model)
    kinds, active = mujoco.mjtEq, model.eq_active0 == 1
    for i in np.flatnonzero((model.eq_type == kinds.mjEQ_JOINT) & active):
        first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        way = 0.0
        if second >= 0:
            way = qpos[model.jnt_qposadr[second]] - model.qpos0[model.jnt_qposadr[second]]
        address = model.jnt_qposadr[first]
        qpos[address] = model.qpos0[address] + np.polynomial.polynomial.polyval(way, model.eq_data[i, :5])
    if not np.any(active & (model.eq_type != kinds.mjEQ_JOINT)):
        return qpos
    for _ in range(TIES):
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        rows = np.flatnonzero(data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        J = np.zeros((data.nefc, model.nv))
        if mujoco.mj_isSparse(model):
            mujoco.mju_sparse2dense(J, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
        else:
            J[:] = data.efc_J.reshape(-1, model.nv)[: data.nefc]
        J = np.where(driven, 0.0, J[rows])
        step = -np.linalg.lstsq(J, data.efc_pos[rows], rcond=1e-9)[0]
        mujoco.mj_integratePos(model, qpos, step, 1.0)
    return qpos


def _written_in_radians(file: Path) -> bool:
    """Whether a file leaves the unit of angles to the one that it is merged into, and means radians."""
    root = ElementTree.parse(file).getroot()
    angles = [one.get("angle") for one in root.findall("compiler")]
    parts = root.iter("include")
    hinges = [one for one in root.iter("joint") if one.get("range") and one.get("type", "hinge") == "hinge"]
    ends = [abs(float(end)) for one in hinges for end in one.get("range", "").split()]
    return not any(angles) and not any(True for _ in parts) and bool(ends) and max(ends) <= FULL_TURN


def _in_radians(file: Path, folder: Path) -> Path:
    """The file in a folder, with that unit and with absolute paths."""
    return _copied(file, folder, lambda root, compiler: compiler.set("angle", "radian"))


def _has_floor(model: mujoco.MjModel) -> bool:
    return bool(np.any((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.body_weldid[model.geom_bodyid] == 0)))


def _with_floor(file: Path, folder: Path) -> Path:
    """The machine's file with a floor at the lowest point of its start, in a folder; paths in it become absolute."""

    def floored(root: ElementTree.Element, compiler: ElementTree.Element) -> None:
        worldbody = root.find("worldbody")
        assert worldbody is not None
        worldbody.append(ElementTree.fromstring(FLOOR.format(_lowest(file))))
        option = root.find("option")
        option = ElementTree.SubElement(root, "option") if option is None else option
        if [float(part) for part in option.get("gravity", "0 0 -9.81").split()] == [0.0, 0.0, 0.0]:
            option.attrib.pop("gravity")  # its package gives it with the floor

    return _copied(file, folder, floored)


def _copied(file: Path, folder: Path, change: Callable[[ElementTree.Element, ElementTree.Element], None]) -> Path:
    """A changed copy of a file in a folder, with absolute paths; `change` is given its root and its <compiler>."""
    root = ElementTree.parse(file).getroot()
    compiler = root.find("compiler")
    compiler = ElementTree.SubElement(root, "compiler") if compiler is None else compiler
    for key in ("meshdir", "texturedir"):
        compiler.set(key, str(file.parent / compiler.get(key, compiler.get("assetdir", ""))))
    compiler.attrib.pop("assetdir", None)
    change(root, compiler)
    scene = folder / f"{file.parent.name}_{file.name}"
    scene.write_text(ElementTree.tostring(root, encoding="unicode"))
    return scene


def _lowest(file: Path) -> float:
    """Height of the lowest point of a machine's shapes that may touch, at its start, m."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
    mujoco.mj_forward(model, data)
    return float(_bottoms(model, data).min())


def _bottoms(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Height of the lowest point of each shape (ngeom,), m; infinite for those at rest or that touch nothing."""
    lowest = np.full(model.ngeom, np.inf)
    for geom in np.flatnonzero(
        (model.geom_contype | model.geom_conaffinity) & (model.body_weldid[model.geom_bodyid] > 0)
    ):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            lowest[geom] = data.geom_xpos[geom, 2] - model.geom_size[geom, 0]
            continue
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        else:
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
            points = centre + corners * half
        lowest[geom] = (points @ data.geom_xmat[geom].reshape(3, 3)[2] + data.geom_xpos[geom, 2]).min()
    return lowest


def _numbers(values: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.9g}' for value in values)}]"
