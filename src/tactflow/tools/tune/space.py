"""The pipelines that `tactflow tune` tries: all combinations of a few alternatives, and single swaps of
stages.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, Final

from tactflow.config.load import load_pipeline
from tactflow.config.models import RESERVED
from tactflow.config.overrides import from_settings
from tactflow.config.replacements import methods_of, replacements
from tactflow.engine.errors import ConfigError
from tactflow.tools.tune.measure import Trial

ORIGINAL: Final = "as given"
"""Name of the user's own pipeline, whatever its settings."""
MIN_SIDE_PX: Final = 90
"""Minimum shorter side of the processed image, px: a contact of a tenth of it covers about 60 px."""
MIN_PITCH_PX: Final = 6.0
"""Minimum dot pitch, processed px; the smallest on a real gel is 7 (sts_torque160)."""

DOWNSAMPLE: Final = "stages.preprocess.downsample"
AXES: Final[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {
    "preprocess": {f"downsample {k}": {DOWNSAMPLE: k} for k in (1, 2, 4)},
    "fusion": {"fusion": {}, "no fusion": {"stages.fusion": None}},
    "field": {"field": {}, "mean": {"stages.field": None, "stages.flow_in_mask.method": "mean"}},
}
"""Stage -> name of an alternative -> its settings, most expensive first. They are combined."""


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
        fits = min(size) / factor >= MIN_SIDE_PX and (pitch is None or pitch / factor >= MIN_PITCH_PX)
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


def swaps(file: Path, sensor: str | None = None) -> list[Trial]:
    """The original with one of its stages swapped for another: every `method` of each stage, and everything
    registered that can take its place.

    A swapped stage keeps the keys of the file, and the parameters that both have. Swaps that the pipeline
    does not allow are left out.

    file, sensor : as for `candidates`.

    >>> from tactflow.config.shipped import find_pipeline
    >>> [trial.name for trial in swaps(find_pipeline("markerless"))][-3:]
    ['hull: fit_line', 'hull: min_area_rect', 'depth: frankot_chellappa']
    """
    original = load_pipeline(file, sensor=sensor)
    found = []
    for id_, node in original.nodes.items():
        entry = dict(original.settings["stages"].get(id_) or {}) if node.component.kind == "stage" else None
        if entry is None:
            continue
        present = getattr(node.params, "method", None)
        others = [method for method in methods_of(node.component) if method != present]
        ways = {method: entry | {"method": method} for method in others}
        for other in replacements(node.component, (node.component for node in original.nodes.values())):
            shared = {key: entry[key] for key in entry if key in RESERVED or key in other.params.model_fields}
            ways[other.name] = shared | {"use": other.name}
        for name, changed in ways.items():
            settings = {f"stages.{id_}": changed}
            try:
                pipeline = load_pipeline(file, from_settings(settings), sensor=sensor)
            except ConfigError:
                continue
            found.append(Trial(f"{id_}: {name}", settings, pipeline))
    return found
