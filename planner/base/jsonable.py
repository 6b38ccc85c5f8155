"""Values as JSON can say them."""

from __future__ import annotations

import json
import math
from typing import Any


def finite(value: Any) -> Any:
    """The same value with null for every number that is not finite: JSON has no NaN and no infinity."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(content: dict[str, Any]) -> str:
    """A JSON document as files hold it."""
    return json.dumps(finite(content), indent=2, allow_nan=False) + "\n"
