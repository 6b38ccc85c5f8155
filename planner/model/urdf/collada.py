"""Triangles of a COLLADA file (.dae): its geometries, placed by the nodes of its scene, in metres.

As in ROS's viewer, the file's unit counts and its up axis does not.
"""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError

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
        return _placed(root) * (1.0 if unit is None else float(unit.get("meter", "1")))
    except (ElementTree.ParseError, ValueError, KeyError, IndexError, TypeError):
        raise ModelError("it is not a COLLADA file of plain triangles") from None


def _placed(root: ElementTree.Element) -> np.ndarray:
    geometries = {g.get("id", ""): _triangles(g) for g in root.iterfind("library_geometries/geometry")}
    shared = {node.get("id", ""): node for node in root.iterfind("library_nodes//node")}
    waiting = [(node, np.eye(4)) for node in root.iterfind("library_visual_scenes/visual_scene/node")]
    if not waiting:
        return np.concatenate([np.empty((0, 3, 3)), *geometries.values()])
    found = [np.empty((0, 3, 3))]
    for _ in range(_MAX_NODES):
        if not waiting:
            return np.concatenate(found)
        node, T = waiting.pop()
        T = T @ _transform(node)
        for instance in node.iterfind("instance_geometry"):
            triangles = geometries[instance.get("url", "")[1:]]
            found.append(triangles @ T[:3, :3].T + T[:3, 3])
        inside = [*node.iterfind("node"), *(shared[i.get("url", "")[1:]] for i in node.iterfind("instance_node"))]
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


def _transform(node: ElementTree.Element) -> np.ndarray:
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
