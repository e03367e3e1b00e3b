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

LEAST_SIDE: Final = 90
"""Shorter side of a processed picture, px, at least: contacts of a tenth of it have 60 px."""
LEAST_PITCH: Final = 6.0
"""Pitch of the dots, processed px, at least: the narrowest found on a real gel has 7 (sts_torque160)."""
REFERENCES: Final = 8
"""Frames of the reference that are tried besides one: they lower the noise of the dots' displacements by a
third, and nobody waits for them."""

Settings = Mapping[str, Any]
DOWNSAMPLE: Final = "stages.preprocess.downsample"
AXES: Final[Mapping[str, Mapping[str, Settings]]] = {
    "preprocess": {f"downsample {k}": {DOWNSAMPLE: k} for k in (1, 2, 4)},
    "difference": {m: {"stages.difference.method": m} for m in ("noise", "colour")},
    "fusion": {"fusion": {}, "no fusion": {"stages.fusion": None}},
    "field": {"field": {}, "mean": {"stages.field": None, "stages.flow_in_mask.method": "mean"}},
}
"""Stage -> name of an alternative -> what it sets; the most expensive first. Other methods of `inpaint` are
not tried: telea and ns take 300 times as long as `normalized` and are no more exact, and without it the
contact's centre is off by three to eight times as much (scene `press`)."""


class Candidate(NamedTuple):
    """One pipeline to try: a name, and what it sets in the file that the user gave."""

    name: str
    settings: tuple[tuple[str, Any], ...] = ()

    def load(self, file: Path, sensor: str | None = None) -> Pipeline:
        """The pipeline. Raises ConfigError as `load_pipeline` does."""
        return load_pipeline(file, from_settings(dict(self.settings)), sensor=sensor)


def candidates(pipeline: Pipeline, size: tuple[int, int], pitch: float | None) -> list[Candidate]:
    """All combinations of the alternatives that a pipeline has the stages for, the most expensive first.

    Parameters
    ----------
    pipeline : as the user gave it. size : (width, height) of the picture before it shrinks, px.
    pitch : of its dots, px; None without dots.

    Raises
    ------
    ConfigError : there is nothing to choose.

    >>> import tactflow
    >>> [c.name for c in candidates(tactflow.load("markerless"), (400, 300), None)][:2]
    ['downsample 1, noise', 'downsample 1, colour']
    """
    # Only where the built-in class stands behind a stage.
    built_in = {id_ for id_, node in pipeline.nodes.items() if node.component.name == id_}
    axes = [choices for stage, choices in AXES.items() if stage in built_in]
    if not axes:
        raise ConfigError(f"{pipeline.file}: none of the stages whose alternatives tune knows is in it")
    found = []
    for names in product(*axes):
        settings: dict[str, Any] = {}
        for choices, name in zip(axes, names, strict=True):
            settings |= choices[name]
        if "flow_in_mask" not in pipeline.nodes:
            settings.pop("stages.flow_in_mask.method", None)
        shrink = settings.get(DOWNSAMPLE, 1)
        fits = min(size) / shrink >= LEAST_SIDE and (pitch is None or pitch / shrink >= LEAST_PITCH)
        if fits or shrink == 1:
            found.append(Candidate(", ".join(names), tuple(settings.items())))
    return found


def with_more_references(pipeline: Pipeline, candidate: Candidate) -> Candidate | None:
    """The candidate with more frames of the reference; None where its source has no such setting."""
    source = pipeline.source
    if source.component.name != "capture" or source.params.model_dump()["reference"] != 1:
        return None
    settings = (*candidate.settings, (f"stages.{source.id}.reference", REFERENCES))
    return Candidate(f"{candidate.name}, reference of {REFERENCES} frames", settings)
