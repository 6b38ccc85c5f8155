"""The file of a plan: a compressed .npz without pickle, arrays and one JSON string, checked before use.

Files that the model names (meshes, textures) are stored once each, under the digest of their content. Digests also
identify parts of a plan that were changed after it was written, by an editor, a script or a damaged copy. They are no
signature: a deliberate change can rewrite them.
"""

from __future__ import annotations

import io
import json
import os
import sys
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np

from planner.base.data_files import finite
from planner.base.errors import FileError, ModelError
from planner.base.files import check_confined, digest_of, printable, read_input, write_atomically
from planner.model.mjcf.text import check_stored
from planner.model.space import StateSpace

FORMAT_VERSION = 6
LEVEL = 4  # of compression: of meshes a tenth more bytes than at NumPy's 6, in a quarter of the time
ARRAYS = ("t", "xs", "us", "K", "history")
FILE = "file:"  # and a digest: the bytes of a file that the model's text names, as uint8
HINGES = ("hinges_lower", "hinges_upper", "hinges_weight")  # all or none: penalties of state bounds and constraints
PART = "problem:"  # and a name: an array of the problem, where its recipe needs some
_MAX_BYTES = 2**30  # of all arrays, unpacked: a plan of 100,000 stages of a humanoid has half of that

_WORDS = {
    "t": "times t", "xs": "states xs", "us": "controls us", "K": "gains K", "history": "iterations",
    "mjcf": "the model", "recipe": "the problem's parameters", "twin": "the maps to the model's state",
}  # fmt: skip

_NUMBER = (int, float, type(None))
_META = {
    "recipe": (dict, type(None)), "status": (str,), "cost": _NUMBER, "gradient_norm": _NUMBER, "iterations": (int,),
    "versions": (dict,), "twin": (dict, type(None)), "mjcf": (str, type(None)), "files": (dict,), "space": (dict,),
    "starts": (list,), "options": (dict,), "digests": (dict,), "limits": (dict, type(None)),
    "objective": (dict, type(None)), "tolerance": (int, float, str, dict, type(None)),
}  # fmt: skip
_START = (int,), (str,), _NUMBER, (int,), _NUMBER

# What reading a file that is no plan may raise. RuntimeError: an unknown compression, or JSON nested too deeply;
# SyntaxError and TokenError: the header of an array, which NumPy reads as Python.
_BROKEN = (
    ValueError, KeyError, EOFError, TypeError, OverflowError, RuntimeError, MemoryError, SyntaxError,
    tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def plan_name(path: str | Path) -> Path:
    """A name that a plan can be saved under."""
    if not isinstance(path, (str, os.PathLike)) or Path(path).suffix != ".npz":
        raise FileError(f"cannot save a plan as {path}: expected a name ending in .npz.")
    return Path(path)


def write_archive(path: Path, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Write arrays and meta, atomically; the same content gives the same bytes."""
    with write_atomically(path) as unfinished, open(unfinished, "wb") as file:
        pack(file, arrays, meta)


def pack(file: IO[bytes], arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Write arrays and meta into an open file."""
    meta = finite(meta)
    meta = {"format_version": FORMAT_VERSION, **meta, "digests": digests(arrays, meta)}
    contents = arrays | {"meta": np.array(json.dumps(meta, allow_nan=False))}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive:
        for name, array in contents.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), allow_pickle=False)


def opened(path: Path) -> IO[bytes]:
    """An open plan file: an ordinary one, or DIR/plans/000.zip/000017.npz, one inside an archive of many plans.

    Raises:
        FileError: There is none.
        OSError: It cannot be read.
    """
    check_confined(path, "the plan")
    if os.path.isfile(path):  # no folder, pipe or device, say
        return open(path, "rb")
    if path.parent.suffix == ".zip" and os.path.isfile(path.parent):
        try:
            with open(path.parent, "rb") as handle, zipfile.ZipFile(handle) as archive:
                return io.BytesIO(archive.read(path.name))
        except (*_BROKEN, NotImplementedError):  # the last is zipfile's for a compression that it does not know
            named = f"{printable(path.parent)} has no plan {printable(path.name)}"
            raise FileError(f"{named}, expected one of the plans of a sweep.") from None
    problem = "is not a file" if os.path.exists(path) else "does not exist"
    raise FileError(f"{printable(path)} {problem}, expected a plan.npz.")


def read_archive(path: Path, columns: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and meta of a plan file whose history has so many columns, checked against each other."""
    named = printable(path)
    foreign = FileError(f"{named} is not a plan: expected an .npz with {', '.join(ARRAYS)} and meta.")
    try:
        # Our own handle: np.load leaks its file when the archive is broken.
        with opened(path) as handle, np.load(handle, allow_pickle=False) as file:
            unpacked = sum(entry.file_size for entry in file.zip.infolist())
            if unpacked > _MAX_BYTES:
                raise FileError(f"{named} unpacks to {unpacked} bytes, expected a plan of at most {_MAX_BYTES}.")
            more = [name for name in file.files if name.startswith((FILE, PART)) or name in HINGES]
            arrays = {name: np.asarray(file[name]) for name in (*ARRAYS, *more)}
            meta = json.loads(str(file["meta"]))
        version = meta["format_version"]
    except FileError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise FileError(f"cannot read {named}: {error.strerror}.") from None
        raise foreign from None
    except _BROKEN as error:
        raise foreign from error
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise foreign
    if version != FORMAT_VERSION:
        versions = meta.get("versions")
        made = versions.get("planner") if isinstance(versions, dict) else None
        newer = version > FORMAT_VERSION
        made = printable(made) if isinstance(made, str) else f"{'a newer' if newer else 'an older'} version"
        remedy = "read it with that version" if newer else "make the plan again with this one"
        raise FileError(
            f"{named} has format {version}, written by planner {made}; this planner reads format {FORMAT_VERSION}: "
            f"{remedy}."
        )
    for name, kinds in _META.items():
        if name not in meta or not _is(meta[name], kinds) or not _INSIDE.get(name, lambda value: True)(meta[name]):
            raise FileError(f"{named} is damaged: its meta has no usable {name!r}.")
    written = meta.pop("digests")
    content = {name: part for name, part in meta.items() if name != "format_version"}
    meta["changed"] = changed(arrays, content, written)
    meta["space"] = _check_arrays(named, arrays, columns, meta["space"], meta["files"])
    meta.setdefault("touch_downs", [])  # which earlier files of this format lack
    if not _touch_downs(meta["touch_downs"], len(arrays["us"])):
        raise FileError(f"{named} is damaged: its meta has no usable 'touch_downs'.")
    if meta["mjcf"] is not None:
        contents = {name: arrays[FILE + digest].tobytes() for name, digest in meta["files"].items()}
        twin = meta["twin"] or {}
        try:
            for text in filter(None, (meta["mjcf"], *(str(twin.get(name, "")) for name in ("source", "original")))):
                check_stored(text, contents)
        except ModelError as error:
            raise FileError(f"{named} is damaged: {error}") from None
    return arrays, meta


def _texts(table: dict[str, Any]) -> bool:
    return all(isinstance(text, str) for text in table.values())


def _recipe(table: dict[str, Any] | None) -> bool:
    kinds = {"name": str, "parameters": dict}
    return table is None or (set(table) == set(kinds) and all(isinstance(table[key], kinds[key]) for key in kinds))


def _starts(rows: list[Any]) -> bool:
    whole = (isinstance(row, list) and len(row) == len(_START) for row in rows)
    return all(whole) and all(all(map(_is, row, _START)) for row in rows)


def _touch_downs(rows: Any, N: int) -> bool:
    stages = ("stage", "earliest", "latest", "watched")
    whole = isinstance(rows, list) and all(isinstance(row, dict) and {*row} == {*stages, "feet"} for row in rows)
    if not whole:
        return False
    found = all(
        all(_is(row[name], (int,)) for name in stages)
        and 0 <= row["watched"] <= row["earliest"] <= row["stage"] <= row["latest"] and row["stage"] < N
        and isinstance(row["feet"], list) and row["feet"] and all(isinstance(foot, str) for foot in row["feet"])
        for row in rows
    )  # fmt: skip
    return found and [row["stage"] for row in rows] == sorted(row["stage"] for row in rows)


_INSIDE = {"versions": _texts, "files": _texts, "recipe": _recipe, "starts": _starts}  # checks of the contents


def _is(value: Any, kinds: tuple[type, ...]) -> bool:
    """Whether a JSON value is of one of some kinds, and a number finite."""
    if isinstance(value, bool) or not isinstance(value, kinds):
        return False
    return not isinstance(value, (int, float)) or abs(value) <= sys.float_info.max


def _space(named: str, nx: int, given: dict[str, Any]) -> StateSpace:
    """The checked space of states (nx,), with quaternions in order and without overlap."""
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
        reason = " ".join(str(error).split())
        raise FileError(f"{named} is damaged: its meta has no usable 'space' ({reason}).") from None
    return space


def _check_arrays(
    named: str, arrays: dict[str, np.ndarray], columns: int, space: dict[str, Any], files: dict[str, str]
) -> StateSpace:
    if arrays["us"].ndim != 2 or arrays["xs"].ndim != 2 or len(arrays["us"]) == 0:
        raise FileError(f"{named} is damaged: xs and us are not tables, expected (N+1, nx) and (N, nu).")
    (N, nu), nx = arrays["us"].shape, arrays["xs"].shape[1]
    states = _space(named, nx, space)
    rows = arrays["history"].shape[0] if arrays["history"].ndim else 0
    shapes = {"t": (N + 1,), "xs": (N + 1, nx), "us": (N, nu), "K": (N, nu, states.ndx), "history": (rows, columns)}
    for name, shape in shapes.items():
        have = arrays[name]
        if have.shape != shape or have.dtype != np.float64:
            raise FileError(f"{named} is damaged: {name} is {have.dtype} {have.shape}, expected float64 {shape}.")
    lost = [name for name, digest in files.items() if FILE + digest not in arrays]
    if lost:
        raise FileError(f"{named} is damaged: it has no file {printable(lost[0])!r}, which its model names.")
    penalty_arrays = [arrays[name] for name in HINGES if name in arrays]
    if penalty_arrays and (
        len(penalty_arrays) < len(HINGES) or any(h.dtype != np.float64 or h.ndim != 2 for h in penalty_arrays)
    ):
        raise FileError(f"{named} is damaged: it has no usable {', '.join(HINGES)}.")
    if penalty_arrays and any(h.shape != (N + 1, penalty_arrays[0].shape[1]) for h in penalty_arrays):
        raise FileError(f"{named} is damaged: {', '.join(HINGES)} are not of one shape ({N + 1}, ...).")
    for name, have in arrays.items():
        if name.startswith(PART) and have.dtype != np.float64:
            raise FileError(f"{named} is damaged: {name} is {have.dtype}, expected float64.")
        if name.startswith(FILE) and (have.ndim != 1 or have.dtype != np.uint8):
            raise FileError(f"{named} is damaged: {name} is {have.dtype} {have.shape}, expected uint8 (bytes,).")
    t = arrays["t"]
    if not (np.isfinite(t).all() and t[0] == 0.0 and np.all(np.diff(t) > 0.0)):
        raise FileError(f"{named} is damaged: t does not rise from 0.")
    if not np.isfinite(arrays["history"][:, 0]).all():
        raise FileError(f"{named} is damaged: its history does not count its iterations.")
    return states


def digests(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> dict[str, str]:
    """A digest of every array and every part of the meta, by name."""
    found = {name: digest_of(str(array.shape).encode() + array.tobytes()) for name, array in arrays.items()}
    return found | {name: digest_of(json.dumps(part, sort_keys=True).encode()) for name, part in meta.items()}


def changed(arrays: dict[str, np.ndarray], meta: dict[str, Any], written: dict[str, str]) -> tuple[str, ...]:
    """Names of the parts whose digest no longer matches, in words: "controls us"."""
    now = digests(arrays, meta)
    names = dict.fromkeys([*written, *now])
    return tuple(_WORDS.get(name, name) for name in names if written.get(name) != now.get(name))


def plan_digest(path: Path) -> str:
    """The digest of a plan's file, which its proof is stored with."""
    if Path(path).parent.suffix == ".zip":
        with opened(Path(path)) as file:
            return digest_of(file.read())
    return digest_of(read_input(path, "the plan"))
