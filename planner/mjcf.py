"""The MJCF files that come with the package: where they are, their text with includes resolved, edits by path.

Pure XML: MuJoCo itself is asked only by mechanism, replay and render.
"""

from __future__ import annotations

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
    try:
        return ElementTree.tostring(_resolved(Path(path), ()), encoding="unicode")
    except RecursionError:
        raise ModelError(f"the model {path} is nested too deeply, expected MJCF of some tens of levels.") from None


def _resolved(path: Path, parents: tuple[Path, ...]) -> ElementTree.Element:
    if path.resolve() in parents:
        raise ModelError(f"{path} includes itself.")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise ModelError(f"cannot read the model {path}: {reason}.") from None
    root = _parsed(text, str(path))
    _resolve_below(root, path, (*parents, path.resolve()))
    return root


def _parsed(text: str, name: str) -> ElementTree.Element:
    if "<!ENTITY" in text:  # entities can grow without bound; MJCF has no use for them
        raise ModelError(f"{name} declares XML entities, expected plain MJCF.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ModelError(f"{name} is not well-formed XML: {error}.") from None
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise ModelError(f"{name} has the root element <{root.tag}>, expected <mujoco>.")
    return root


def _resolve_below(element: ElementTree.Element, path: Path, parents: tuple[Path, ...]) -> None:
    children: list[ElementTree.Element] = []
    for child in element:
        if child.tag == "include":
            file = child.get("file")
            if file is None:
                raise ModelError(f"{path} has an <include> without a file.")
            children.extend(_resolved(path.parent / file, parents))
        else:
            _resolve_below(child, path, parents)
            children.append(child)
    element[:] = children


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
