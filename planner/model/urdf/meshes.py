"""Meshes of a URDF as binary STL files, which MuJoCo reads fast.

What is only seen is stored on the grid of a picture, what only touches as its convex hull, which is what MuJoCo
collides with. Small meshes stay as they are.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from planner.base.errors import ModelError
from planner.base.files import read_input
from planner.model.mjcf.meshes import LARGE, coarse
from planner.model.urdf.collada import collada_triangles
from planner.model.urdf.gltf import glb_triangles

MAX_FACES = 200_000
"""That MuJoCo reads from an STL file."""
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_HEADER = 84  # bytes


def mesh_triangles(path: Path) -> np.ndarray:
    """Triangles (n, 3, 3) of a mesh file.

    Raises:
        ModelError: It cannot be read; the text is a phrase that says why.
    """
    readers = {".stl": stl_triangles, ".obj": obj_triangles, ".dae": collada_triangles, ".glb": glb_triangles}
    ending = path.suffix.lower()
    if ending not in readers:
        raise ModelError(f"{ending or 'a file without an ending'} is not read")
    triangles = readers[ending](read_input(path, "the mesh", raises=ModelError))
    if not len(triangles) or not np.all(np.isfinite(triangles)):
        raise ModelError("it has no triangles of finite size")
    if not np.any(np.ptp(triangles.reshape(-1, 3), axis=0)):
        raise ModelError("all its triangles are one point")
    return triangles


def stl(triangles: np.ndarray) -> bytes:
    """A binary STL of triangles (n, 3, 3)."""
    if len(triangles) > MAX_FACES:
        raise ModelError(f"it has {len(triangles)} faces, expected at most {MAX_FACES}")
    facets = np.zeros(len(triangles), dtype=_FACET)
    facets["corners"] = triangles
    return bytes(_HEADER - 4) + len(triangles).to_bytes(4, "little") + facets.tobytes()


def on_grid(triangles: np.ndarray) -> np.ndarray:
    """Triangles at the resolution of a picture; those of a small mesh as they are."""
    if len(triangles) * _FACET.itemsize < LARGE:
        return triangles
    vertices, faces = coarse(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    return vertices[faces] if 0 < len(faces) < len(triangles) else triangles


def hull(triangles: np.ndarray) -> np.ndarray:
    """Triangles of the convex hull; those of a small or flat mesh as they are."""
    if len(triangles) * _FACET.itemsize < LARGE:
        return triangles
    from scipy.spatial import ConvexHull, QhullError  # half a second that models without large meshes need not wait

    points = np.unique(triangles.reshape(-1, 3).astype(np.float32), axis=0)
    try:
        return points[ConvexHull(points.astype(float)).simplices].astype(float)
    except (QhullError, ValueError):  # ValueError: too few points
        return triangles


def stl_triangles(content: bytes) -> np.ndarray:
    """Triangles (n, 3, 3) of an STL, binary or text."""
    count = int.from_bytes(content[_HEADER - 4 : _HEADER], "little")
    if len(content) >= _HEADER + count * _FACET.itemsize and (count or not content.lstrip().startswith(b"solid")):
        return np.frombuffer(content, _FACET, count, _HEADER)["corners"].astype(float)
    words = content.split()
    at = [k for k, word in enumerate(words) if word.lower() == b"vertex"]
    try:
        return np.array([words[k + 1 : k + 4] for k in at], dtype=float).reshape(-1, 3, 3)
    except ValueError:
        raise ModelError("it is not an STL file") from None


def obj_triangles(content: bytes) -> np.ndarray:
    """Triangles (n, 3, 3) of an OBJ; polygons are cut in fans."""
    vertices: list[list[bytes]] = []
    corners: list[int] = []
    try:
        for line in content.replace(b"\\\n", b" ").splitlines():
            words = line.split()
            if words[:1] == [b"v"]:
                vertices.append(words[1:4])
            elif words[:1] == [b"f"]:
                face = [int(word.split(b"/", 1)[0]) for word in words[1:]]
                face = [index - 1 if index > 0 else len(vertices) + index for index in face]
                corners += [index for b, c in itertools.pairwise(face[1:]) for index in (face[0], b, c)]
        points = np.array(vertices, dtype=float).reshape(-1, 3)
        return points[np.array(corners, dtype=np.int64)].reshape(-1, 3, 3)
    except (ValueError, IndexError):
        raise ModelError("it is not an OBJ file") from None
