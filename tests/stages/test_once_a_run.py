"""What a run needs once, it computes once: the dots of the reference, and the calibration."""

from __future__ import annotations

from typing import Any

import pytest

import tactflow
from tactflow.calibration.file import Calibration
from tactflow.vision.markers import detection


def counted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> list[str]:
    """The calls of a function from now on."""
    calls: list[str] = []
    original = getattr(owner, name)

    def call(*args: Any, **options: Any) -> Any:
        calls.append(name)
        return original(*args, **options)

    monkeypatch.setattr(owner, name, call)
    return calls


def test_the_dots_of_the_reference_are_detected_once_for_the_mask_and_the_tracker(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = counted(monkeypatch, detection, "candidates")
    result = list(tactflow.stream("default", source="sim:idle?frames=3"))[-1]
    assert result.markers is not None
    assert result["marker_mask"].any()
    assert calls == ["candidates"]


def test_the_calibration_is_read_once_for_all_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = counted(monkeypatch, Calibration, "load")
    settings = {"stages.normals": {}, "stages.force": {}}
    pipeline = tactflow.load("mini", source="sim:idle?frames=2", settings=settings)
    assert {"scale", "depth", "normals", "force"} <= set(pipeline.nodes)
    assert len(list(tactflow.stream(pipeline))) == 2
    assert calls == ["load"]


def test_a_calibration_that_no_sink_needs_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = counted(monkeypatch, Calibration, "load")
    tactflow.run("mini", source="sim:idle?frames=2", settings={"sinks": {}})
    assert calls == []
