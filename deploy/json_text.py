"""JSON for other programs: numbers that are none become null, which every reader of JSON knows."""

import json
import math
from typing import Any


def json_text(value: Any, indent: int | None = 1) -> str:
    """A value of dictionaries, lists, numbers and text as JSON without NaN and infinities."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
