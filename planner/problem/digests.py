"""Digests: what of a plan's file was changed after it was written.

They are no signature, whoever changes a plan on purpose can write new ones: they name what an editor, a script or a
broken copy changed.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np

_WORDS = {
    "t": "times t", "xs": "states xs", "us": "controls us", "K": "gains K", "history": "iterations",
    "mjcf": "the model", "twin": "the maps to the model's state",
}  # fmt: skip


def digests(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> dict[str, str]:
    """A digest of every array and every part of the meta, by name."""
    found = {name: _digest(str(array.shape).encode() + array.tobytes()) for name, array in arrays.items()}
    return found | {name: _digest(json.dumps(part, sort_keys=True).encode()) for name, part in meta.items()}


def changed(arrays: dict[str, np.ndarray], meta: dict[str, Any], written: dict[str, str]) -> tuple[str, ...]:
    """What is not as it was written, in words: "controls us"."""
    now = digests(arrays, meta)
    names = dict.fromkeys([*written, *now])
    return tuple(_WORDS.get(name, name) for name in names if written.get(name) != now.get(name))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]
