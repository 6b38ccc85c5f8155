"""JSON as we write it: without NaN and infinity, which JSON does not have."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from planner.base.files import write_atomically


def finite(value: Any) -> Any:
    """Replace nonfinite floats by None, since JSON has no NaN and no infinity."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(content: dict[str, Any]) -> str:
    """The text of a JSON file."""
    return json.dumps(finite(content), indent=2, allow_nan=False) + "\n"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON document atomically."""
    with write_atomically(path) as unfinished:
        unfinished.write_text(json_text(content), encoding="utf-8")
