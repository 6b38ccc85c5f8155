"""Twin: the MuJoCo model of a plan, where it was read from, and the maps between both states; stored in every plan.npz.

The simulator's physical state is w = (qpos, qvel, act), nw numbers. The plan's state is an affine function of it,

    x = to_x @ w + to_x_offset,

and the inverse map is the minimum of K affine functions, K > 1 with unilateral contacts (the length of a leg is the
lesser of its spring's rest length and the distance to the ground),

    w = min over k of (to_sim[k] @ x + to_sim_offset[k]).

The control is MuJoCo's ctrl. Replay and render need only the XML text and these maps. For a Mechanism both states are
the same, so the maps are identities.

The origin of a model lets a stored plan be compared with the model on disk. It is a table of JSON values: the `path` of
the file, and what reading it took besides (attach, obstacles, exclude, keys of a URDF). Paths are absolute in memory
and relative to the plan's folder in its file. A text has none.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.base.files import digest_of
from planner.model.mjcf.attached import attachments, stored_records
from planner.model.mjcf.model_file import open_model_file
from planner.model.mjcf.obstacles import edits_of, excluded_pairs, obstacles_of
from planner.model.mjcf.text import is_text
from planner.model.passive_forces import ExponentialTorque
from planner.model.urdf.write import as_mjcf, is_urdf

URDF_KEYS = ("base", "floor", "package_path", "inertia")
_MAPS: dict[str, tuple[int | str, ...]] = {
    "to_x": ("nx", "nw"), "to_x_offset": ("nx",), "to_sim": ("K", "nw", "nx"), "to_sim_offset": ("K", "nw"),
}  # fmt: skip
_TEXTS = ("source", "original")


@dataclass(frozen=True)
class Twin:
    """An MJCF model and the maps between its state w and the plan's state x.

    Attributes:
        mjcf: The XML text, includes resolved.
        to_x: (nx, nw) matrix of x = to_x w + to_x_offset.
        to_x_offset: (nx,), in units of x.
        to_sim: (K, nw, nx) matrices of the inverse map; K = 1 without unilateral contacts.
        to_sim_offset: (K, nw), in units of w.
        assets: Files that the text names, meshes for example, by the name it uses.
        source: The XML text that the plan's mechanism was read from, if it differs from mjcf, else ""; see
            model.mjcf.prescribed_joints.
        original: The user's XML text, if it was edited before planning, else "".
        origin: The file that the text was read from, and how; empty for a text.
        curves: Exponential torques in addition to the MJCF; see planner.proof.replays.passive_torque_callback.
    """

    mjcf: str
    to_x: np.ndarray
    to_x_offset: np.ndarray
    to_sim: np.ndarray
    to_sim_offset: np.ndarray
    assets: dict[str, bytes] = field(default_factory=dict)
    source: str = ""
    original: str = ""
    origin: dict[str, Any] = field(default_factory=dict)
    curves: tuple[ExponentialTorque, ...] = ()

    def __post_init__(self) -> None:
        for name, sizes in _MAPS.items():
            object.__setattr__(self, name, array(f"Twin: {name}", getattr(self, name), sizes))
        nx, nw = self.to_x.shape
        K = self.to_sim.shape[0]
        expected = {"to_x_offset": (nx,), "to_sim": (K, nw, nx), "to_sim_offset": (K, nw)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise PlannerError(f"Twin: {name} has shape {getattr(self, name).shape}, expected {shape}.")

    @classmethod
    def of(cls, mechanism: Any) -> Twin:
        """The twin of a mechanism with identity maps: the plan's state is MuJoCo's, x = (qpos, qvel, act)."""
        same, none = np.eye(mechanism.space.nx), np.zeros(mechanism.space.nx)
        return cls(
            mechanism.mjcf, same, none, same[None], none[None], dict(mechanism.assets), original=mechanism.original,
            origin=mechanism.origin, curves=mechanism.curves,
        )  # fmt: skip

    def x_of(self, w: np.ndarray) -> np.ndarray:
        """The plan's state (..., nx) of simulator states w (..., nw)."""
        return w.copy() if self._same else w @ self.to_x.T + self.to_x_offset

    def sim_of(self, x: np.ndarray) -> np.ndarray:
        """The simulator's state (..., nw) of plan states x (..., nx)."""
        if self._same:
            return x.copy()
        return np.min(np.einsum("kwx,...x->...kw", self.to_sim, x) + self.to_sim_offset, axis=-2)

    @cached_property
    def _same(self) -> bool:
        """Whether both maps are identities: skips the products, since a proof maps tens of thousands of states."""
        plain = np.eye(len(self.to_x))
        maps = ((self.to_x, plain), (self.to_sim, plain[None]))
        return not (self.to_x_offset.any() or self.to_sim_offset.any()) and all(np.array_equal(*pair) for pair in maps)

    @property
    def given(self) -> str:
        """The user's XML text."""
        return self.original or self.planned

    @property
    def given_digest(self) -> str:
        """The digest of the user's model, its text and its files."""
        return model_digest(self.given, self.assets)

    @property
    def planned(self) -> str:
        """The XML text that the plan's mechanism was read from."""
        return self.source or self.mjcf

    def to_dict(self, folder: Path | None = None) -> dict[str, Any]:
        """The maps as JSON values, with source, original and curves if not empty; without mjcf and assets.

        With a folder also the origin, with paths relative to it, and the digest of the user's model.
        """
        maps = {name: getattr(self, name).tolist() for name in _MAPS}
        maps |= {name: text for name in _TEXTS if (text := getattr(self, name))}
        if folder is not None and self.origin:
            maps["origin"] = moved(self.origin, partial(_relative, folder)) | {"digest": self.given_digest}
        return maps | ({"curves": [curve.to_list() for curve in self.curves]} if self.curves else {})

    @classmethod
    def from_dict(cls, mjcf: str | None, maps: dict[str, Any], assets: dict[str, bytes] | None = None) -> Twin:
        """A twin from its MJCF text, its assets and the result of to_dict().

        Raises:
            PlannerError: The maps or the text are missing, or their sizes differ.
        """
        maps = dict(maps)
        texts = {name: maps.pop(name, "") for name in _TEXTS}
        curves, origin = maps.pop("curves", []), maps.pop("origin", {})
        if not (isinstance(curves, list) and all(isinstance(row, list) and len(row) == 4 for row in curves)):
            raise PlannerError("a twin's curves are not rows of dof, amplitude, constant and slopes.")
        if not is_origin(origin):
            raise PlannerError("a twin's origin is no table of a path and how it was read.")
        if not all(isinstance(text, str) for text in (mjcf, *texts.values())) or set(maps) != set(_MAPS):
            raise PlannerError(f"a twin needs its MJCF text and exactly these maps: {', '.join(_MAPS)}.")
        torques = tuple(ExponentialTorque(*row) for row in curves)
        return cls(str(mjcf), **maps, assets=assets or {}, **texts, origin=origin, curves=torques)


def model_digest(text: str, files: dict[str, bytes]) -> str:
    """A digest of a model's text and of the names and contents of its files."""
    parts = [text.encode(), *(part for name in sorted(files) for part in (name.encode(), files[name]))]
    return digest_of(b"\0".join(parts))


def _relative(folder: Path, path: str) -> str:
    """A path relative to a folder, with "/"; the path itself on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return path


def origin_of(
    model: str | Path, attach: Any = None, obstacles: Any = None, exclude: Any = None, **of_urdf: Any
) -> dict[str, Any]:
    """The origin of a file; empty for a text. Keys of a URDF without a value are left out."""
    if is_text(model):
        return {}
    origin = {"path": str(model), "attach": stored_records(attachments(attach), "model", Path())}
    origin["obstacles"] = stored_records(obstacles_of(obstacles), "file", Path())
    origin["exclude"] = [list(pair) for pair in excluded_pairs(exclude)]
    origin |= {key: list(value) if isinstance(value, tuple) else value for key, value in of_urdf.items()}
    return moved({key: value for key, value in origin.items() if value}, os.path.abspath)


def is_origin(value: Any) -> bool:
    """Whether a JSON value is an origin as a plan's file has it, with a `digest` of the user's model, or empty."""
    kinds = {
        "path": str, "digest": str, "base": str, "inertia": (str, dict), "floor": bool, "package_path": list,
        "attach": list, "obstacles": list, "exclude": list,
    }  # fmt: skip
    return (
        isinstance(value, dict) and all(isinstance(part, kinds.get(key, ())) for key, part in value.items())
        and all(isinstance(one, str) for one in value.get("package_path", ()))
        and all(isinstance(one, dict) for key in ("attach", "obstacles") for one in value.get(key, ()))
        and all(isinstance(one, list) and [*map(type, one)] == [str, str] for one in value.get("exclude", ()))
    )  # fmt: skip


def moved(origin: dict[str, Any], place: Callable[[str], str]) -> dict[str, Any]:
    """The origin with all its paths changed by a function."""
    found = dict(origin)
    if "path" in found:
        found["path"] = place(found["path"])
    if "package_path" in found:
        folders = found["package_path"]
        found["package_path"] = [place(one) for one in ([folders] if isinstance(folders, str) else folders)]
    for key, file in (("attach", "model"), ("obstacles", "file")):
        if key in found:
            found[key] = [
                one | ({file: place(one[file])} if isinstance(one.get(file), str) and not is_text(one[file]) else {})
                for one in found[key]
            ]
    return found


def read_again(origin: dict[str, Any], file: str | Path | None = None) -> tuple[str, dict[str, bytes]]:
    """The user's text and its files as they are on disk now, or of another MJCF or URDF file, read in the same way.

    Raises:
        PlannerError: A file cannot be read, or MuJoCo refuses it.
    """
    model = origin["path"] if file is None else file
    of_urdf = {key: origin[key] for key in URDF_KEYS if key in origin}
    file_now = open_model_file(*as_mjcf(model, **of_urdf)) if is_urdf(model) else open_model_file(model)
    added = {key: origin.get(key) for key in ("attach", "obstacles", "exclude")}
    if added["obstacles"]:  # a position at the origin needs not be written, though users have to say it
        added["obstacles"] = [{"position": [0.0, 0.0, 0.0]} | one for one in added["obstacles"]]
    file_now = edits_of(**added)(file_now)
    return ElementTree.tostring(file_now.root, encoding="unicode"), file_now.files
