"""What `tactflow tune` tries: the alternatives it declares, and the pipelines that they make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import from_settings
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

Settings = Mapping[str, Any]

LEAST_SIDE: Final = 90
"""Shorter side of a processed picture, px, at least. Chosen by hand: contacts of a tenth of it have 60 px."""
LEAST_PITCH: Final = 6.0
"""Pitch of the dots, processed px, at least. Chosen by hand: the narrowest that was found on a real gel has 7
(sts_torque160)."""

DOWNSAMPLE: Final = "stages.preprocess.downsample"
"""The setting by which both sides of the picture shrink."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One thing that can be chosen.

    stage : id of the stage that has to be there. choices : name -> settings; the first is that of the
    shipped pipelines.
    """

    stage: str
    choices: Mapping[str, Settings]


AXES: Final = (
    Axis("preprocess", {f"downsample {k}": {DOWNSAMPLE: k} for k in (1, 2, 4)}),
    Axis("difference", {m: {"stages.difference.method": m} for m in ("noise", "colour")}),
    Axis("fusion", {"fusion": {}, "no fusion": {"stages.fusion": None}}),
    Axis("field", {"field": {}, "mean": {"stages.field": None, "stages.flow_in_mask.method": "mean"}}),
)
"""Alternatives that are tried in all combinations. Other methods of `inpaint` are none: telea and ns take 300
times as long as `normalized` and are no more exact (docs/accuracy.md), and without it the contact's centre is
off by three to eight times as much (`press`)."""

REFERENCES: Final = 8
"""Frames of the reference that are tried on what was chosen. Chosen by hand: less noise than of one frame, in
the dots' displacements by a third, and nobody waits for them."""


@dataclass(frozen=True)
class Candidate:
    """One pipeline to try: a name, and what it sets in the file that the user gave."""

    name: str
    settings: tuple[tuple[str, Any], ...] = ()

    def load(self, file: Path, sensor: str | None = None) -> Pipeline:
        """The pipeline. Raises ConfigError as `load_pipeline` does."""
        return load_pipeline(file, from_settings(dict(self.settings)), sensor=sensor)

    def changed(self, name: str, settings: Settings) -> Candidate:
        """The same with more settings."""
        return Candidate(f"{self.name}, {name}", (*self.settings, *settings.items()))


def candidates(pipeline: Pipeline, size: tuple[int, int], pitch: float | None) -> list[Candidate]:
    """All combinations of the alternatives that a pipeline has the stages for, the most expensive first.

    Parameters
    ----------
    pipeline : as the user gave it. size : (width, height) of the picture before it shrinks, px.
    pitch : of its dots, px; None without dots.

    Examples
    --------
    >>> import tactflow
    >>> [c.name for c in candidates(tactflow.load("markerless"), (400, 300), None)][:2]
    ['downsample 1, noise', 'downsample 1, colour']
    """
    axes = [axis for axis in AXES if axis.stage in pipeline.nodes and not _foreign(pipeline, axis.stage)]
    if not axes:
        raise ConfigError(f"{pipeline.file}: none of the stages whose alternatives tune knows is in it")
    made = []
    for names in product(*(axis.choices for axis in axes)):
        settings: dict[str, Any] = {}
        for axis, name in zip(axes, names, strict=True):
            settings.update(axis.choices[name])
        if "flow_in_mask" not in pipeline.nodes:
            settings.pop("stages.flow_in_mask.method", None)
        if _sensible(settings.get(DOWNSAMPLE, 1), size, pitch):
            made.append(Candidate(", ".join(names), tuple(settings.items())))
    return made


def _foreign(pipeline: Pipeline, stage: str) -> bool:
    """Whether another class than the built-in one stands behind a stage."""
    return pipeline.nodes[stage].component.name != stage


def _sensible(downsample: int, size: tuple[int, int], pitch: float | None) -> bool:
    fits = pitch is None or pitch / downsample >= LEAST_PITCH
    return downsample == 1 or (fits and min(size) / downsample >= LEAST_SIDE)


def with_more_references(pipeline: Pipeline, chosen: Candidate) -> Candidate | None:
    """The chosen one with more frames of the reference; None where its source has no such setting."""
    source = pipeline.source
    if source.component.name != "capture" or source.params.model_dump()["reference"] != 1:
        return None
    settings = {f"stages.{source.id}.reference": REFERENCES}
    return chosen.changed(f"reference of {REFERENCES} frames", settings)
