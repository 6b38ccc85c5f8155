"""Read meshes of a URDF (STL, OBJ, COLLADA, binary glTF), and write them as binary STL files, which MuJoCo reads fast.

A mesh that is only drawn is stored at the resolution of a picture, one that only collides as its convex hull, with
which MuJoCo collides. Small meshes stay as they are. COLLADA and glTF files have scenes: nodes pose the meshes. As in
ROS's viewer, a COLLADA file's unit counts and its up axis does not.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.files import read_input
from planner.model.mjcf.model_file import LARGE, coarse

_MAX_NODES = 10_000
_MAX_TRIANGLES = 1_000_000  # a few lines can name a mesh many times
_FACES = ("triangles", "polylist", "polygons")
_PLACES = ("matrix", "translate", "rotate", "scale")


def collada_triangles(content: bytes) -> np.ndarray:
    """Triangles (n, 3, 3), m, of a file's scene, or of all its geometries where it has none.

    Raises:
        ModelError: It is not a COLLADA file.
    """
    if b"<!ENTITY" in content:
        raise ModelError("it declares XML entities")
    try:
        root = ElementTree.fromstring(content)
        for element in root.iter():
            element.tag = element.tag.rsplit("}", 1)[-1]  # its namespace says the version
        unit = root.find("asset/unit")
        return _collada_scene(root) * (1.0 if unit is None else float(unit.get("meter", "1")))
    except (ElementTree.ParseError, ValueError, KeyError, IndexError, TypeError):
        raise ModelError("it is not a COLLADA file of plain triangles") from None


def _collada_scene(root: ElementTree.Element) -> np.ndarray:
    geometries = {g.get("id", ""): _triangles(g) for g in root.iterfind("library_geometries/geometry")}
    shared = {node.get("id", ""): node for node in root.iterfind("library_nodes//node")}
    roots = root.findall("library_visual_scenes/visual_scene/node")

    def visit(node: ElementTree.Element) -> tuple[np.ndarray, list[np.ndarray], list[ElementTree.Element]]:
        meshes = [geometries[one.get("url", "")[1:]] for one in node.iterfind("instance_geometry")]
        inside = [*node.iterfind("node"), *(shared[one.get("url", "")[1:]] for one in node.iterfind("instance_node"))]
        return _collada_pose(node), meshes, inside

    return _scene(roots, visit) if roots else np.concatenate([np.empty((0, 3, 3)), *geometries.values()])


def _scene(roots: Iterable[Any], visit: Callable[[Any], tuple[np.ndarray, list[np.ndarray], list[Any]]]) -> np.ndarray:
    """Triangles (n, 3, 3) of a scene; `visit` returns a node's pose (4, 4), its meshes and the nodes below it."""
    waiting, found = [(node, np.eye(4)) for node in roots], [np.empty((0, 3, 3))]
    for _ in range(_MAX_NODES):
        if not waiting:
            return np.concatenate(found)
        node, T = waiting.pop()
        pose, meshes, inside = visit(node)
        T = T @ pose
        found += [triangles @ T[:3, :3].T + T[:3, 3] for triangles in meshes]
        if sum(map(len, found)) > _MAX_TRIANGLES:
            raise ModelError(f"it has more than {_MAX_TRIANGLES} triangles")
        waiting += [(child, T) for child in inside]
    raise ModelError(f"it has more than {_MAX_NODES} nodes")


def _triangles(geometry: ElementTree.Element) -> np.ndarray:
    """Triangles (n, 3, 3) in the geometry's frame; polygons are cut in fans."""
    found = [np.empty((0, 3, 3))]
    for mesh in geometry.iterfind("mesh"):
        sources = {source.get("id", ""): source for source in mesh.iterfind("source")}
        vertices = {
            v.get("id", ""): sources[i.get("source", "")[1:]]
            for v in mesh.iterfind("vertices")
            for i in v.iterfind("input")
            if i.get("semantic") == "POSITION"
        }
        for faces in (element for element in mesh if element.tag in _FACES):
            inputs = list(faces.iterfind("input"))
            stride = 1 + max(int(i.get("offset", "0")) for i in inputs)
            at = next(i for i in inputs if i.get("semantic") == "VERTEX")
            points = _positions(vertices[at.get("source", "")[1:]])
            lists = [
                np.array((p.text or "").split(), dtype=np.int64)[int(at.get("offset", "0")) :: stride]
                for p in faces.iterfind("p")
            ]
            flat = np.concatenate([np.empty(0, dtype=np.int64), *lists])
            if faces.tag == "polylist":
                counts = np.array(faces.findtext("vcount", "").split(), dtype=np.int64)
            else:
                counts = np.full(len(flat) // 3, 3) if faces.tag == "triangles" else np.array(list(map(len, lists)))
            found.append(points[flat[_fans(counts)]])
    return np.concatenate(found)


def _fans(counts: np.ndarray) -> np.ndarray:
    """(m, 3) places of the corners of triangles, in a list of polygons of so many corners each."""
    made = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), made)
    first = (np.cumsum(counts) - counts)[polygon]
    second = first + 1 + np.arange(len(polygon)) - (np.cumsum(made) - made)[polygon]
    return np.stack([first, second, second + 1], axis=1)


def _positions(source: ElementTree.Element) -> np.ndarray:
    numbers = np.array(source.findtext("float_array", "").split(), dtype=float)
    accessor = source.find("technique_common/accessor")
    stride = 3 if accessor is None else int(accessor.get("stride", "3"))
    return numbers[: len(numbers) // stride * stride].reshape(-1, stride)[:, :3]


def _collada_pose(node: ElementTree.Element) -> np.ndarray:
    T = np.eye(4)
    for element in (child for child in node if child.tag in _PLACES):
        numbers = np.array((element.text or "").split(), dtype=float)
        if element.tag == "matrix":
            T = T @ numbers.reshape(4, 4)
            continue
        step = np.eye(4)
        if element.tag == "translate":
            step[:3, 3] = numbers
        elif element.tag == "scale":
            step[:3, :3] = np.diag(numbers)
        else:  # Rodrigues' formula
            x, y, z = numbers[:3] / np.linalg.norm(numbers[:3])
            cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.radians(numbers[3])
            step[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        T = T @ step
    return T


_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TRIANGLES = 4


def glb_triangles(content: bytes) -> np.ndarray:
    """Triangles (n, 3, 3) of the file's own axes, m.

    Raises:
        ModelError: It is not a file of this kind, or a compressed one.
    """
    try:
        length = int.from_bytes(content[12:16], "little")
        scene = json.loads(content[20 : 20 + length])
        return _glb_scene(scene, content[28 + length :])
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError):
        raise ModelError("it is not a glTF file of plain triangles") from None


def _glb_scene(scene: dict[str, Any], data: bytes) -> np.ndarray:
    nodes = scene.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}

    def visit(index: int) -> tuple[np.ndarray, list[np.ndarray], list[int]]:
        node, meshes = nodes[index], []
        for part in scene["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            if part.get("mode", _TRIANGLES) == _TRIANGLES:
                points = _array(scene, part["attributes"]["POSITION"], data).astype(float)
                corners = points if "indices" not in part else points[_array(scene, part["indices"], data).ravel()]
                meshes.append(corners.reshape(-1, 3, 3))
        return _glb_pose(node), meshes, node.get("children", [])

    return _scene((node for node in range(len(nodes)) if node not in children), visit)


def _glb_pose(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    T = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), dtype=float)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, :3] *= np.array(node.get("scale", [1, 1, 1]), dtype=float)
    T[:3, 3] = node.get("translation", [0, 0, 0])
    return T


def _array(scene: dict[str, Any], accessor: int, data: bytes) -> np.ndarray:
    """(count, 1 or 3) numbers of an accessor."""
    form = scene["accessors"][accessor]
    view = scene["bufferViews"][form["bufferView"]]
    size = {"SCALAR": 1, "VEC3": 3}[form["type"]]
    kind = np.dtype(_TYPES[form["componentType"]])
    at, stride = view.get("byteOffset", 0) + form.get("byteOffset", 0), view.get("byteStride", size * kind.itemsize)
    count = form["count"]
    if not (at >= 0 and stride > 0 and count > 0 and at + (count - 1) * stride + size * kind.itemsize <= len(data)):
        raise ValueError
    return np.ndarray((count, size), kind, data, at, (stride, kind.itemsize))


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
        raise ModelError(f"{ending or 'a file without an ending'} is not read, expected {', '.join(readers)}")
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
