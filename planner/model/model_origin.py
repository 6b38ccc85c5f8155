"""Where a model was read from, so that a stored plan can be compared with the model on disk.

An origin is a table of JSON values: the `path` of the file, and what reading it took besides (attach, obstacles,
exclude, keys of a URDF). Paths are absolute in memory and relative to the plan's folder in its file. A text has none.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from planner.model.mjcf.attached import attachments, stored_records, with_attached
from planner.model.mjcf.model_file import open_model_file
from planner.model.mjcf.obstacles import excluded_pairs, obstacles_of, with_excluded, with_obstacles
from planner.model.mjcf.text import is_text
from planner.model.urdf.write import as_mjcf, is_urdf

URDF_KEYS = ("base", "floor", "package_path", "inertia")


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
        "path": str,
        "digest": str,
        "base": str,
        "inertia": (str, dict),
        "floor": bool,
        "package_path": list,
        "attach": list,
        "obstacles": list,
        "exclude": list,
    }
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
    if is_urdf(model):
        of_urdf = {key: origin[key] for key in URDF_KEYS if key in origin}
        file_now = open_model_file(*as_mjcf(model, **of_urdf))
    else:
        file_now = open_model_file(model)
    file_now = with_attached(file_now, attachments(origin.get("attach")))
    file_now = with_obstacles(file_now, obstacles_of(origin.get("obstacles")))
    file_now = with_excluded(file_now, excluded_pairs(origin.get("exclude")))
    return ElementTree.tostring(file_now.root, encoding="unicode"), file_now.files
