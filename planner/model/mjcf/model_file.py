"""Open an MJCF file: its text with includes resolved, the files it names, and MuJoCo's compilation of it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from planner.model.mjcf.meshes import coarsen_visual_meshes
from planner.model.mjcf.model_index import ModelIndex, compile_model
from planner.model.mjcf.text import is_text, model_tree


class ModelFile(NamedTuple):
    """A file as it was written; only its visual meshes are coarser, on which no fact of the survey depends."""

    root: ElementTree.Element  # Not to be changed
    files: dict[str, bytes]  # By the names that the text uses
    survey: ModelIndex  # Of the file with its own meshes
    name: str  # For a sentence
    compiled: bool  # Whether the survey's model is what root compiles to: no mesh is coarser


def open_model_file(
    model: str | Path, assets: dict[str, bytes] | None = None, name: str = "", *, stored: bool = True
) -> ModelFile:  # fmt: skip
    """Read and compile a file or text; messages call it `name`, by default after its file.

    What is not to be stored keeps its visual meshes.

    Raises:
        ModelError: It cannot be read, or MuJoCo refuses it.
    """
    name = name or ("the model" if is_text(model) else f"the model {model}")
    root, files = model_tree(model, assets, stored=assets is not None)
    survey = ModelIndex(compile_model(root, files, name))
    coarser = stored and coarsen_visual_meshes(root, files, survey.model)
    return ModelFile(root, files, survey, name, not coarser)
