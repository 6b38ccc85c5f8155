"""Obstacles that are added to a model's file, and pairs of its bodies that are not to touch each other.

    {shape = "box", size = [0.1, 0.4, 0.5], position = [0.5, 0, 0.25]}      edges, m
    {shape = "mesh", file = "crate.stl", orientation = {yaw = 30}}

They are geoms of the world that collide with whatever can collide in the file; a mesh is its convex hull, with which
MuJoCo collides. Plan, replay and pictures all have them: after the file is opened nothing distinguishes them from geoms
that it had before.

Bodies of `exclude = [["palm", "thumb"]]` do not touch each other in planning, replay and film, in any format; the
verdict names them. Shapes of a file often overlap where the real robot's do not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import SubElement

import numpy as np

from planner.base.arguments import array, choice, did_you_mean, numbers, quaternion, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.files import printable
from planner.model.mjcf.attached import attachments, records_of, with_attached
from planner.model.mjcf.model_file import ModelFile
from planner.model.mjcf.model_index import NEVER_REPLAYED, ModelIndex, compile_model
from planner.model.mjcf.text import written
from planner.model.urdf.meshes import hull, mesh_triangles, stl

SIZES = {
    "box": (3, "its three edges, m: [0.1, 0.2, 0.3]"), "sphere": (1, "its radius, m: 0.1"),
    "capsule": (2, "its radius and its length, m: [0.1, 0.4]"),
    "cylinder": (2, "its radius and its length, m: [0.1, 0.4]"), "plane": (0, "none"), "mesh": (0, "none"),
}  # fmt: skip
"""How many numbers a shape's size has, and which, with an example; a capsule's length is that between its caps."""
# Whatever the file's defaults are: MuJoCo's own values of what a default class may set.
_PLAIN = {
    "condim": "3", "friction": "1 0.005 0.0001", "priority": "0", "solmix": "1", "solref": "0.02 1",
    "solimp": "0.9 0.95 0.001 0.5 2", "margin": "0", "gap": "0", "group": "0", "rgba": "0.8 0.45 0.3 1",
}  # fmt: skip


@dataclass(frozen=True)
class Obstacle:
    """A shape at rest.

    Attributes:
        shape: One of SIZES.
        size: m: the edges of a box, the radius of a sphere, radius and length of a capsule or cylinder (along z).
        position: (3,) m in the world, of its centre; of a mesh, of its file's origin; 0 for these and planes.
        orientation: Quaternion, w first, or a table of roll, pitch and yaw in degrees. A plane's normal is its z.
        name: Of the geom; by default obstacle, numbered if there are several.
        file: STL, OBJ, DAE or GLB of a mesh.
        scale: Of a mesh: a number or three.

    Raises:
        PlannerError: An unknown shape, or a value out of range.
    """

    shape: str
    size: Any = None
    position: Any = None
    orientation: Any = (1.0, 0.0, 0.0, 0.0)
    name: str = ""
    file: str | Path | None = None
    scale: Any = 1.0

    def __post_init__(self) -> None:
        choice("shape of an obstacle", self.shape, SIZES)
        if not isinstance(self.name, str) or not self.name.isprintable():
            raise PlannerError(f"name of an obstacle is {short_repr(self.name)}, expected printable characters.")
        if (self.shape == "mesh") != (self.file is not None) or not isinstance(self.file, (str, Path, type(None))):
            raise PlannerError(
                f"file of obstacle {self.shape!r} is {short_repr(self.file)}, expected the path of a mesh where the "
                "shape is 'mesh', and none elsewhere."
            )
        quaternion("orientation of an obstacle", self.orientation)
        _ = self.half_sizes, self.scales, self.place

    @property
    def half_sizes(self) -> np.ndarray:
        """The numbers of MJCF's size, m: radii and half lengths; () for a mesh, and for a plane without an end."""
        (count, words), given = SIZES[self.shape], _positive("size", () if self.size is None else self.size)
        if len(given) != count:
            raise PlannerError(f"size of obstacle {self.shape!r} is {short_repr(self.size)}, expected {words}.")
        return given * (0.5 if self.shape == "box" else np.array([1.0, 0.5])[:count])

    @property
    def place(self) -> np.ndarray:
        """(3,) the position, m."""
        if self.position is None and self.shape not in ("plane", "mesh"):
            raise PlannerError(
                f"obstacle {self.shape!r} has no key 'position', expected that of its centre, m: "
                "position = [0.4, 0, 0.5]."
            )
        return array("position of an obstacle", (0.0, 0.0, 0.0) if self.position is None else self.position, (3,))

    @property
    def scales(self) -> np.ndarray:
        """(3,) of a mesh."""
        given = _positive("scale", self.scale)
        if len(given) not in (1, 3):
            raise PlannerError(f"scale of an obstacle is {short_repr(self.scale)}, expected a number, or three.")
        return np.broadcast_to(given, 3)


def _positive(what: str, value: Any) -> np.ndarray:
    given = numbers(f"{what} of an obstacle", value).ravel()
    if not np.all((given > 0.0) & np.isfinite(given)):
        raise PlannerError(f"{what} of an obstacle is {short_repr(value)}, expected finite numbers above 0.")
    return given


def obstacles_of(value: Any) -> tuple[Obstacle, ...]:
    """Obstacles from one, from tables, or from a list of either, each with a name.

    Raises:
        PlannerError: A key that there is not, a wrong value, or a name twice.
    """
    given = records_of(Obstacle, value, "obstacle", "shape", f"one of: {', '.join(SIZES)}")
    names = [one.name or ("obstacle" if len(given) == 1 else f"obstacle {k}") for k, one in enumerate(given, 1)]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise PlannerError(f"name of an obstacle is {twice[0]!r} twice, expected one of each name.")
    return tuple(replace(one, name=name) for one, name in zip(given, names, strict=True))


def with_obstacles(file: ModelFile, given: Sequence[Obstacle]) -> ModelFile:
    """A file with obstacles in its world, compiled again.

    Raises:
        PlannerError: A name that is taken.
        ModelError: A mesh cannot be read, nothing of the file can collide, or MuJoCo refuses the result.
    """
    if not given:
        return file
    root, files, model = copy.deepcopy(file.root), dict(file.files), file.survey.model
    masks = {
        key: int(np.bitwise_or.reduce(getattr(model, f"geom_{other}"), initial=0))
        for key, other in (("contype", "conaffinity"), ("conaffinity", "contype"))
    }
    if not any(masks.values()):
        raise ModelError(
            f"nothing of {file.name} can touch an obstacle, since contype and conaffinity of all its shapes are 0: "
            "expected shapes that collide (of a URDF: <collision>)."
        )
    world, assets = SubElement(root, "worldbody"), SubElement(root, "asset")
    for one in given:
        stored = f"{one.name}.stl"
        if one.name in [geom.name for geom in map(model.geom, range(model.ngeom))] or stored in files:
            raise PlannerError(f"name of an obstacle is {one.name!r}, which the model has: expected another name.")
        attributes = {"name": one.name, "type": one.shape, **{key: str(bits) for key, bits in masks.items()}, **_PLAIN}
        attributes["pos"] = written(*one.place)
        attributes["quat"] = written(*quaternion("orientation", one.orientation))
        if one.shape == "mesh":
            files[stored] = _hull_of(one)
            attributes["mesh"] = one.name
            SubElement(assets, "mesh", {"name": one.name, "file": stored, "scale": "1 1 1", "inertia": "shell"})
        else:
            attributes["size"] = written(*one.half_sizes) if one.shape != "plane" else "0 0 0.05"
        SubElement(world, "geom", attributes)
    survey = ModelIndex(compile_model(root, files, file.name))
    return file._replace(root=root, files=files, survey=survey, is_compiled=True)


def _hull_of(obstacle: Obstacle) -> bytes:
    """The STL of a mesh's convex hull."""
    path = Path(str(obstacle.file))
    try:
        return stl(hull(mesh_triangles(path) * obstacle.scales))
    except ModelError as error:
        why = str(error).rstrip(".")
        raise ModelError(f"the mesh {printable(path)} of {obstacle.name!r} cannot be used: {why}.") from None


BodyPair = tuple[str, str]


def edits_of(attach: Any = None, obstacles: Any = None, exclude: Any = None) -> Callable[[ModelFile], ModelFile]:
    """The edits of a file, checked, in the order in which they are made.

    Raises:
        PlannerError: See attachments, obstacles_of and excluded_pairs.
    """
    given, around, apart = attachments(attach), obstacles_of(obstacles), excluded_pairs(exclude)
    return lambda file: with_excluded(with_obstacles(with_attached(file, given), around), apart)


def excluded_pairs(value: Any) -> tuple[BodyPair, ...]:
    """Pairs of names from a list of them; none for None.

    Raises:
        PlannerError: It is no list of pairs of two names.
    """
    pairs = [] if value is None else value
    if not isinstance(pairs, list | tuple) or not all(
        isinstance(pair, list | tuple) and len(pair) == 2 and all(isinstance(name, str) and name for name in pair)
        and pair[0] != pair[1] for pair in pairs
    ):  # fmt: skip
        raise PlannerError(
            f'exclude is {short_repr(value)}, expected a list of pairs of two bodies or shapes: [["palm", "thumb"]].'
        )
    return tuple((str(first), str(second)) for first, second in pairs)


def with_excluded(file: ModelFile, given: Sequence[BodyPair]) -> ModelFile:
    """A file in which the bodies of each pair do not touch, compiled again; a shape stands for its body.

    Raises:
        ModelError: A name that the model does not have, two shapes of one body, or a shape of a body without a name.
    """
    if not given:
        return file
    root, model = copy.deepcopy(file.root), file.survey.model
    bodies = {model.body(i).name: i for i in range(model.nbody)}
    shapes = {model.geom(i).name: int(model.geom_bodyid[i]) for i in range(model.ngeom)}
    places = {name: place for name, place in (shapes | bodies).items() if name}
    section, texts = SubElement(root, "contact"), SubElement(root, "custom")
    for k, pair in enumerate(given, 1):
        for name in pair:
            if name not in places:
                hint = did_you_mean(name, list(places))
                raise ModelError(f"exclude names {name!r}, expected a body or a shape of {file.name}.{hint}")
        first, second = (model.body(places[name]).name for name in pair)
        if not (first and second):
            raise ModelError(
                f"exclude names {pair[0]!r} and {pair[1]!r}, of a body without a name: expected one with it."
            )
        if first == second:
            raise ModelError(f"exclude names {pair[0]!r} and {pair[1]!r}, which belong to one body: they never touch.")
        SubElement(section, "exclude", {"body1": first, "body2": second})
        phrase = f"contact of {first} and {second}, which `exclude` names"
        SubElement(texts, "text", {"name": f"{NEVER_REPLAYED}exclude {k}", "data": phrase})
    survey = ModelIndex(compile_model(root, file.files, file.name))
    return file._replace(root=root, survey=survey, is_compiled=True)
