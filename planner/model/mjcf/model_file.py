"""Open an MJCF file: its text with includes resolved, the files it names, and MuJoCo's compilation of it.

Meshes that are only drawn are stored at the resolution of a picture: their files are most of the bytes of a model. A
mesh is only drawn where none of its geoms can collide and none gives its body a mass. Its bounding box is divided in
GRID cells along its longest side, the vertices of a cell become one at their mean, and faces without area go. No mass,
no inertia and no contact depends on it.

Models that people hold in their hands, mujoco.MjSpec and elements of dm_control, are read as text and files. MuJoCo
writes the XML of a spec to six digits, unless its library is told to write all of them. What it wrote is compared with
what the spec itself compiles to, number by number, so no digit is lost in silence.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import ModelIndex, compile_model, mesh_vertices, pose
from planner.model.mjcf.text import is_text, model_tree

GRID = 200
"""Cells along the longest side of a mesh: where a link fills a film of 720 lines, one is some three pixels wide."""
LARGE = 100_000
"""Bytes; smaller files stay as they are."""
COARSE = ".coarse."
"""In the names of files that are at this resolution already."""


def coarsen_visual_meshes(root: ElementTree.Element, files: dict[str, bytes], model: Any) -> bool:
    """Replace large files of meshes that are only seen, in the XML and the files; returns whether there were any.

    Such a mesh becomes an OBJ without scale or reference pose.
    """
    elements = [
        mesh for mesh in root.iterfind("asset/mesh")
        if len(files.get(file := mesh.get("file", ""), b"")) >= LARGE and COARSE not in file
    ]  # fmt: skip
    if not elements:
        return False
    mujoco, seen, done = load_mujoco(), _only_seen(root, model), False
    for mesh in elements:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MESH, mesh.get("name", ""))
        if index not in seen:
            continue
        old, name = mesh.get("file", ""), f"{mesh.get('name')}{COARSE}obj"
        content = _coarse_obj(model, index)
        if 0 < len(content) < len(files[old]):
            files[name] = content
            for key in set(mesh.attrib) - {"name", "class", "smoothnormal"}:
                del mesh.attrib[key]
            # A default's scale is in the vertices already; a thin mesh may have no volume left, which MuJoCo asks for.
            mesh.attrib.update(file=name, scale="1 1 1", inertia="shell")
            done = True
    used = {element.get("file") for element in root.iter()}
    for name in [name for name in files if name.endswith((".obj", ".stl", ".msh")) and name not in used]:
        del files[name]
    return done


def _only_seen(root: ElementTree.Element, model: Any) -> set[int]:
    """Meshes whose geoms neither touch nor weigh anything, and have no texture."""
    mujoco = load_mujoco()
    by_geoms = any(compiler.get("inertiafromgeom") == "true" for compiler in root.iterfind("compiler"))
    weighed = [] if by_geoms else [body.get("name") for body in root.iter("body") if body.find("inertial") is not None]
    bodies = {mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in weighed if name} | {0}
    paired = {*map(int, model.pair_geom1), *map(int, model.pair_geom2)}
    geoms: dict[int, list[int]] = {}
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        geoms.setdefault(int(model.geom_dataid[geom]), []).append(int(geom))

    def seen(geom: int) -> bool:
        material = int(model.geom_matid[geom])
        plain = material < 0 or not np.any(model.mat_texid[material] >= 0)
        still = not (model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in paired)
        return plain and still and int(model.geom_bodyid[geom]) in bodies

    # A primitive may be fitted to a mesh too: it has its size from it, and the compiled model does not say so.
    named = [geom.get("mesh") for world in root.iterfind("worldbody") for geom in world.iter("geom")]
    return {
        mesh for mesh, uses in geoms.items()
        if all(map(seen, uses)) and named.count(model.mesh(mesh).name) == len(uses)
    }  # fmt: skip


def _coarse_obj(model: Any, index: int) -> bytes:
    """A compiled mesh on the grid, as the text of an OBJ in the frame of the mesh's file; empty if it has no area."""
    face, faces = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    T = pose(model.mesh_pos[index], model.mesh_quat[index])  # the compiler moved the mesh to its principal axes
    vertices = mesh_vertices(model, index) @ T[:3, :3].T + T[:3, 3]
    size = float(np.ptp(vertices, axis=0).max())
    means, corners = coarse(vertices, model.mesh_face[face : face + faces])
    if not len(corners):
        return b""
    digits = max(0, 4 - math.floor(math.log10(size)))  # a ten-thousandth of the mesh
    line = f"v %.{digits}f %.{digits}f %.{digits}f\n"
    points = (line * len(means)) % tuple(means.ravel().tolist())
    return (points + ("f %d %d %d\n" * len(corners)) % tuple((corners + 1).ravel().tolist())).encode()


def coarse(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and faces (m, 3) of a mesh on the grid; no faces if it is a wire, thinner than a cell."""
    size = float(np.ptp(vertices, axis=0).max())
    cells = np.floor((vertices - vertices.min(axis=0)) * (GRID / size)).astype(np.int64)
    cells = cells @ [(GRID + 1) ** 2, GRID + 1, 1]  # one number a cell, in the same order
    _, place, members = np.unique(cells, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(place, weights=column) for column in vertices.T], axis=1) / members[:, None]
    corners = place[faces]
    whole = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    corners = corners[whole]
    first = np.argmin(corners, axis=1)[:, None]  # the least corner goes first, so that equal faces are
    corners = np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1)
    n = len(means)  # at most one a cell, so that n^3 fits
    corners = np.unique(corners.astype(np.int64) @ [n * n, n, 1])
    corners = np.stack([corners // (n * n), corners // n % n, corners % n], axis=1)
    a, b, c = (means[corners[:, k]] for k in range(3))
    if np.linalg.norm(np.cross(b - a, c - a)) < 1e-6 * size**2:  # a wire, thinner than a cell
        corners = corners[:0]
    return means, corners


class ModelFile(NamedTuple):
    """A file as it was written; only its visual meshes are coarser, on which no fact of the survey depends."""

    root: ElementTree.Element  # Not to be changed
    files: dict[str, bytes]  # By the names that the text uses
    survey: ModelIndex  # Of the file with its own meshes
    name: str  # For a sentence
    is_compiled: bool  # Whether the survey's model is what root compiles to: no mesh is coarser
    payloads: tuple[str, ...] = ()  # Names of geoms that a plan does not model: attached payloads


def open_model_file(
    model: str | Path, assets: dict[str, bytes] | None = None, name: str = "", *, stored: bool = True
) -> ModelFile:  # fmt: skip
    """Read and compile a file or text; messages call it `name`, by default after its file.

    What is not to be stored keeps its visual meshes.

    Raises:
        ModelError: It cannot be read, or MuJoCo refuses it.
    """
    name = name or ("the model" if is_text(model) else f"the model {model}")
    root, files = model_tree(model, assets, stored=assets is not None)
    survey = ModelIndex(compile_model(root, files, name))
    coarser = stored and coarsen_visual_meshes(root, files, survey.model)
    return ModelFile(root, files, survey, name, not coarser)


DIGITS = 17  # of a double, none lost
TOLERANCE = 1e-12
"""Relative: the compiler turns frames of meshes and inertias back and forth, which rounds. Six digits are 1e-6."""
EXPECTED = "MJCF text, the path of a file, a mujoco.MjSpec or an element of dm_control.mjcf"


def mjcf_source(model: Any, assets: dict[str, bytes] | None = None) -> tuple[Any, dict[str, bytes] | None]:
    """A model as a text or path, and its files by the names that the text uses; the caller's object stays as it was.

    A text or path is returned as it is, with `assets`.

    Raises:
        ModelError: It is something else, MuJoCo refuses it, or its text would not be the same model.
    """
    if isinstance(model, (str, os.PathLike)):
        return model, assets
    mujoco = load_mujoco()
    if isinstance(model, mujoco.MjSpec):
        return _of_spec(model, assets or {})
    if hasattr(model, "to_xml_string") and hasattr(getattr(model, "root", None), "get_assets"):
        return model.root.to_xml_string(), {**model.root.get_assets(), **(assets or {})}
    if isinstance(model, mujoco.MjModel):
        raise ModelError(
            "the model is a compiled MjModel, which no longer has the text it was made of: pass that text, its path, "
            "or a spec of it, mujoco.MjSpec.from_file(path)."
        )
    raise ModelError(f"the model is a {type(model).__name__}, expected {EXPECTED}.")


def _of_spec(spec: Any, assets: dict[str, bytes]) -> tuple[str, dict[str, bytes]]:
    mujoco = load_mujoco()
    copy = spec.copy()
    copy.assets = {**spec.assets, **assets}
    try:
        own = copy.compile()
        with _all_digits():
            text = copy.to_xml()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ModelError(f"MuJoCo refuses the model: {' '.join(str(error).split())}.") from None
    root, files = model_tree(text, copy.assets, folder=Path(spec.modelfiledir))
    differs = different_field(own, compile_model(root, files))
    if differs:
        raise ModelError(
            f"the XML that MuJoCo {mujoco.__version__} writes of the spec has another {differs} than the spec itself: "
            "pass the text or the path that it was made of."
        )
    return ElementTree.tostring(root, encoding="unicode"), files


@contextmanager
def _all_digits() -> Iterator[None]:
    """A context in which MuJoCo writes numbers with all their digits, where its library has a function for that."""
    folder = Path(load_mujoco().__file__).parent
    files = [file for file in sorted(folder.glob("*mujoco.*")) if file.name.startswith(("libmujoco.", "mujoco.dll"))]
    library = ctypes.CDLL(str(files[0])) if files else None
    if not hasattr(library, "_mjPRIVATE__set_xml_precision"):  # the comparison refuses what is lost
        yield
        return
    assert library is not None  # it has the attribute
    before = library._mjPRIVATE__get_xml_precision()
    library._mjPRIVATE__set_xml_precision(DIGITS)
    try:
        yield
    finally:
        library._mjPRIVATE__set_xml_precision(before)


def different_field(first: Any, second: Any) -> str:
    """The name of a field of numbers in which two compiled models differ, or "" if there is none."""
    for a, b, before in ((first, second, ""), (first.opt, second.opt, "opt.")):
        for name in dir(a):
            if name.startswith("_") or not isinstance(value := getattr(a, name), (np.ndarray, float)):
                continue
            one, other = np.asarray(value), np.asarray(getattr(b, name))
            if one.shape != other.shape:
                return before + name
            if one.dtype.kind == "f" and not np.allclose(
                one, other, rtol=TOLERANCE, atol=TOLERANCE * np.abs(one).max(initial=1.0), equal_nan=True
            ):
                return before + name
    return ""
