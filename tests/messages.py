"""The result message as a subscriber has it after parsing."""

from __future__ import annotations

from typing import Any

import orjson

from tactflow.engine.frame import Tick
from tactflow.message.encoding import Results, encode_message


def build_message(tick: Tick, results: Results, *, detail: bool = False) -> dict[str, Any]:
    """The message about one frame as plain dicts, lists and numbers."""
    message: dict[str, Any] = orjson.loads(encode_message(tick, results, detail=detail))
    return message
