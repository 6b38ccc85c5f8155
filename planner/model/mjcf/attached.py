"""Attach a payload or a tool to a frame of a model: its file is edited, so plan, replay and pictures all carry it.

    {frame = "hand", mass = 2.0}                                    a ball of aluminium
    {frame = "hand", mass = 2.0, size = [0.1, 0.1, 0.2]}            a box, m
    {frame = "flange", model = "gripper.xml"}                       the first body of another MJCF file

A plan models no contact of a payload. A size of its own touches in the replay in the user's file (read.read_opened); a
ball of aluminium is drawn in place of a size that was not given, and touches nothing: NEVER_REPLAYED says so.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import array, choice, number, numbers, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_file import ModelFile
from planner.model.mjcf.model_index import NEVER_REPLAYED, ModelIndex, compile_model
from planner.model.mjcf.text import is_text, model_tree, written

ALUMINIUM = 2700.0  # kg/m^3
COLOUR = "0.55 0.35 0.75 1"
Frame = tuple[ElementTree.Element, np.ndarray, np.ndarray]  # a body's element, and position and quaternion in it


@dataclass(frozen=True)
class Attachment:
    """A payload, or a body of another file, at a frame.

    Attributes:
        frame: Name of a site or body, whose axes it has.
        mass: kg, of a payload.
        size: Its radius, of a ball, or its three edges, of a box, m.
        com: (3,) m, its centre in the frame.
        inertia: kg m^2 about the centre, (3,) or (6,) as MJCF's fullinertia; by default that of the shape.
        model: Path of an MJCF file, or its text, whose body is attached in the place of a payload.
        body: Which of its bodies; the first by default.
        name: Of the new body; of a file's bodies, what stands before their names.

    Raises:
        PlannerError: Neither mass nor model, or both; a number out of range.
    """

    frame: str
    mass: float | None = None
    size: Any = None
    com: Any = (0.0, 0.0, 0.0)
    inertia: Any = None
    model: str | Path | None = None
    body: str | None = None
    name: str = "payload"

    def __post_init__(self) -> None:
        if (self.mass is None) == (self.model is None):
            raise PlannerError("attach has neither mass nor model, or both: expected one of the two.")
        for key in ("frame", "name"):
            if not isinstance(getattr(self, key), str) or not getattr(self, key):
                raise PlannerError(f"{key} of attach is {short_repr(getattr(self, key))}, expected a name.")
        array("com of attach", self.com, (3,))
        if self.mass is not None:
            number("mass of attach", self.mass, greater_than=0.0)
            _ = self.shape, self.moments

    @property
    def shape(self) -> np.ndarray:
        """The radius (1,), or the edges (3,), m."""
        if self.size is None:
            assert self.mass is not None
            return np.array([(3.0 * self.mass / (4.0 * np.pi * ALUMINIUM)) ** (1.0 / 3.0)])
        size = numbers("size of attach", self.size).ravel()
        if len(size) not in (1, 3) or not np.all(size > 0.0) or not np.isfinite(size).all():
            raise PlannerError(
                f"size of attach is {short_repr(self.size)}, expected a radius or three edges above 0, m."
            )
        return size

    @property
    def moments(self) -> np.ndarray:
        """(6,) kg m^2: xx, yy, zz, xy, xz, yz about the centre."""
        assert self.mass is not None
        if self.inertia is None:
            size = self.shape
            square = size**2
            own = np.full(3, 0.4 * square[0]) if len(size) == 1 else (square.sum() - square) / 12.0
            return np.concatenate([self.mass * own, np.zeros(3)])
        given = numbers("inertia of attach", self.inertia).ravel()
        if len(given) not in (3, 6) or not np.isfinite(given).all():
            raise PlannerError(
                f"inertia of attach is {short_repr(self.inertia)}, expected three or six numbers, kg m^2."
            )
        six = np.concatenate([given, np.zeros(6 - len(given))])
        xx, yy, zz, xy, xz, yz = six
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if principal[0] <= 0.0 or principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-9):
            raise PlannerError(
                f"inertia of attach is {short_repr(self.inertia)}, which no body has: expected principal moments above "
                "0, none larger than the sum of the others."
            )
        return six


def attachments(value: Any) -> tuple[Attachment, ...]:
    """Attachments from one, from tables, or from a list of either.

    Raises:
        PlannerError: A key that there is not, or a wrong value.
    """
    return records_of(Attachment, value, "attach", "frame", "the name of a site or body")


Record = TypeVar("Record")


def records_of(kind: type[Record], value: Any, what: str, required: str, expected: str) -> tuple[Record, ...]:
    """Records from one, from tables, or from a list of either; a table has the key `required`, which is `expected`.

    Raises:
        PlannerError: A key that there is not, or a wrong value.
    """
    if value is None:
        return ()
    found, keys = [], [one.name for one in fields(kind)]  # pyright: ignore[reportArgumentType]
    for one in value if isinstance(value, Sequence) and not isinstance(value, str) else (value,):
        if isinstance(one, Mapping):
            given = {choice(f"a key of {what}", key, keys): part for key, part in one.items()}
            if required not in given:
                raise PlannerError(f"{what} has no key {required!r}, expected {expected}.")
            one = kind(**given)
        if not isinstance(one, kind):
            raise PlannerError(f"{what} is {short_repr(one)}, expected a table with some of: {', '.join(keys)}.")
        found.append(one)
    return tuple(found)


def stored_records(records: Sequence[Any], file: str, folder: Path) -> list[dict[str, Any]]:
    """Records as tables of JSON values without defaults; the path under the key `file` is relative to a folder."""
    tables = []
    for one in records:
        given = {part.name: (getattr(one, part.name), part.default) for part in fields(one)}
        table = {name: value for name, (value, default) in given.items() if value is not default}
        table = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in table.items()}
        if file in table and not is_text(table[file]):
            table[file] = str(folder / table[file])
        tables.append(table)
    return tables


def with_attached(file: ModelFile, given: Sequence[Attachment]) -> ModelFile:
    """A file with payloads and tools in it, compiled again.

    Raises:
        PlannerError: No such frame, or a name that is taken.
        ModelError: MuJoCo refuses the result.
    """
    for one in given:
        root, files = copy.deepcopy(file.root), dict(file.files)
        body, position, quaternion = _place(root, file.survey.model, one.frame)
        taken = [element.get("name") for element in root.iter("body")]
        if one.name in taken:
            raise PlannerError(f"name of attach is {one.name!r}, which the model has: expected another name.")
        at = {"pos": written(*position), "quat": written(*quaternion)}
        if one.model is None:
            _add_payload(root, file.survey.model, body, one, at)
        else:
            _add_model(root, files, body, one, at)
        survey = ModelIndex(compile_model(root, files, file.name))
        shaped = (one.name,) if one.model is None and one.size is not None else ()
        payloads = (*file.payloads, *shaped)
        file = file._replace(root=root, files=files, survey=survey, is_compiled=True, payloads=payloads)
    return file


def _place(root: ElementTree.Element, model: Any, frame: str) -> Frame:
    """The body's element that carries a site or body of this name, and the frame's pose in it."""
    mujoco = load_mujoco()
    bodies = [name for i in range(1, model.nbody) if (name := model.body(i).name)]
    sites = [name for i in range(model.nsite) if (name := model.site(i).name)]
    choice("frame of attach", frame, [*sites, *bodies])
    parents = {child: parent for parent in root.iter() for child in parent}
    if frame in sites:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame)
        element = next((one for one in root.iter("site") if one.get("name") == frame), None)
        while element is not None and element.tag not in ("body", "worldbody"):
            element = parents.get(element)
        position, quaternion = model.site_pos[site], model.site_quat[site]
    else:
        element = next((one for one in root.iter("body") if one.get("name") == frame), None)
        position, quaternion = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    if element is None:
        raise ModelError(
            f"frame of attach is {frame!r}, which the model makes by other means (<attach>, <replicate>): expected a "
            "frame that is written in the file."
        )
    return element, np.array(position), np.array(quaternion)


def _add_payload(
    root: ElementTree.Element, model: Any, body: ElementTree.Element, one: Attachment, at: dict[str, str]
) -> None:
    """A body with the payload's mass; its shape touches whatever may touch in the file, if it has a size."""
    masks = {"contype": "0", "conaffinity": "0"}
    if one.size is None:
        texts = ElementTree.SubElement(root, "custom")
        number_of = len(root.findall("custom/text")) + 1
        phrase = f"contacts of {one.name}, which has a mass and no shape"
        ElementTree.SubElement(texts, "text", {"name": f"{NEVER_REPLAYED}{number_of}", "data": phrase})
    else:
        every = [int(np.bitwise_or.reduce(getattr(model, f"geom_{name}"), initial=0)) for name in reversed(masks)]
        masks = dict(zip(masks, map(str, every), strict=True))
    payload = ElementTree.SubElement(body, "body", {"name": one.name, **at})
    com, size = written(*np.asarray(one.com, dtype=float)), one.shape
    mass = written(float(one.mass or 0.0))
    ElementTree.SubElement(
        payload, "inertial", {"pos": com, "mass": mass, "fullinertia": written(*one.moments)}
    )  # fmt: skip
    ball = len(size) == 1
    kind = {"type": "sphere" if ball else "box", "size": written(*(size if ball else 0.5 * size))}
    ElementTree.SubElement(
        payload, "geom",
        {"name": one.name, **kind, "pos": com, "mass": mass, **masks, "rgba": COLOUR},
    )  # fmt: skip


def _add_model(
    root: ElementTree.Element, files: dict[str, bytes], body: ElementTree.Element, one: Attachment, at: dict[str, str]
) -> None:
    """Another file as an asset, and its body in a frame of the body."""
    assert one.model is not None
    tool, own = model_tree(one.model)
    bodies = [element.get("name", "") for section in tool.findall("worldbody") for element in section.findall("body")]
    named = [name for name in bodies if name]
    if not named:
        raise ModelError("the model of attach has no body with a name, expected one to attach.")
    which = named[0] if one.body is None else choice("body of attach", one.body, named)
    for name, content in own.items():
        if files.setdefault(name, content) != content:
            raise ModelError(f"the model of attach has a file {name!r}, and so has the machine: expected another name.")
    stored = f"{one.name}.xml"
    files[stored] = ElementTree.tostring(tool)
    assets = ElementTree.SubElement(root, "asset")
    ElementTree.SubElement(assets, "model", {"name": one.name, "file": stored})
    frame = ElementTree.SubElement(body, "frame", at)
    ElementTree.SubElement(frame, "attach", {"model": one.name, "body": which, "prefix": f"{one.name}-"})
