"""MJCF texts: models of the package, includes resolved, the files they name, edits by path, limits of size. Pure XML.

A few lines can ask for more than a computer has (includes of includes, replicas of replicas), and MuJoCo's compiler
tries it: its time grows with the square of the number of bodies, and a model that attaches itself ends the process. So
files, elements, levels and copies are counted first, and a stored text may name only files that it carries.
"""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from planner.base.arguments import short_repr
from planner.base.data_files import MODEL_FOLDERS
from planner.base.errors import ModelError
from planner.base.files import printable, read_input, read_text

MAX_ELEMENTS = 200_000  # written, includes resolved
MAX_FILES = 1000  # read for them
MAX_LEVELS = 500  # of elements, well below Python's own limit on recursion
MAX_PARENTS = 100  # files in files
MAX_COPIES = 20_000  # elements that only the compiler makes: some ten seconds of its time

# Elements that the compiler makes several times, as often as the product of their `count`.
_COPIED = ("replicate", "composite", "flexcomp")


@dataclass
class Budget:
    """Count of the files and elements of one model."""

    files: int = 0
    elements: int = 0

    def spend(self, text: str) -> None:
        """Count one more file, before it is parsed."""
        self.files += 1
        self.elements += text.count("<") - text.count("</")  # comments too, which does not matter
        if self.files > MAX_FILES:
            raise ModelError(f"the model reads more than {MAX_FILES} files, expected fewer includes.")
        if self.elements > MAX_ELEMENTS:
            raise ModelError(f"the model has more than {MAX_ELEMENTS} elements, expected fewer.")


def parsed(
    text: str, name: str, budget: Budget | None = None, roots: tuple[str, ...] = ("mujoco", "mujocoinclude")
) -> ElementTree.Element:
    """The root of an MJCF text, or of one with another root element, within the budget."""
    if "<!ENTITY" in text:  # entities can grow without bound; models have no use for them
        raise ModelError(f"{name} declares XML entities, expected plain {'URDF' if 'robot' in roots else 'MJCF'}.")
    (budget or Budget()).spend(text)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:  # ValueError: characters that no file can hold
        raise ModelError(f"{name} is not well-formed XML: {error}.") from None
    if root.tag not in roots:
        hint = ": it is a URDF, read by Mechanism.from_urdf" if root.tag == "robot" else ""
        raise ModelError(f"{name} has the root element <{root.tag}>, expected <{roots[0]}>{hint}.")
    check_levels(root, name)
    return root


def check_levels(root: ElementTree.Element, name: str) -> None:
    """Raise ModelError where elements lie deeper in each other than a recursion can follow."""
    level, levels = [root], 0
    while level := [child for element in level for child in element]:
        levels += 1
        if levels > MAX_LEVELS:
            raise ModelError(f"{name} is nested too deeply, expected at most {MAX_LEVELS} levels.")


def check_copies(root: ElementTree.Element, files: dict[str, bytes]) -> None:
    """Raise ModelError where <replicate> and its like, or attached models among the files, make too many elements."""
    try:
        made = _made(root, files, {})
    except RecursionError:
        raise ModelError("the model's attached models attach others too deeply, expected a few levels.") from None
    if made - sum(1 for _ in root.iter()) > MAX_COPIES:
        raise ModelError(f"replicas and attached models make more than {MAX_COPIES} elements, expected fewer.")


def check_stored(text: str, files: dict[str, bytes]) -> None:
    """Raise ModelError unless a text from a plan stands alone: nothing but the plan's own files may be read for it."""
    root = parsed(text, "its model")
    check_copies(root, files)  # before the walk: no model attaches itself
    carried, models = by_name(files), [root]
    seen: set[str] = set()
    while models:
        model = models.pop()
        for element in model.iter():
            for key, file in element.items():
                if key.startswith("file") and file and (element.tag == "include" or base(file) not in carried):
                    raise ModelError(f"its model names the file {file!r} that the plan does not carry.")
        for file, content in _attached(model, files):
            if file not in seen:
                seen.add(file)
                models.append(_part(file, content))


def _made(root: ElementTree.Element, files: dict[str, bytes], sizes: dict[str, int | None]) -> int:
    """Number of elements that the compiler makes of a model; `sizes` has the attached ones, None while counted."""
    largest = 0
    for file, content in _attached(root, files):
        if file not in sizes:
            sizes[file] = None
            sizes[file] = _made(_part(file, content), files, sizes)
        size = sizes[file]
        if size is None:
            raise ModelError(f"the attached model {file!r} attaches itself.")
        largest = max(largest, size)

    def made(element: ElementTree.Element) -> int:
        below = sum(map(made, element)) + (largest if element.tag == "attach" else 0)
        return 1 + (max(below, 1) * _count(element) if element.tag in _COPIED else below)

    return made(root)


def _count(element: ElementTree.Element) -> int:
    """The product of the numbers in an element's `count`; MuJoCo itself refuses anything else there."""
    return math.prod(max(1, int(digits[:18])) for digits in re.findall(r"[0-9]+", element.get("count", "")))


def _attached(root: ElementTree.Element, files: dict[str, bytes]) -> Iterator[tuple[str, bytes]]:
    """Name and content of the models that a model names, as far as they are there."""
    carried = by_name(files)
    for element in root.iter("model"):
        file = base(element.get("file", ""))
        if file in carried:
            yield file, carried[file]


def _part(file: str, content: bytes) -> ElementTree.Element:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ModelError(f"the attached model {file!r} is not text, expected MJCF.") from None
    return parsed(text, f"the attached model {file!r}")


def by_name(files: dict[str, bytes]) -> dict[str, bytes]:
    """Files by the names by which MuJoCo finds them in memory."""
    return {base(name): content for name, content in files.items()}


def base(file: str) -> str:
    """The name by which MuJoCo finds a file in memory: without its folder, in lower case."""
    return re.split(r"[/\\]", file)[-1].lower()


def model_path(name: str) -> Path:
    """The folder of a model that comes with the package, e.g. "hopper"."""
    for folder in MODEL_FOLDERS:
        if (folder / name / "scene.xml").is_file():
            return folder / name
    known = sorted({scene.parent.name for folder in MODEL_FOLDERS for scene in folder.glob("*/scene.xml")})
    raise ModelError(f"there is no model {name!r}, expected one of: {', '.join(known)}.")


def is_text(model: object) -> bool:
    """Whether a model is given as its XML text rather than as the path of a file."""
    return isinstance(model, str) and "<" in model


def model_text(path: str | Path) -> str:
    """The XML text of an MJCF file with its includes resolved."""
    return ElementTree.tostring(_read(Path(path), Budget(), ())[0], encoding="unicode")


def model_tree(
    model: str | Path, assets: dict[str, bytes] | None = None, *, stored: bool = False, folder: Path | None = None
) -> tuple[ElementTree.Element, dict[str, bytes]]:
    """A model that stands alone: its XML with includes resolved and the files it names, by the name it uses.

    Files are sought in `assets` first; those that a text names, then from `folder`, by default the working directory.
    The model of a `stored` plan names only assets, by whatever folder, as MuJoCo finds them: nothing is read from disk
    for it. The compiler's folders (meshdir, texturedir, assetdir) are gone: every file has a name without a folder.
    """
    if isinstance(model, str) and not model.strip():
        raise ModelError("the model is an empty text, expected MJCF or the path of a file.")
    if not isinstance(model, (str, os.PathLike)):
        raise ModelError(f"the model is a {type(model).__name__}, expected MJCF text or the path of a file.")
    files: dict[str, bytes] = {}
    root, reading = _read(model, Budget(), ())
    reading.folder = folder or reading.folder
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
