"""The 3-D view of the page: the shapes and poses of a film, drawn by three.js in the reader's browser.

The page has everything that it needs: no server and no network. Shapes are MuJoCo's own, as the film draws them; poses
are those of the bodies that move, in single precision. Meshes of many triangles are simplified by vertex clustering
(Rossignac and Borrel 1993), so that a page stays within some megabytes. Without WebGL the page keeps its film.
"""

from __future__ import annotations

import base64
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from planner.base.gl import load_mujoco
from planner.view.render.camera import scenery_of, whole_motion
from planner.view.render.environment import unobstructed, visible_model
from planner.view.render.film import Film
from planner.view.render.marks import Marks, ghost_paint
from planner.view.render.shapes import LinkCapsules
from planner.view.report.markup import json_block, render

if TYPE_CHECKING:
    from planner.proof.replays.replaying import Replay

RATE, MOST_FRAMES = 60.0, 900  # frames per second of the film's time; frames in all
TRIANGLES = 120_000  # of all meshes of a page together: some 3 MB
LEAST = 300  # of each
MOST_ENDS = 5  # whose paths are drawn where the film draws none
_ASPECT = 16.0 / 9.0  # width over height of the view
_KINDS = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")  # of mjtGeom


def view_3d(replay: Replay, ghost: str = "plan") -> Markup:
    """The view's HTML: its canvas and buttons, its data, three.js and the script that draws with it.

    `ghost` says what the ghost is.

    Raises:
        PlannerError: There is nothing to draw (see Film.of).
    """
    return render("view_3d.html", ghost=ghost, data=json_block(view_data(film_of(replay))))


def film_of(replay: Replay) -> Film:
    """The replay's film at the rate of the view."""
    start, end = float(replay.t[0]), float(replay.t[-1])
    film = Film.of(replay, np.array([start]))
    frames = int(np.clip((end - start) * RATE / film.appearance.speed, 1, MOST_FRAMES))
    return Film.of(replay, np.linspace(start, end, frames + 1))


def view_data(film: Film) -> dict[str, Any]:
    """What the script draws, as JSON values; lengths in m, colours 0 to 1, quaternions w first."""
    mujoco, model = load_mujoco(), visible_model([film])
    seen, scenery = unobstructed(film, model), scenery_of(model, film.appearance)[0]
    if not seen.trail:
        film = replace(film, appearance=replace(film.appearance, trail=ends(model, scenery)))
    data = mujoco.MjData(model)
    data.qpos[:] = film.qpos[0]
    mujoco.mj_forward(model, data)
    shapes = drawn_shapes(model, data)
    moving = sorted({int(body) for body, *_ in shapes if model.body_weldid[body]})
    of_body = {body: number for number, body in enumerate(moving)}
    listed, meshes = [], dict[int, int]()
    for body, kind, size, place, colour, mesh in shapes:
        one: dict[str, Any] = {"kind": kind, "size": _short(size), "at": _short(place), "colour": _short(colour)}
        one["body"] = of_body.get(body, -1)
        if one["body"] < 0:  # at rest in the world
            one["at"] = _short(place_in_world(data.xpos[body], data.xquat[body], place))
        one["ghost"] = one["body"] >= 0 and not scenery[body]
        if mesh >= 0:
            one["mesh"] = meshes.setdefault(mesh, len(meshes))
        listed.append(one)
    marks = Marks(film, model, ghost_paint(seen))
    follows, target, distance = False, np.asarray(seen.look_at), seen.distance
    if seen.accompany is not None and distance is not None:
        follows = True
    else:
        target, distance = whole_motion([film], model, seen, _ASPECT, True)
    return {
        "t": _short(film.t), "speed": seen.speed, "shapes": listed, "meshes": _meshes(model, list(meshes)),
        "bodies": len(moving), "poses": _packed(body_poses(model, film.qpos, moving)),
        "ghost": _packed(body_poses(model, film.ghost_qpos, moving)), "ghost_colour": _short(ghost_paint(seen)),
        "ghost_offset": _short(seen.ghost_offset), "contacts": film.forces.shape[1],
        "forces": _packed(_forces(film)), "lines": [[_short(points), _short(paint)] for points, paint in marks.lines],
        "goals": [_short(place) for place in marks.goals],
        "tendons": _tendons(model, film.qpos), "ghost_tendons": _tendons(model, film.ghost_qpos),
        "goal_line": _short(seen.goal_line or []),
        "size": float(marks.size or distance), "shift": _packed(film.shift) if follows else "",
        "camera": {"target": _short(target), "distance": float(distance), "azimuth": seen.azimuth,
                   "elevation": seen.elevation, "fovy": float(model.vis.global_.fovy)},
    }  # fmt: skip


def drawn_shapes(model: Any, data: Any) -> list[tuple[int, str, np.ndarray, np.ndarray, np.ndarray, int]]:
    """(body, kind, size (3,), place and quaternion in the body (7,), colour (4,), mesh or -1) of what MuJoCo draws.

    Height fields are meshes, numbered after those of the model.
    """
    mujoco = load_mujoco()
    scene = mujoco.MjvScene(model, model.ngeom + model.nsite + 2 * model.nbody + 1000)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene)
    found = []
    for geom in scene.geoms[: scene.ngeom]:
        number, colour = geom.objid, np.array(geom.rgba)
        if geom.objtype != mujoco.mjtObj.mjOBJ_GEOM or colour[3] <= 0.0 or geom.type >= len(_KINDS):
            continue
        kind, mesh = _KINDS[geom.type], -1
        if kind == "plane" and geom.matid >= 0 and np.any(model.mat_texid[geom.matid] >= 0):
            colour[:3] = 1.0  # that of the material goes with its picture, and with the film's lamps
        if kind in ("mesh", "hfield"):
            mesh = int(model.geom_dataid[number]) + (model.nmesh if kind == "hfield" else 0)
            kind = "mesh"
        place = np.concatenate([model.geom_pos[number], model.geom_quat[number]])
        found.append((int(model.geom_bodyid[number]), kind, np.array(geom.size), place, colour, mesh))
    links = LinkCapsules(model)
    for link in links.capsules:
        along, quat = link.end - link.start, np.empty(4)
        length = float(np.linalg.norm(along))
        mujoco.mju_quatZ2Vec(quat, along / length if length else np.array([0.0, 0.0, 1.0]))
        size, middle = np.array([links.radius, 0.0, 0.5 * length]), 0.5 * (link.start + link.end)
        found.append((link.body, "capsule", size, np.concatenate([middle, quat]), np.array(links.paint), -1))
    return found


def ends(model: Any, scenery: np.ndarray) -> tuple[str, ...]:
    """Names of the machine's ends, its hands and feet: of each moving body beyond which no other moves.

    It is the named site or body on it that is farthest from its joint. `scenery` (nbody,) tells what is no part of the
    machine; of more than `MOST_ENDS` ends there is none.
    """
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rigid = model.body_weldid
    carried = {int(rigid[model.body_parentid[body]]) for body in range(1, model.nbody) if rigid[body] == body}
    found = []
    for last in sorted({int(body) for body in rigid if body and not scenery[body]} - carried):
        sites = [(data.site_xpos[i], model.site(i).name) for i in range(model.nsite)
                 if rigid[model.site_bodyid[i]] == last]  # fmt: skip
        bodies = [(data.xpos[i], model.body(i).name) for i in range(1, model.nbody) if rigid[i] == last]
        far = [(float(np.linalg.norm(at - data.xpos[last])), name) for at, name in sites + bodies if name]
        found += [max(far)[1]] if far else []
    return tuple(found) if len(found) <= MOST_ENDS else ()


def place_in_world(position: np.ndarray, quaternion: np.ndarray, place: np.ndarray) -> np.ndarray:
    """A place (7,) in a frame, in the world."""
    mujoco, at, quat = load_mujoco(), np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(at, place[:3], quaternion)
    mujoco.mju_mulQuat(quat, quaternion, place[3:])
    return np.concatenate([position + at, quat])


def body_poses(model: Any, qpos: np.ndarray, bodies: list[int]) -> np.ndarray:
    """(F, B, 7) positions and quaternions of bodies in poses (F, nq)."""
    mujoco, found = load_mujoco(), np.empty((len(qpos), len(bodies), 7))
    data = mujoco.MjData(model)
    for here, pose in zip(found, qpos, strict=True):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        here[:, :3], here[:, 3:] = data.xpos[bodies], data.xquat[bodies]
    return found


def _tendons(model: Any, qpos: np.ndarray) -> list[dict[str, Any]]:
    """Colours, widths and paths (F, P, 3), in poses (F, nq), of the spatial tendons that can be seen."""
    mujoco, found = load_mujoco(), []
    data = mujoco.MjData(model)
    seen = [t for t in range(model.ntendon) if model.tendon_rgba[t, 3] > 0.0]
    paths: dict[int, list[np.ndarray]] = {t: [] for t in seen}
    for pose in qpos if seen else ():
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        points = data.wrap_xpos.reshape(-1, 3)
        for t in seen:
            paths[t].append(points[data.ten_wrapadr[t] : data.ten_wrapadr[t] + data.ten_wrapnum[t]].copy())
    for t in seen:
        most = max(map(len, paths[t]))
        if most > 1:  # fixed tendons have no path; one that wraps less now ends in its last point
            path = [np.concatenate([one, np.repeat(one[-1:], most - len(one), axis=0)]) for one in paths[t]]
            colour = model.mat_rgba[model.tendon_matid[t]] if model.tendon_matid[t] >= 0 else model.tendon_rgba[t]
            found.append({"colour": _short(colour), "width": float(model.tendon_width[t]), "points": most,
                          "path": _packed(np.array(path))})  # fmt: skip
    return found


def _forces(film: Film) -> np.ndarray:
    """(F, C, 6) feet and vectors of the contact forces as the film draws them; NaN where there is none."""
    feet = film.points + np.asarray(film.appearance.force_offset)
    return np.concatenate([feet, film.appearance.force_scale * film.forces], axis=-1)


def _meshes(model: Any, numbers: list[int]) -> list[dict[str, str]]:
    """Vertices (V, 3) and triangles (T, 3) of meshes, simplified where they have too many triangles together."""
    whole = [mesh_of(model, number) for number in numbers]
    share = min(1.0, TRIANGLES / max(sum(len(faces) for _, faces in whole), 1))
    found = [simplified(vertices, faces, max(LEAST, int(share * len(faces)))) for vertices, faces in whole]
    return [{"vertices": _packed(vertices), "triangles": _packed(faces, np.uint32)} for vertices, faces in found]


def mesh_of(model: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (T, 3) of a mesh, or of the upper side of a height field: see drawn_shapes()."""
    if number >= model.nmesh:
        return _height_field(model, number - model.nmesh)
    first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    vertices = np.array(model.mesh_vert[first : first + count], dtype=float)
    first, count = model.mesh_faceadr[number], model.mesh_facenum[number]
    return vertices, np.array(model.mesh_face[first : first + count])


def _height_field(model: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a height field; a cell's diagonal is that of MuJoCo's rays."""
    rows, columns, first = model.hfield_nrow[number], model.hfield_ncol[number], model.hfield_adr[number]
    half_x, half_y, high, _ = model.hfield_size[number]
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    heights = high * model.hfield_data[first : first + rows * columns]
    corner = (columns * np.arange(rows - 1)[:, None] + np.arange(columns - 1)).reshape(-1, 1)
    cells = [corner + offset for offset in (0, 1, columns + 1, 0, columns + 1, columns)]
    return np.stack([x.ravel(), y.ravel(), heights], axis=-1), np.concatenate(cells, axis=1).reshape(-1, 3)


def simplified(vertices: np.ndarray, faces: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and at most some `most` triangles (T, 3) of a mesh, by the finest grid that gives as few.

    Vertices in one cell of the grid become their mean; triangles that lose a side go.
    """
    if len(faces) <= most:
        return vertices, faces
    low, side = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    coarse, fine, best = 2, 1024, (vertices, faces)
    while fine - coarse > 1:
        cells = (coarse + fine) // 2
        keys = np.floor((vertices - low) / (side / cells * (1.0 + 1e-9))).astype(np.int64)
        _, cell = np.unique(keys, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        merged = cell[faces]
        a, b, c = merged.T
        merged = np.unique(merged[(a != b) & (b != c) & (c != a)], axis=0)
        if len(merged) > most:
            fine = cells
            continue
        weight = np.bincount(cell)
        means = np.stack([np.bincount(cell, vertices[:, k]) / weight for k in range(3)], axis=-1)
        coarse, best = cells, (means, merged)
    return best


def _packed(values: np.ndarray, kind: Any = np.float32) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def _short(values: Any) -> list[Any]:
    """Numbers of an array as nested lists, in six digits."""
    return [_short(row) for row in values] if np.ndim(values) > 1 else [float(f"{v:.6g}") for v in values]
