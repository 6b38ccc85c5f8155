"""MJCF files: those of the package, text with includes resolved and the files it names, edits by path.

Pure XML: MuJoCo itself is asked only by mechanism_reader, replay and render.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from planner.errors import ModelError

# In the wheel mjcf/ lies inside the package, in a checkout beside it.
_FOLDERS = (Path(__file__).parent / "mjcf", Path(__file__).parent.parent / "mjcf")


def model_path(name: str) -> Path:
    """The folder of a model that comes with the package, e.g. "hopper"."""
    for folder in _FOLDERS:
        if (folder / name / "scene.xml").is_file():
            return folder / name
    known = sorted({scene.parent.name for folder in _FOLDERS for scene in folder.glob("*/scene.xml")})
    raise ModelError(f"there is no model {name!r}, expected one of: {', '.join(known)}.")


def model_text(path: str | Path) -> str:
    """The XML text of an MJCF file with its includes resolved.

    Raises:
        ModelError: A file that is missing, is not XML, or includes itself.
    """
    return ElementTree.tostring(_read(Path(path))[0], encoding="unicode")


def model_tree(
    model: str | Path, assets: dict[str, bytes] | None = None
) -> tuple[ElementTree.Element, dict[str, bytes]]:
    """A model that stands alone: its XML with includes resolved and the files it names, by the name it uses.

    The compiler's folders (meshdir, texturedir, assetdir) are gone: every file has a name without a folder.

    Args:
        model: A path, or the XML text itself; files that a text names are sought from the working directory.
        assets: Files by the name that the text uses, sought first.

    Raises:
        ModelError: Text or a file that is missing, is not MJCF, or includes itself.
    """
    if isinstance(model, str) and not model.strip():
        raise ModelError("the model is an empty text, expected MJCF or the path of a file.")
    if not isinstance(model, (str, os.PathLike)):
        raise ModelError(f"the model is a {type(model).__name__}, expected MJCF text or the path of a file.")
    files: dict[str, bytes] = {}
    return _standing_alone(*_read(model), assets or {}, files), files


# The folder of the file that an element was included from, where it is not the model's own.
_Origins = dict[ElementTree.Element, Path]


def _read(model: str | os.PathLike[str]) -> tuple[ElementTree.Element, Path, _Origins]:
    """The resolved XML of a text or a path, the model's folder, and where included elements came from."""
    text = isinstance(model, str) and "<" in model
    path = Path() if text else Path(model)
    origins: _Origins = {}
    try:
        if not text:
            return _resolved(path, path.parent, (), origins), path.parent, origins
        root = _parsed(str(model), "the model")
        _resolve_below(root, Path("the model"), Path(), (), origins)
        return root, Path(), origins
    except RecursionError:
        name = "the model" if text else f"the model {path}"
        raise ModelError(f"{name} is nested too deeply, expected MJCF of some tens of levels.") from None


def _resolved(path: Path, folder: Path, parents: tuple[Path, ...], origins: _Origins) -> ElementTree.Element:
    """A file's root with its includes resolved; `folder` is that of the whole model."""
    try:
        if path.resolve() in parents:
            raise ModelError(f"{path} includes itself.")
        text = path.read_text(encoding="utf-8-sig")
    except ModelError:
        raise
    except (OSError, ValueError) as error:  # ValueError: bytes that are no text, a NUL in the path
        reason = getattr(error, "strerror", None) or "it is not text"
        raise ModelError(f"cannot read the model {path}: {reason}.") from None
    root = _parsed(text, str(path))
    _resolve_below(root, path, folder, (*parents, path.resolve()), origins)
    return root


def _parsed(text: str, name: str) -> ElementTree.Element:
    if "<!ENTITY" in text:  # entities can grow without bound; MJCF has no use for them
        raise ModelError(f"{name} declares XML entities, expected plain MJCF.")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:  # ValueError: characters that no file can hold
        raise ModelError(f"{name} is not well-formed XML: {error}.") from None
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise ModelError(f"{name} has the root element <{root.tag}>, expected <mujoco>.")
    return root


def _resolve_below(
    element: ElementTree.Element, path: Path, folder: Path, parents: tuple[Path, ...], origins: _Origins
) -> None:
    children: list[ElementTree.Element] = []
    for child in element:
        if child.tag == "include":
            file = child.get("file")
            if file is None:
                raise ModelError(f"{path} has an <include> without a file.")
            # From the including file, or as MuJoCo's reference says, from the main one.
            beside = path.parent / file
            where = beside if beside.is_file() or not (folder / file).is_file() else folder / file
            included = _resolved(where, folder, parents, origins)
            origins.update((one, where.parent) for one in included.iter() if one not in origins)
            children.extend(included)
        else:
            _resolve_below(child, path, folder, parents, origins)
            children.append(child)
    element[:] = children


_TEXTURES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_FOLDER_OF = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "flexcomp": "meshdir", "texture": "texturedir"}


def _standing_alone(
    root: ElementTree.Element, folder: Path, origins: _Origins, assets: dict[str, bytes], files: dict[str, bytes]
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
            sought = [folder / ("" if element.tag == "model" else below) / file]
            sought += [origins[element] / file] if element in origins else []
            if element.tag == "model" and file not in assets:  # a model of its own, to be attached
                where = next((path for path in sought if path.is_file()), sought[0])
                part = _standing_alone(*_read(where), assets, files)
                content = ElementTree.tostring(part)
            else:
                content = assets.get(file)
                content = _content(file, sought) if content is None else content
            if key == "file" and element.tag in ("mesh", "hfield", "texture"):  # MuJoCo would name it after the file
                element.attrib.setdefault("name", Path(file).stem)
            element.set(key, _stored(Path(file).name, content, files))
    return root


def _content(file: str, sought: list[Path]) -> bytes:
    for path in sought:
        try:
            return path.read_bytes()
        except (OSError, ValueError):
            continue
    raise ModelError(f"cannot read {file!r} that the model names: there is no such file at {sought[0]}.")


def _stored(name: str, content: bytes, files: dict[str, bytes]) -> str:
    """The name that some content has in `files`, where two files from different folders may share theirs."""
    stem, suffix = os.path.splitext(name)
    number = 1
    while files.setdefault(name, content) != content:
        number += 1
        name = f"{stem}-{number}{suffix}"
    return name


def edited(text: str, edits: dict[str, dict[str, str]]) -> str:
    """The text with attributes set: {"actuator/general[@name='piston']": {"gainprm": "100"}}.

    Raises:
        ModelError: Text that is not MJCF, or a path that finds no element.
    """
    root = _parsed(text, "the model")
    for path, attributes in edits.items():
        element = root.find(path)
        if element is None:
            raise ModelError(f"the model has no element {path}.")
        element.attrib.update(attributes)
    return ElementTree.tostring(root, encoding="unicode")


def written(value: float) -> str:
    """A number as MJCF text, to the last bit."""
    return re.sub(r"\.0$", "", repr(float(value)))
