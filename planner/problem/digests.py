"""Digests: which parts of a plan's file were changed after it was written.

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
    "mjcf": "the model", "recipe": "the problem's parameters", "twin": "the maps to the model's state",
}  # fmt: skip


def digests(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> dict[str, str]:
    """A digest of every array and every part of the meta, by name."""
    found = {name: digest_of(str(array.shape).encode() + array.tobytes()) for name, array in arrays.items()}
    return found | {name: digest_of(json.dumps(part, sort_keys=True).encode()) for name, part in meta.items()}


def changed(arrays: dict[str, np.ndarray], meta: dict[str, Any], written: dict[str, str]) -> tuple[str, ...]:
    """Names of the parts whose digest no longer matches, in words: "controls us"."""
    now = digests(arrays, meta)
    names = dict.fromkeys([*written, *now])
    return tuple(_WORDS.get(name, name) for name in names if written.get(name) != now.get(name))


def digest_of(content: bytes) -> str:
    """32 hexadecimal digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:32]
