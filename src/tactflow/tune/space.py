"""The pipelines that `tactflow tune` tries: all combinations of a few alternatives."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import from_settings
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

MIN_SIDE: Final = 90
"""Minimum shorter side of the processed image, px: a contact of a tenth of it covers about 60 px."""
MIN_PITCH: Final = 6.0
"""Minimum dot pitch, processed px; the smallest on a real gel is 7 (sts_torque160)."""

Settings = Mapping[str, Any]
DOWNSAMPLE: Final = "stages.preprocess.downsample"
AXES: Final[Mapping[str, Mapping[str, Settings]]] = {
    "preprocess": {f"downsample {k}": {DOWNSAMPLE: k} for k in (1, 2, 4)},
    "difference": {m: {"stages.difference.method": m} for m in ("noise", "colour")},
    "fusion": {"fusion": {}, "no fusion": {"stages.fusion": None}},
    "field": {"field": {}, "mean": {"stages.field": None, "stages.flow_in_mask.method": "mean"}},
}
"""Stage -> name of an alternative -> its settings, most expensive first. `inpaint` is not varied: telea and
ns take 300 times as long as `normalized` and are no more accurate, and without inpainting the error of the
contact's centre is three to eight times as large (scene `press`)."""


class Candidate(NamedTuple):
    """A pipeline to try: its name, and the settings that it changes in the user's file."""

    name: str
    settings: tuple[tuple[str, Any], ...] = ()

    def load(self, file: Path, sensor: str | None = None) -> Pipeline:
        """Load the pipeline. Raises ConfigError like `load_pipeline`."""
        return load_pipeline(file, from_settings(dict(self.settings)), sensor=sensor)


def candidates(pipeline: Pipeline, size: tuple[int, int], pitch: float | None) -> list[Candidate]:
    """All combinations of the alternatives for the stages of a pipeline, most expensive first.

    Parameters
    ----------
    pipeline : the original. size : (width, height) before downsampling, px. pitch : of the dots, px; None
        without dots.

    Raises
    ------
    ConfigError : the pipeline has none of the stages.

    >>> import tactflow
    >>> [c.name for c in candidates(tactflow.load("markerless"), (400, 300), None)][:2]
    ['downsample 1, noise', 'downsample 1, colour']
    """
    # Only stages with the built-in implementation.
    built_in = {id_ for id_, node in pipeline.nodes.items() if node.component.name == id_}
    axes = [choices for stage, choices in AXES.items() if stage in built_in]
    if not axes:
        raise ConfigError(f"{pipeline.file}: tune has no alternatives for any of its stages")
    result = []
    for names in product(*axes):
        settings: dict[str, Any] = {}
        for choices, name in zip(axes, names, strict=True):
            settings |= choices[name]
        if "flow_in_mask" not in pipeline.nodes:
            settings.pop("stages.flow_in_mask.method", None)
        factor = settings.get(DOWNSAMPLE, 1)
        fits = min(size) / factor >= MIN_SIDE and (pitch is None or pitch / factor >= MIN_PITCH)
        if fits or factor == 1:
            result.append(Candidate(", ".join(names), tuple(settings.items())))
    return result
