"""Limit how large an MJCF text may become, and check that a stored one names only files that it carries.

A few lines can ask for more than a machine has (includes of includes, replicas of replicas), and MuJoCo's compiler
tries it: its time grows with the square of the number of bodies, and a model that attaches itself ends the process.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass

from planner.base.errors import ModelError

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
