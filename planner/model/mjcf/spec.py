"""Models that people hold in their hands: mujoco.MjSpec and elements of dm_control, as MJCF text and files.

MuJoCo writes the XML of a spec to six digits, unless its library is told to write all of them. What it wrote is
compared with what the spec itself compiles to, number by number, so no digit is lost in silence.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.text import model_tree

DIGITS = 17  # of a double, none lost
TOLERANCE = 1e-12
"""Relative: the compiler turns frames of meshes and inertias back and forth, which rounds. Six digits are 1e-6."""
EXPECTED = "MJCF text, the path of a file, a mujoco.MjSpec or an element of dm_control.mjcf"


def mjcf_source(model: Any, assets: dict[str, bytes] | None = None) -> tuple[Any, dict[str, bytes] | None]:
    """A model as a text or path, and its files by the names that the text uses; the caller's object stays as it was.

    A text or path is returned as it is, with `assets`.

    Raises:
        ModelError: It is something else, MuJoCo refuses it, or its text would not be the same model.
    """
    if isinstance(model, (str, os.PathLike)):
        return model, assets
    mujoco = load_mujoco()
    if isinstance(model, mujoco.MjSpec):
        return _of_spec(model, assets or {})
    if hasattr(model, "to_xml_string") and hasattr(getattr(model, "root", None), "get_assets"):
        return model.root.to_xml_string(), {**model.root.get_assets(), **(assets or {})}
    if isinstance(model, mujoco.MjModel):
        raise ModelError(
            "the model is a compiled MjModel, which no longer has the text it was made of: pass that text, its path, "
            "or a spec of it, mujoco.MjSpec.from_file(path)."
        )
    raise ModelError(f"the model is a {type(model).__name__}, expected {EXPECTED}.")


def _of_spec(spec: Any, assets: dict[str, bytes]) -> tuple[str, dict[str, bytes]]:
    mujoco = load_mujoco()
    copy = spec.copy()
    copy.assets = {**spec.assets, **assets}
    try:
        own = copy.compile()
        with _all_digits():
            text = copy.to_xml()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ModelError(f"MuJoCo refuses the model: {' '.join(str(error).split())}.") from None
    root, files = model_tree(text, copy.assets, folder=Path(spec.modelfiledir))
    differs = different_field(own, compile_model(root, files))
    if differs:
        raise ModelError(
            f"the XML that MuJoCo {mujoco.__version__} writes of the spec has another {differs} than the spec itself: "
            "pass the text or the path that it was made of."
        )
    return ElementTree.tostring(root, encoding="unicode"), files


@contextmanager
def _all_digits() -> Iterator[None]:
    """A context in which MuJoCo writes numbers with all their digits, where its library has a function for that."""
    folder = Path(load_mujoco().__file__).parent
    files = [file for file in sorted(folder.glob("*mujoco.*")) if file.name.startswith(("libmujoco.", "mujoco.dll"))]
    library = ctypes.CDLL(str(files[0])) if files else None
    if not hasattr(library, "_mjPRIVATE__set_xml_precision"):  # the comparison refuses what is lost
        yield
        return
    assert library is not None  # it has the attribute
    before = library._mjPRIVATE__get_xml_precision()
    library._mjPRIVATE__set_xml_precision(DIGITS)
    try:
        yield
    finally:
        library._mjPRIVATE__set_xml_precision(before)


def different_field(first: Any, second: Any) -> str:
    """The name of a field of numbers in which two compiled models differ, or "" if there is none."""
    for a, b, before in ((first, second, ""), (first.opt, second.opt, "opt.")):
        for name in dir(a):
            if name.startswith("_") or not isinstance(value := getattr(a, name), (np.ndarray, float)):
                continue
            one, other = np.asarray(value), np.asarray(getattr(b, name))
            if one.shape != other.shape:
                return before + name
            if one.dtype.kind == "f" and not np.allclose(
                one, other, rtol=TOLERANCE, atol=TOLERANCE * np.abs(one).max(initial=1.0), equal_nan=True
            ):
                return before + name
    return ""
