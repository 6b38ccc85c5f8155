"""MJCF files: those of the package, text with includes resolved and the files it names, edits by path.

Pure XML: nothing here asks MuJoCo.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

from planner.base.arguments import short_repr
from planner.base.errors import ModelError
from planner.base.files import printable, read_input, read_text
from planner.model.mjcf.input_limits import MAX_PARENTS, Budget, base, by_name, check_copies, check_levels, parsed

# In the wheel mjcf/ lies inside the package, in a checkout beside it.
_FOLDERS = (Path(__file__).parents[2] / "mjcf", Path(__file__).parents[3] / "mjcf")


def model_path(name: str) -> Path:
    """The folder of a model that comes with the package, e.g. "hopper"."""
    for folder in _FOLDERS:
        if (folder / name / "scene.xml").is_file():
            return folder / name
    known = sorted({scene.parent.name for folder in _FOLDERS for scene in folder.glob("*/scene.xml")})
    raise ModelError(f"there is no model {name!r}, expected one of: {', '.join(known)}.")


def is_text(model: object) -> bool:
    """Whether a model is given as its XML text rather than as the path of a file."""
    return isinstance(model, str) and "<" in model


def model_text(path: str | Path) -> str:
    """The XML text of an MJCF file with its includes resolved."""
    return ElementTree.tostring(_read(Path(path), Budget(), ())[0], encoding="unicode")


def model_tree(
    model: str | Path, assets: dict[str, bytes] | None = None, *, stored: bool = False
) -> tuple[ElementTree.Element, dict[str, bytes]]:
    """A model that stands alone: its XML with includes resolved and the files it names, by the name it uses.

    Files are sought in `assets` first; those that a text names, then from the working directory. The model of a
    `stored` plan names only assets, by whatever folder, as MuJoCo finds them: nothing is read from disk for it. The
    compiler's folders (meshdir, texturedir, assetdir) are gone: every file has a name without a folder.
    """
    if isinstance(model, str) and not model.strip():
        raise ModelError("the model is an empty text, expected MJCF or the path of a file.")
    if not isinstance(model, (str, os.PathLike)):
        raise ModelError(f"the model is a {type(model).__name__}, expected MJCF text or the path of a file.")
    files: dict[str, bytes] = {}
    root, reading = _read(model, Budget(), ())
    reading.stored = by_name(assets or {}) if stored else None
    root = _standing_alone(root, reading, assets or {}, files)
    check_copies(root, files)
    return root, files


@dataclass
class _Reading:
    """A model being read."""

    folder: Path  # Of its main file
    budget: Budget  # Counts its files and elements, with those of the models that it attaches
    parents: tuple[Path, ...]  # The files of the models that attach it, and its own
    # The folder of the file that an element was included from.
    origins: dict[ElementTree.Element, Path] = field(default_factory=dict)
    stored: dict[str, bytes] | None = None  # All files of a stored model, by the names that MuJoCo knows them by


def _read(
    model: str | os.PathLike[str], budget: Budget, parents: tuple[Path, ...]
) -> tuple[ElementTree.Element, _Reading]:
    """The XML of a text or a path with its includes resolved."""
    name = "the model" if is_text(model) else f"the model {printable(model)}"
    try:
        if is_text(model):
            reading = _Reading(Path(), budget, parents)
            root = parsed(str(model), name, budget)
            _resolve_below(root, Path(name), parents, reading)
        else:
            path = Path(model)
            reading = _Reading(path.parent, budget, (*parents, _place(path)))
            root = _resolved(path, parents, reading)
        check_levels(root, name)
    except RecursionError:  # files in files, each of many levels
        raise ModelError(f"{name} is nested too deeply, expected MJCF of some tens of levels.") from None
    return root, reading


def _resolved(path: Path, parents: tuple[Path, ...], reading: _Reading) -> ElementTree.Element:
    """A file's root with its includes resolved."""
    place = _place(path)
    if place in parents:
        raise ModelError(f"{printable(path)} includes itself.")
    if len(parents) > MAX_PARENTS:
        raise ModelError(f"{printable(path)} is nested too deeply, expected at most {MAX_PARENTS} files in files.")
    root = parsed(read_text(path, "the model", raises=ModelError), printable(path), reading.budget)
    _resolve_below(root, path, (*parents, place), reading)
    return root


def _resolve_below(element: ElementTree.Element, path: Path, parents: tuple[Path, ...], reading: _Reading) -> None:
    children: list[ElementTree.Element] = []
    for child in element:
        if child.tag == "include":
            file = child.get("file")
            if file is None:
                raise ModelError(f"{printable(path)} has an <include> without a file.")
            # From the including file, or as MuJoCo's reference says, from the main one.
            beside, main = path.parent / file, reading.folder / file
            where = beside if os.path.isfile(beside) or not os.path.isfile(main) else main
            included = _resolved(where, parents, reading)
            reading.origins.update((one, where.parent) for one in included.iter() if one not in reading.origins)
            children.extend(included)
        else:
            _resolve_below(child, path, parents, reading)
            children.append(child)
    element[:] = children


def _place(path: Path) -> Path:
    """A file's own path, whatever links lead there."""
    try:
        return Path(os.path.realpath(path))
    except ValueError:  # no name of a file: reading it says so
        return path


_TEXTURES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_FOLDER_OF = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "flexcomp": "meshdir", "texture": "texturedir"}


def _standing_alone(
    root: ElementTree.Element, reading: _Reading, assets: dict[str, bytes], files: dict[str, bytes]
) -> ElementTree.Element:
    """The root with its files renamed to names without folders, their content added to `files`."""
    settings: dict[str, str] = {}
    for compiler in root.findall("compiler"):
        for key in ("assetdir", "meshdir", "texturedir", "strippath"):
            if key in compiler.attrib:
                settings[key] = compiler.attrib.pop(key)
    for element in root.iter():
        if element.tag not in _FOLDER_OF and element.tag != "model":
            continue
        for key in _TEXTURES if element.tag == "texture" else ("file",):
            file = element.get(key)
            if not file:
                continue
            if settings.get("strippath") == "true":
                file = re.split(r"[/\\]", file)[-1]
            below = settings.get(_FOLDER_OF.get(element.tag, ""), settings.get("assetdir", ""))
            sought = [reading.folder / ("" if element.tag == "model" else below) / file]
            sought += [reading.origins[element] / file] if element in reading.origins else []
            where = next((path for path in sought if os.path.isfile(path)), sought[0])
            content = assets.get(file) if reading.stored is None else reading.stored.get(base(file))
            if content is None and reading.stored is not None:
                raise ModelError(f"the model names the file {short_repr(file)}, expected one that is stored with it.")
            if content is None and element.tag == "model":  # a model of its own, to be attached
                part = _standing_alone(*_read(where, reading.budget, reading.parents), assets, files)
                content = ElementTree.tostring(part)
            elif content is None:
                plain = where if os.path.isfile(where) else Path(os.path.normpath(where))  # a message without a/../b
                content = read_input(plain, f"{file!r} that the model names at", raises=ModelError)
            if key == "file" and element.tag in ("mesh", "hfield", "texture"):  # MuJoCo would name it after the file
                element.attrib.setdefault("name", Path(file).stem)
            element.set(key, _stored(Path(file).name, content, files))
    return root


def _stored(name: str, content: bytes, files: dict[str, bytes]) -> str:
    """The name that some content has in `files`, where two files from different folders may share theirs."""
    stem, suffix = os.path.splitext(name)
    number = 1
    while files.setdefault(name, content) != content:
        number += 1
        name = f"{stem}-{number}{suffix}"
    return name


def edited(text: str, edits: dict[str, dict[str, str]]) -> str:
    """The text with attributes set: {"actuator/general[@name='piston']": {"gainprm": "100"}}."""
    root = parsed(text, "the model")
    for path, attributes in edits.items():
        element = root.find(path)
        if element is None:
            raise ModelError(f"the model has no element {path}.")
        element.attrib.update(attributes)
    return ElementTree.tostring(root, encoding="unicode")


def written(*values: float) -> str:
    """Numbers as MJCF text, exact to the last bit."""
    return " ".join(re.sub(r"\.0$", "", repr(float(value))) for value in values)
