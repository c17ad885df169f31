"""Answers as a language model reads them: without what is empty, few digits, no control characters."""

from typing import Any

import msgspec

from prior_sg.deploy.json_text import json_text
from prior_sg.schemas.names import shown

DECIMALS = 3


def lean_json(answer: msgspec.Struct) -> str:
    """JSON of an answer on one line."""
    return json_text(lean(msgspec.to_builtins(answer)), indent=None)


def lean(value: Any) -> Any:
    """Plain Python without fields that are null or empty text."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, float):
        return round(value, DECIMALS)
    if isinstance(value, dict):
        return {one_line(str(name)): lean(item) for name, item in value.items() if item is not None and item != ""}
    return [lean(item) for item in value] if isinstance(value, list | tuple) else value


def one_line(text: str) -> str:
    """Without line breaks, and without what a terminal would obey."""
    return shown(" ".join(text.split()))
