"""Builds and runs pipelines of toy stages."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from tactflow.config.load import load_pipeline
from tactflow.engine.run import Runner

TOYS = Path(__file__).with_name("toys.py")

STAGES: dict[str, dict[str, Any]] = {
    "capture": {"use": "Ramp", "frames": 20},
    "level": {"use": "Level"},
    "pulse": {"use": "Pulse"},
    "heavy": {"use": "Heavy"},
    "gated": {"use": "Gated", "when": "active"},
    "total": {"use": "Total"},
    "join": {"use": "Join"},
}

MakeRunner = Callable[..., Runner]


@pytest.fixture
def toy_runner(tmp_path: Path) -> MakeRunner:
    """Make a runner for the toy graph.

    `stages` are merged into it (None removes one); `sinks` are its sinks, one that collects by default.
    """
    shutil.copy(TOYS, tmp_path / "toys.py")

    def make(
        stages: Mapping[str, Mapping[str, Any] | None] | None = None,
        sinks: Mapping[str, Mapping[str, Any]] | None = None,
        *,
        max_frames: int | None = None,
        check: bool = False,
        **top: Any,
    ) -> Runner:
        merged: dict[str, Any] = {name: dict(body) for name, body in STAGES.items()}
        for name, body in (stages or {}).items():
            if body is None:
                del merged[name]
            else:
                merged[name] = {**merged.get(name, {}), **body}
        chosen = {name: dict(body) for name, body in (sinks or {"out": {"use": "Collect"}}).items()}
        document = {"sensor": "toy", **top, "stages": merged, "sinks": chosen}
        for body in (*document["stages"].values(), *document["sinks"].values()):
            body["use"] = f"./toys.py:{body['use']}"
        path = tmp_path / "toy.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        return Runner(load_pipeline(path), max_frames=max_frames, check=check)

    return make
