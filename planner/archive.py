"""The file of a plan: an .npz without pickle, arrays and one JSON string, read back with every check before use."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from planner.errors import FileError
from planner.files import write_atomically
from planner.jsonable import finite
from planner.space import StateSpace

FORMAT_VERSION = 2
ARRAYS = ("t", "xs", "us", "K", "history")
ASSET = "asset:"  # and a name: the bytes of a file that the model's text names, as uint8

_NUMBER = (int, float, type(None))
_META = {
    "case": (str, type(None)), "parameters": (dict,), "status": (str,), "cost": _NUMBER, "gradient_norm": _NUMBER,
    "iterations": (int,), "versions": (dict,), "twin": (dict, type(None)), "mjcf": (str, type(None)),
    "space": (dict,), "starts": (list,),
}  # fmt: skip


def plan_name(path: str | Path) -> Path:
    """A name that a plan can be saved under.

    Raises:
        FileError: It does not end in .npz.
    """
    if Path(path).suffix != ".npz":
        raise FileError(f"cannot save a plan as {path}: expected a name ending in .npz.")
    return Path(path)


def write_archive(path: Path, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Write arrays and meta, atomically; the same content gives the same bytes.

    Raises:
        FileError: The file cannot be written.
    """
    text = json.dumps(finite({"format_version": FORMAT_VERSION, **meta}), allow_nan=False)
    with write_atomically(path) as unfinished, open(unfinished, "wb") as file:
        contents: dict[str, Any] = {name: arrays[name] for name in arrays if name in ARRAYS or name.startswith(ASSET)}
        np.savez(file, **contents, meta=np.array(text))


def read_archive(path: Path, columns: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and meta of a plan file, checked against each other.

    Args:
        path: The file.
        columns: Of the history.

    Raises:
        FileError: No such file, not a plan, damaged, or written by a newer version.
    """
    if not path.is_file():
        raise FileError(f"{path} is not a file, expected a plan.npz.")
    foreign = FileError(f"{path} is not a plan: expected an .npz with {', '.join(ARRAYS)} and meta.")
    try:
        # Our own handle: np.load leaks its file when the archive is broken.
        with open(path, "rb") as handle, np.load(handle, allow_pickle=False) as file:
            assets = [name for name in file.files if name.startswith(ASSET)]
            arrays = {name: np.asarray(file[name]) for name in (*ARRAYS, *assets)}
            meta = json.loads(str(file["meta"]))
        version = meta["format_version"]
    except OSError as error:
        if error.errno is not None:
            raise FileError(f"cannot read {path}: {error.strerror}.") from None
        raise foreign from None
    except (ValueError, KeyError, EOFError, TypeError, RuntimeError, MemoryError) as error:
        raise foreign from error  # a RuntimeError: an unknown compression, or JSON nested too deeply
    except (zipfile.BadZipFile, zlib.error) as error:
        raise foreign from error
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise foreign
    if version > FORMAT_VERSION:
        versions = meta.get("versions")
        made = versions.get("planner", "a newer version") if isinstance(versions, dict) else "a newer version"
        raise FileError(
            f"{path} has format {version}, written by planner {made}; this planner reads up to {FORMAT_VERSION}."
        )
    if version == 1:  # plain vectors, one start
        meta |= {"space": {"ndx": arrays["xs"].shape[-1] if arrays["xs"].ndim else 0, "quaternions": []}, "starts": []}
    for name, kinds in _META.items():
        value = meta.get(name)
        if name not in meta or not isinstance(value, kinds) or isinstance(value, bool):
            raise FileError(f"{path} is damaged: its meta has no usable {name!r}.")
    meta["space"] = _check_arrays(path, arrays, columns, meta["space"])
    return arrays, meta


def _space(path: Path, nx: int, given: dict[str, Any]) -> StateSpace:
    """The space of states of nx numbers: quaternions lie in order, none in another."""
    ndx, pairs = given.get("ndx"), given.get("quaternions")
    try:
        pairs = tuple((int(i), int(j)) for i, j in pairs or ())
        space = StateSpace(nx, nx - len(pairs), pairs)
        end, end_of_deviation = 0, 0
        for i, j in space.quaternions:
            if not (end <= i and i - end == j - end_of_deviation):
                raise ValueError(f"({i}, {j})")
            end, end_of_deviation = i + 4, j + 3
        if not isinstance(ndx, int) or ndx != space.ndx or end > nx:
            raise ValueError(f"{ndx} numbers for {nx}")
    except (TypeError, ValueError, OverflowError) as error:
        raise FileError(f"{path} is damaged: its meta has no usable 'space' ({error}).") from None
    return space


def _check_arrays(path: Path, arrays: dict[str, np.ndarray], columns: int, space: dict[str, Any]) -> StateSpace:
    if arrays["us"].ndim != 2 or arrays["xs"].ndim != 2 or len(arrays["us"]) == 0:
        raise FileError(f"{path} is damaged: xs and us are not tables, expected (N+1, nx) and (N, nu).")
    (N, nu), nx = arrays["us"].shape, arrays["xs"].shape[1]
    states = _space(path, nx, space)
    rows = arrays["history"].shape[0] if arrays["history"].ndim else 0
    shapes = {"t": (N + 1,), "xs": (N + 1, nx), "us": (N, nu), "K": (N, nu, states.ndx), "history": (rows, columns)}
    for name, shape in shapes.items():
        have = arrays[name]
        if have.shape != shape or have.dtype != np.float64:
            raise FileError(f"{path} is damaged: {name} is {have.dtype} {have.shape}, expected float64 {shape}.")
    for name, have in arrays.items():
        if name.startswith(ASSET) and (have.ndim != 1 or have.dtype != np.uint8):
            raise FileError(f"{path} is damaged: {name} is {have.dtype} {have.shape}, expected uint8 (bytes,).")
    t = arrays["t"]
    if not (np.isfinite(t).all() and t[0] == 0.0 and np.all(np.diff(t) > 0.0)):
        raise FileError(f"{path} is damaged: t does not rise from 0.")
    if not np.isfinite(arrays["history"][:, 0]).all():
        raise FileError(f"{path} is damaged: its history does not count its iterations.")
    return states
