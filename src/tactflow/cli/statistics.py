"""The statistics file that `tactflow run --stats` writes, read again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tactflow.engine.errors import ConfigError


def read_statistics(path: Path) -> Mapping[str, Any]:
    """The content of a statistics file; raises ConfigError if it is none."""
    try:
        data = json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"--stats {path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"--stats {path}: not JSON: {error}") from None
    if not _are_statistics(data):
        raise ConfigError(f"--stats {path}: not a statistics file; tactflow run --stats writes one")
    return data  # type: ignore[no-any-return]


def _are_statistics(data: Any) -> bool:
    """True if the parts shown here are there and have the right types."""
    if not isinstance(data, dict):
        return False
    stages, sinks = data.get("stages"), data.get("sinks", {})
    return (
        isinstance(stages, dict)
        and isinstance(sinks, dict)
        and "end" in data
        and all(isinstance(data.get(key), int | float) for key in ("frames", "dropped", "wall_s"))
        and _is_pair(data.get("latency_ms"), "p50", "p99")
        and all(
            _is_pair(node, "p50_ms", "p99_ms")
            and isinstance(node.get("runs"), int)
            and isinstance(node.get("skips"), dict)
            and all(isinstance(count, int) for count in node["skips"].values())
            and isinstance(node.get("total_ms"), int | float | None)
            for node in (*stages.values(), *sinks.values())
        )
    )


def _is_pair(value: Any, *keys: str) -> bool:
    return isinstance(value, dict) and all(
        key in value and isinstance(value[key], int | float | None) for key in keys
    )
