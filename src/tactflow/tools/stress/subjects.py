"""What is stressed: the pipelines, and every stage that the registry knows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.config.models import RESERVED
from tactflow.config.registry import catalogue
from tactflow.config.replacements import methods_of, replacements
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Component, Pipeline
from tactflow.message.result import Result
from tactflow.tools.bench.lockstep import with_params
from tactflow.tools.bench.results import CLASSIC

Image = NDArray[np.uint8]

UNCHANGED_PICTURES: Mapping[str, Any] = {
    "rotate": 0,
    "downsample": 1,
    "crop": None,
    "homography": None,
    "undistort": None,
}
"""Parameters of a preprocess stage that leave the picture as it is: frames are given as processed ones."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A pipeline.

    Attributes
    ----------
    name : in reports.
    file : of the pipeline.
    dots : whether it tracks dots.
    settings : values of the file that are replaced, as for `tactflow.load`.
    tell : called with the name whenever the pipeline is loaded for a run.
    """

    name: str
    file: Path
    dots: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    tell: Callable[[str], None] = field(default=lambda _: None, compare=False)

    @property
    def reference(self) -> bool:
        """Whether it is the classic script or has a swapped stage: measured, but without promises."""
        return self.name == CLASSIC or bool(self.settings)

    def stages(self) -> set[str]:
        """Names of its stages, as in `use:`."""
        nodes = tactflow.load(self.file, settings=self.settings).nodes.values()
        return {node.component.name for node in nodes}

    def load(self, frames: Any, **settings: Any) -> Pipeline:
        """The pipeline on frames in memory, taken as they are.

        settings : keys of the file, `a__b` for a.b.
        """
        self.tell(self.name)
        values = dict(self.settings) | {key.replace("__", "."): value for key, value in settings.items()}
        pipeline = tactflow.load(self.file, source=frames, settings=values)
        for id_, node in pipeline.nodes.items():
            known = {key: value for key, value in UNCHANGED_PICTURES.items() if hasattr(node.params, key)}
            if len(known) > 1:
                pipeline = with_params(pipeline, id_, node.params.changed(**known))
        return pipeline

    def run(self, frames: Any, **settings: Any) -> list[Result]:
        """Results of all frames, with every array that a stage has computed. TactflowError if it fails."""
        return results(self.load(frames, **settings))


def subjects(files: Mapping[str, Path], tell: Callable[[str], None] = lambda _: None) -> list[Subject]:
    """The pipelines of these files. files : name -> file. tell : as for `Subject`."""
    return [Subject(name, file, _tracks(file), tell=tell) for name, file in files.items()]


def _tracks(file: Path) -> bool:
    nodes = tactflow.load(file).nodes.values()
    return any(port.name == "markers" for node in nodes for port in node.component.ports.outputs)


def results(pipeline: Pipeline, *, sinks: bool = False) -> list[Result]:
    """Results of all frames of a loaded pipeline."""
    return list(tactflow.stream(pipeline, images=True, sinks=sinks))


def in_segments(pipeline: Pipeline) -> Pipeline:
    """The same graph with every stage in a segment, and so a thread, of its own."""
    nodes = {
        id_: node if node.component.kind == "sink" else replace(node, segment=f"of-{id_}")
        for id_, node in pipeline.nodes.items()
    }
    return replace(pipeline, nodes=nodes)


def stage_components() -> tuple[list[Component], dict[str, str]]:
    """Every stage of the registry that works with default parameters; name -> why another does not."""
    usable, unusable = [], {}
    for component in catalogue(("stages",))[0]:
        if component.kind != "stage":
            # A source has no inputs.
            continue
        try:
            tactflow.stage(component.name).close()
        except TactflowError as error:
            unusable[component.name] = str(error).splitlines()[0]
        else:
            usable.append(component)
    return usable, unusable


def swapped(subject: Subject) -> list[Subject]:
    """The pipeline with every other registered stage, or method of a stage, in the place of its own."""
    pipeline = tactflow.load(subject.file)
    files: Mapping[str, Any] = pipeline.settings["stages"]
    found = []
    for id_, node in pipeline.nodes.items():
        if node.component.kind != "stage":
            continue
        own = files[id_] or {}
        kept = {key: value for key, value in own.items() if key in RESERVED and key != "use"}
        for other in replacements(node.component):
            change = {f"stages.{id_}": {**kept, "use": other.name}}
            found.append(replace(subject, name=f"{id_}: {other.name}", settings=change))
        for method in methods_of(node.component):
            if method != getattr(node.params, "method", None):
                only = {f"stages.{id_}.method": method}
                found.append(replace(subject, name=f"{id_}: {method}", settings=only))
    return found
