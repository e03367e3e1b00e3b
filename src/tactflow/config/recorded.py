"""The calibration of a run: the one that the pipeline names, or that its recording was made with."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from tactflow.calibration import KINDS
from tactflow.engine.conformance import accepts
from tactflow.engine.errors import SourceError
from tactflow.engine.graph import Pipeline
from tactflow.engine.plan import make_plan

if TYPE_CHECKING:
    from tactflow.calibration.file import Calibration


def with_recorded_calibration(pipeline: Pipeline) -> Pipeline:
    """The pipeline with the calibration that its recording was made with.

    A calibration that the pipeline names itself, or null, is kept; the default of a kind of sensor is
    replaced.
    """
    source = getattr(pipeline.source.params, "source", None)
    name = source.partition("?")[0] if isinstance(source, str) else ""
    chosen = pipeline.calibration is not None and pipeline.calibration.parent != KINDS
    if chosen or pipeline.settings.get("calibration", "") is None or not name.endswith(".mcap"):
        return pipeline
    from tactflow.recording import missing_packages
    from tactflow.sources.paths import find_path

    if missing_packages() is not None:
        return pipeline
    from tactflow.recording.calibration import stored_text
    from tactflow.recording.records import NotARecordingError

    # The source reports what is wrong with the recording itself.
    with suppress(SourceError, OSError, ValueError, NotARecordingError):
        path = find_path(name, pipeline.directory)
        stored_text(path)
        return replace(pipeline, calibration=path)
    return pipeline


def read_calibration(pipeline: Pipeline) -> Calibration | None:
    """The calibration, read once for all stages; None if the pipeline names none, or no stage uses it.

    Raises ConfigError if it cannot be read.
    """
    if pipeline.calibration is None:
        return None
    pruned = {node.id for node in make_plan(pipeline).pruned}
    users = [node for node in pipeline.nodes.values() if accepts(node.component.make, "calibration")]
    if all(node.id in pruned for node in users):
        return None
    from tactflow.calibration.file import Calibration

    return Calibration.load(pipeline.calibration)
