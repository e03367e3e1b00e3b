"""Parts of a long recording: where it is cut, and how a pipeline runs over one of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from tactflow.batch.recordings import Recording
from tactflow.batch.task import Part
from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline
from tactflow.message.result import Result
from tactflow.sources import open_source

OVERLAP = 30
"""Frames before a part that stages see, so that they have forgotten that they began there; see batch.md."""


def cut(recording: Recording, pipeline: Pipeline, seconds: float) -> list[Part]:
    """The parts of a recording; none if it is no longer than one, or does not tell its length.

    pipeline : whose source may name the rate. seconds : length of a part; the last one may be shorter.

    >>> import tactflow
    >>> recording = Recording("sim:press?frames=200", "press")
    >>> [(part.begin, part.first, part.end) for part in cut(recording, tactflow.load("default"), 1.5)]
    [(0, 0, 90), (60, 90, 180), (150, 180, None)]
    """
    try:
        reader = open_source(recording.source, fps=getattr(pipeline.source.params, "fps", None))
    except SourceError:
        # The worker says why, as for one that is not cut.
        return []
    fps, total = reader.fps, reader.total
    reader.close()
    if not fps or not total:
        return []
    length = max(1, round(seconds * fps))
    firsts = range(0, total, length)
    if len(firsts) < 2:
        return []
    ends = [*firsts[1:], None]
    return [
        Part(number, max(0, first - OVERLAP), first, end)
        for number, (first, end) in enumerate(zip(firsts, ends, strict=True))
    ]


def of_part(pipeline: Pipeline, part: Part) -> Pipeline:
    """The pipeline over a part of its recording: references and frames before it are seen, not told of."""
    nodes = dict(pipeline.nodes)
    for node in pipeline.nodes.values():
        if node.component.kind == "source":
            cls: type = _source_of(node.component.cls, part)
        elif node.component.kind == "sink":
            cls = _sink_of(node.component.cls, part)
        else:
            continue
        nodes[node.id] = replace(node, component=replace(node.component, cls=cls))
    return replace(pipeline, nodes=nodes)


def _source_of(cls: type, part: Part) -> type:
    """A source that leaves out what no stage needs for this part; it reads all that is before it."""

    class OfPart(cls):  # type: ignore[misc]
        def frames(self) -> Iterator[Frame]:
            for frame in super().frames():
                if part.end is not None and frame.seq >= part.end:
                    return
                if frame.reference or frame.seq >= part.begin:
                    yield frame

    return OfPart


def _sink_of(cls: type, part: Part) -> type:
    """A sink that takes the frames of this part."""

    class OfPart(cls):  # type: ignore[misc]
        def write(self, result: Result) -> None:
            if part.holds(result.seq):
                super().write(result)

    return OfPart
