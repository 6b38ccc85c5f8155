"""Triangles of a binary glTF file (.glb): positions of its meshes, placed by the nodes of its scenes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from planner.base.errors import ModelError

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TRIANGLES = 4
_MAX_NODES = 10_000
_MAX_TRIANGLES = 1_000_000  # a few lines can name a mesh many times


def glb_triangles(content: bytes) -> np.ndarray:
    """Triangles (n, 3, 3) of the file's own axes, m.

    Raises:
        ModelError: It is not a file of this kind, or a compressed one.
    """
    try:
        length = int.from_bytes(content[12:16], "little")
        scene = json.loads(content[20 : 20 + length])
        return _placed(scene, content[28 + length :])
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError):
        raise ModelError("it is not a glTF file of plain triangles") from None


def _placed(scene: dict[str, Any], data: bytes) -> np.ndarray:
    nodes, found = scene.get("nodes", []), [np.empty((0, 3, 3))]
    children = {child for node in nodes for child in node.get("children", [])}
    waiting = [(node, np.eye(4)) for node in range(len(nodes)) if node not in children]
    for _ in range(_MAX_NODES):
        if not waiting:
            return np.concatenate(found)
        index, T = waiting.pop()
        node = nodes[index]
        T = T @ _transform(node)
        if "mesh" in node:
            for part in scene["meshes"][node["mesh"]]["primitives"]:
                if part.get("mode", _TRIANGLES) == _TRIANGLES:
                    points = _array(scene, part["attributes"]["POSITION"], data).astype(float)
                    corners = points if "indices" not in part else points[_array(scene, part["indices"], data).ravel()]
                    found.append((corners @ T[:3, :3].T + T[:3, 3]).reshape(-1, 3, 3))
        if sum(map(len, found)) > _MAX_TRIANGLES:
            raise ModelError(f"it has more than {_MAX_TRIANGLES} triangles")
        waiting += [(child, T) for child in node.get("children", [])]
    raise ModelError(f"it has more than {_MAX_NODES} nodes")


def _transform(node: dict[str, Any]) -> np.ndarray:
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
