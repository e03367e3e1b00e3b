"""The pipelines that `tactflow tune` tries: all combinations of a few alternatives."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, Final

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import from_settings
from tactflow.engine.errors import ConfigError
from tactflow.tools.tune.measure import Trial

ORIGINAL: Final = "as given"
"""Name of the user's own pipeline, whatever its settings."""
MIN_SIDE: Final = 90
"""Minimum shorter side of the processed image, px: a contact of a tenth of it covers about 60 px."""
MIN_PITCH: Final = 6.0
"""Minimum dot pitch, processed px; the smallest on a real gel is 7 (sts_torque160)."""

DOWNSAMPLE: Final = "stages.preprocess.downsample"
AXES: Final[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {
    "preprocess": {f"downsample {k}": {DOWNSAMPLE: k} for k in (1, 2, 4)},
    "fusion": {"fusion": {}, "no fusion": {"stages.fusion": None}},
    "field": {"field": {}, "mean": {"stages.field": None, "stages.flow_in_mask.method": "mean"}},
}
"""Stage -> name of an alternative -> its settings, most expensive first. `inpaint` is not varied: telea and
ns take 300 times as long as `normalized` and are no more accurate, and without inpainting the error of the
contact's centre is three to eight times as large (scene `press`)."""


def candidates(
    file: Path, size: tuple[int, int], pitch: float | None, sensor: str | None = None
) -> list[Trial]:
    """The original, and all combinations of the alternatives for its stages, most expensive first.

    Combinations that the pipeline file does not allow are left out.

    Parameters
    ----------
    file : the original. size : (width, height) before downsampling, px. pitch : of the dots, px; None
        without dots. sensor : name of one of several, or None.

    Raises
    ------
    ConfigError : the pipeline has none of the stages.

    >>> from tactflow.config.shipped import find_pipeline
    >>> [c.name for c in candidates(find_pipeline("markerless"), (400, 300), None)][:3]
    ['downsample 1', 'as given']
    """
    original = load_pipeline(file, sensor=sensor)
    # Only stages with the built-in implementation.
    built_in = {id_ for id_, node in original.nodes.items() if node.component.name == id_}
    axes = [choices for stage, choices in AXES.items() if stage in built_in]
    if not axes:
        raise ConfigError(f"{file}: tune has no alternatives for any of its stages")
    found = []
    for names in product(*axes):
        settings: dict[str, Any] = {}
        for choices, name in zip(axes, names, strict=True):
            settings |= choices[name]
        if "flow_in_mask" not in original.nodes:
            settings.pop("stages.flow_in_mask.method", None)
        factor = settings.get(DOWNSAMPLE, 1)
        fits = min(size) / factor >= MIN_SIDE and (pitch is None or pitch / factor >= MIN_PITCH)
        if not fits and factor != 1:
            continue
        try:
            pipeline = load_pipeline(file, from_settings(settings), sensor=sensor)
        except ConfigError:
            continue
        if pipeline.nodes == original.nodes:
            found.append(Trial(ORIGINAL, {}, original))
        else:
            found.append(Trial(", ".join(names), settings, pipeline))
    if not any(candidate.name == ORIGINAL for candidate in found):
        found.insert(1, Trial(ORIGINAL, {}, original))
    return found
