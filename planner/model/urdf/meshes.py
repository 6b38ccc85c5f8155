"""Meshes of a URDF as files that MuJoCo reads: OBJ and STL as they are, others written as a binary STL."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from planner.base.errors import ModelError
from planner.base.files import read_input
from planner.model.urdf.collada import collada_triangles
from planner.model.urdf.gltf import glb_triangles

MOST_FACES = 200_000  # that MuJoCo reads from an STL file
_CONVERTED = {".dae": collada_triangles, ".glb": glb_triangles}


def mesh_file(path: Path) -> tuple[bytes, str]:
    """Content and ending of a mesh for MuJoCo.

    Raises:
        ModelError: It cannot be read; the text is a phrase that says why.
    """
    ending = path.suffix.lower()
    if ending not in (".stl", ".obj", *_CONVERTED):
        raise ModelError(f"{ending or 'it has no ending, which'} is not read")
    content = read_input(path, "the mesh", raises=ModelError)
    if ending == ".obj":
        if b"\nf " not in b"\n" + content.replace(b"\r", b"\n"):
            raise ModelError("it has no faces")
        return content, ending
    if ending == ".stl" and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little") and len(content) > 84:
        faces = int.from_bytes(content[80:84], "little")
    else:
        triangles = _CONVERTED.get(ending, ascii_triangles)(content)
        if not len(triangles) or not np.all(np.isfinite(triangles)):
            raise ModelError("it has no triangles")
        content, faces = stl(triangles), len(triangles)
    if faces > MOST_FACES:
        raise ModelError(f"it has {faces} faces, more than {MOST_FACES}")
    return content, ".stl"


def stl(triangles: np.ndarray) -> bytes:
    """A binary STL of triangles (n, 3, 3)."""
    facets = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    facets["corners"] = triangles
    return bytes(80) + len(triangles).to_bytes(4, "little") + facets.tobytes()


def ascii_triangles(content: bytes) -> np.ndarray:
    """Triangles (n, 3, 3) of an STL that is text."""
    words = content.split()
    at = [k for k, word in enumerate(words) if word.lower() == b"vertex"]
    try:
        numbers = np.array([words[k + 1 : k + 4] for k in at], dtype=float)
        return numbers.reshape(-1, 3, 3)
    except ValueError:
        raise ModelError("it is not an STL file") from None
