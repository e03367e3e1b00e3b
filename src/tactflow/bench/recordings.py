"""Presses of a ball on a real sensor, with hand-labelled centres (`wedge_ball`)."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.labels import FOLDER
from tactflow.bench.lockstep import TimedResult, with_params
from tactflow.bench.pipelines import Bench, Judge
from tactflow.bench.quantities import Tally
from tactflow.bench.results import RECORDING
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.sources.files import load_image

_MARKER_STAGES = frozenset({"tracker", "flow_in_mask", "visualize"})
"""Ids of the stages that need markers."""


def measure_presses(bench: Bench, pipelines: Mapping[str, Pipeline], folder: Path) -> None:
    """Compare the centres of a ball's presses with labels.

    pipelines : their preprocessing is replaced by the Wedge's rectification. folder : with `labels.csv` and
        the pictures that it names, and `reference.jpg`.

    Raises
    ------
    SourceError : a picture cannot be read.
    """
    wedge = load_pipeline(find_pipeline("wedge")).nodes["preprocess"]
    rectify = wedge.params.model_dump(exclude_unset=True, by_alias=True)
    ready = {name: with_params(pipeline, "preprocess", **rectify) for name, pipeline in pipelines.items()}
    with (folder / "labels.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    labels = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    names = ["reference.jpg", *(row["file"] for row in rows)]
    path = bench.scratch / "recording.npy"
    np.save(path, np.stack([load_image(str(folder / name)) for name in names]))
    bench.measure(ready, f"{RECORDING}wedge_ball", [(path, partial(PressJudge, labels))])


def check(data: Path) -> None:
    """Find out before a long run that there is nothing to measure.

    Raises
    ------
    ConfigError
        If the folder holds none of the known recordings.
    """
    known = ("wedge_ball", FOLDER)
    if not any((data / name).is_dir() for name in known):
        raise ConfigError(f"--data {data}: required a folder with one of {', '.join(known)} in it")


def without_markers(pipeline: Pipeline) -> Pipeline:
    """The same pipeline without the stages that need markers to be there."""
    nodes = {name: node for name, node in pipeline.nodes.items() if name not in _MARKER_STAGES}
    return replace(pipeline, nodes=nodes)


class PressJudge(Judge):
    """Compares centres with labels, (N, 2) px of the frames from 1 on."""

    def __init__(self, labels: NDArray[np.float64], tally: Tally) -> None:
        super().__init__(tally)
        self._labels = labels

    def add(self, result: TimedResult) -> str:
        """Compare the centre in one frame."""
        if result.seq > 0:
            self.tally.percent(found_percent=result.contact is not None)
            if result.contact is not None:
                offset = np.subtract(result.contact.center, self._labels[result.seq - 1])
                self.tally.add(label_center_p50=offset, label_center_p95=offset)
        return "contact"
