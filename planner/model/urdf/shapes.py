"""Write a link's shapes as MJCF geoms, find their meshes and collect these files, and find which links overlap.

Shapes are of two groups: MuJoCo draws groups 0 to 2, so those that touch are drawn where a link has no others.
Meshes are named by package://, model:// and file:// addresses, or by paths relative to the URDF.

A URDF cannot say which links never touch, so collections leave hulls that run into each other, and planners of arms
take such pairs out. Here the verdict names them. Shapes that only lie flush, as closed fingers do, stay; so do links
at rest that the arm meets farther out than its base: a table may be one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_file import COARSE
from planner.model.mjcf.model_index import NEVER_REPLAYED, body_chain, compile_model
from planner.model.mjcf.text import written
from planner.model.urdf.meshes import hull, mesh_triangles, on_grid, stl
from planner.model.urdf.parse import Link, Numbers, Pose, Shape

_ADDRESS = re.compile(r"^(package|model)://?([^/\\]+)[/\\](.*)$", re.S)


@dataclass(frozen=True)
class Packages:
    """Where files are sought: beside the URDF, in folders above it, and in folders that the user names."""

    folder: Path  # of the URDF
    paths: tuple[Path, ...] = ()  # of packages, or of folders that hold them
    meshdir: str = ""

    def find(self, file: str) -> Path | None:
        """The path of a file that there is; None where there is none."""
        return next((path for path in self._places(file) if _is_file(path)), None)

    def _places(self, file: str) -> Iterator[Path]:
        if address := _ADDRESS.match(file):
            package, rest = address[2], address[3]
            parents = [self.folder, *self.folder.parents]
            for place in (*self.paths, *parents):
                yield place / package / rest
                if place.name == package:
                    yield place / rest
            for place in (*self.paths, *parents):  # a package in a folder of another name
                yield place / rest
            return
        file = unquote(file.removeprefix("file://")) if file.startswith("file:/") else file
        for place in (self.folder, *self.paths):
            yield place / file
        if self.meshdir:  # of MuJoCo's extension, which takes the names without their folders
            yield self.folder / self.meshdir / re.split(r"[/\\]", file)[-1]


def _is_file(path: Path) -> bool:
    try:
        return os.path.isfile(path)
    except ValueError:  # a null character
        return False


def packages_of(path: Path | None, package_path: tuple[str | os.PathLike[str], ...], meshdir: str) -> Packages:
    """The places for the files of the URDF at `path`; of a text, the working directory."""
    folder = Path(os.path.abspath(path)).parent if path is not None else Path.cwd()
    return Packages(folder, tuple(Path(os.path.abspath(one)) for one in package_path), meshdir)


SEEN, TOUCHING = "2", "3"
Form = Callable[[np.ndarray], np.ndarray]
_GREY = (0.6, 0.6, 0.62, 1.0)


@dataclass
class GeomWriter:
    """The geoms of a model that is being written."""

    root: Element
    packages: Packages
    files: dict[str, bytes] = field(default_factory=dict)
    meshes: dict[tuple[str, Numbers, Form | None], str] = field(default_factory=dict)  # MJCF's names
    triangles: dict[Path, np.ndarray] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)  # why a mesh is left out, by its name in the URDF
    unseen: list[str] = field(default_factory=list)  # meshes that are left out of pictures
    untouched: list[str] = field(default_factory=list)  # phrases of those that are left out of contacts
    touching: dict[str, list[Shape]] = field(default_factory=dict)  # shapes that may touch, by link
    names: set[str] = field(default_factory=set)

    def add(self, body: Element, link: Link) -> None:
        """Add the geoms of a link to its body."""
        seen = [attributes for shape in link.visuals if (attributes := self._visual(shape)) is not None]
        for attributes in seen:
            SubElement(body, "geom", {**attributes, "contype": "0", "conaffinity": "0", "group": SEEN})
        for shape in link.collisions:
            attributes = self._geom(shape, hull if seen else None)
            if attributes is None:
                what = f"mesh {shape.file!r}" if shape.file else shape.kind
                self.untouched.append(f"the collision {what} of link {link.name!r} ({self._why(shape)})")
                continue
            if not seen:
                attributes["rgba"] = written(*(shape.rgba or _GREY))
            group = TOUCHING if seen else SEEN
            SubElement(body, "geom", {"name": self._named(link.name), **attributes, "group": group})
            self.touching.setdefault(link.name, []).append(shape)

    def lowest(self, poses: dict[str, np.ndarray]) -> float:
        """The lowest z of what may touch, at these poses of links; infinite where nothing does."""
        lows = [
            self._lowest(shape, pose @ shape.pose.T)
            for link, pose in poses.items() for shape in self.touching.get(link, ())
        ]  # fmt: skip
        return min(lows, default=float("inf"))

    def _lowest(self, shape: Shape, T: np.ndarray) -> float:
        down, z = np.abs(T[2, :3]), float(T[2, 3])
        if shape.kind == "mesh":
            path = self.packages.find(shape.file)
            return z if path is None else z + float(np.min(self.triangles[path] * shape.scale @ T[2, :3]))
        if shape.kind == "box":
            return z - float(down @ shape.size)
        radius, *half = shape.size
        along = down[2] * half[0] if half else 0.0
        across = np.sqrt(max(0.0, 1.0 - down[2] ** 2)) if shape.kind == "cylinder" else 1.0
        return z - float(along + across * radius)

    def missing_parts(self) -> list[str]:
        """Phrases of what is missing; meshes that are only seen are counted in one."""
        phrases = list(dict.fromkeys(self.untouched))
        if count := len(set(self.unseen)):
            first = self.unseen[0]
            phrases.append(f"{count} visual mesh{'es' * (count > 1)} (e.g. {first!r}: {self.unread[first]})")
        return phrases

    def _visual(self, shape: Shape) -> dict[str, str] | None:
        attributes = self._geom(shape, on_grid)
        if attributes is None:
            if shape.file:
                self.unseen.append(shape.file)
            return None
        return {**attributes, "rgba": written(*(shape.rgba or _GREY))}

    def _why(self, shape: Shape) -> str:
        return self.unread[shape.file] if shape.kind == "mesh" else "its size is 0"

    def _geom(self, shape: Shape, form: Form | None) -> dict[str, str] | None:
        """Attributes of a shape, None where it has no size or its mesh cannot be read."""
        if shape.kind != "mesh":
            return {"type": shape.kind, "size": written(*shape.size), **placed(shape.pose)} if all(shape.size) else None
        mesh = self._mesh(shape, form)
        return None if mesh is None else {"type": "mesh", "mesh": mesh, **placed(shape.pose)}

    def _mesh(self, shape: Shape, form: Form | None) -> str | None:
        """MJCF's name of a mesh in some form."""
        key = (shape.file, shape.scale, form)
        if shape.file in self.unread or key in self.meshes:
            return self.meshes.get(key)
        try:
            path = self.packages.find(shape.file)
            if path is None:
                raise ModelError("there is no such file")
            if path not in self.triangles:
                self.triangles[path] = mesh_triangles(path)
            triangles = self.triangles[path]
            content = stl(triangles if form is None else form(triangles))
        except ModelError as error:
            self.unread[shape.file] = str(error).rstrip(".")
            return None
        taken = {name.lower() for name in self.meshes.values()}  # MuJoCo finds files by names in lower case
        number, stem = 1, path.stem + ("" if form is not hull else " hull")
        while (name := stem if number == 1 else f"{stem} {number}").lower() in taken:
            number += 1
        file = next((known for known, other in self.files.items() if other == content), None)
        if file is None:  # the ending says that reading need not make it smaller
            file = f"{name}{COARSE if form is on_grid else '.'}stl"
            self.files[file] = content
        self.meshes[key] = name
        asset = self.root.find("asset")
        if asset is None:
            asset = Element("asset")
            self.root.insert(1, asset)
        # As a shell a mesh needs no volume; no mass depends on it.
        attributes = {"name": name, "file": file, "inertia": "shell"}
        if shape.scale != (1.0, 1.0, 1.0):
            attributes["scale"] = written(*shape.scale)
        SubElement(asset, "mesh", attributes)
        return name

    def _named(self, link: str) -> str:
        name, number = link, 1
        while name in self.names:
            number += 1
            name = f"{link} {number}"
        self.names.add(name)
        return name


def placed(pose: Pose) -> dict[str, str]:
    """Attributes of a pose, none where it is the identity."""
    found = {"pos": written(*pose.xyz)} if any(pose.xyz) else {}
    return found | ({"euler": written(*pose.rpy)} if any(pose.rpy) else {})


DEEP = 1e-3  # m: less is how the shapes were rounded
NEAR_BASE = 3  # joints that part a link from the base, at most
_NAMED = 3  # pairs


def exclude_overlaps(root: Element, files: dict[str, bytes], name: str) -> None:
    """Take contacts out of an MJCF tree between bodies that overlap by more than DEEP in its pose, put into its ranges.

    Raises:
        ModelError: MuJoCo refuses the model.
    """
    mujoco, model = load_mujoco(), compile_model(root, files, name)
    data = mujoco.MjData(model)
    for j in np.flatnonzero(model.jnt_limited):
        if model.jnt_type[j] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            i = int(model.jnt_qposadr[j])
            data.qpos[i] = np.clip(data.qpos[i], *model.jnt_range[j])
    mujoco.mj_fwdPosition(model, data)
    deep = data.contact.geom[data.contact.dist < -DEEP]
    solid = np.all(model.geom_type[deep] != int(mujoco.mjtGeom.mjGEOM_PLANE), axis=1)
    found = {(min(pair), max(pair)) for pair in map(tuple, model.geom_bodyid[deep[solid]].tolist())}
    pairs = sorted(pair for pair in found if pair[0] > 0 and _are_near(model, *pair))
    if not pairs:
        return
    names = [(model.body(a).name, model.body(b).name) for a, b in pairs]
    contact, texts = SubElement(root, "contact"), SubElement(root, "custom")
    for first, second in names:
        SubElement(contact, "exclude", {"body1": first, "body2": second})
    told = [f"{first} and {second}" for first, second in names[:_NAMED]]
    more = [f"{len(names) - _NAMED} more pairs"] if len(names) > _NAMED else []
    phrase = f"contact of {'; '.join([*told, *more])}, whose shapes overlap with all joints at zero"
    SubElement(texts, "text", {"name": f"{NEVER_REPLAYED}overlaps", "data": phrase})


def _are_near(model: Any, first: int, second: int) -> bool:
    """Whether both bodies move, or the one that does is at most NEAR_BASE joints from what does not."""
    joints = [int(model.body_jntnum[body_chain(model, body)].sum()) for body in (first, second)]
    return min(joints) > 0 or max(joints) <= NEAR_BASE
