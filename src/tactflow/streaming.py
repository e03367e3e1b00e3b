"""Results in the process that computes them: `for result in tactflow.stream("pipeline.yaml"): ...`."""

from __future__ import annotations

import threading
from collections.abc import Generator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.api import Settings, load, make_runner
from tactflow.engine.conformance import own_sink
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.control import Control
from tactflow.engine.frame import Tick
from tactflow.engine.graph import Pipeline
from tactflow.engine.link import Link
from tactflow.engine.run import Runner
from tactflow.ports import ContactMask, Image
from tactflow.vision.types import Contact, Depth, Flow, Force, Markers, Scale, Slip

_SINK = "tactflow.stream"
"""Id of the sink that hands results over; no id of a file has a point in it."""


@dataclass(frozen=True, slots=True)
class Result:
    """What was found in one frame; pixels are those of the processed frame.

    seq : index of the frame at the source, from 0; a dropped frame leaves a gap.
    t : capture time, s: from the start of a recording, or Unix time of a live source.
    contact, flow, markers : None where there is none, or no stage of the pipeline makes it.
    contact_mask : (H, W) uint8, 255 in contact; None without a contact.
    skipped : port -> why it was not computed in this frame: `unchanged` repeats the last value.
    scale, depth, force : millimetres per pixel, how far the gel is pushed in, and by which force; None
        without a calibration that knows it.
    slip : whether the contact slips; None unless a stage `slip` stands in the pipeline.
    image : (H, W, 3) uint8 BGR, the processed frame. frame : the raw one. Both None unless asked for, because
        a list of results would hold them all in memory.

    Arrays are read-only, as the run may use them again; copy one to draw on it.

    >>> result = next(stream(source="sim:press", max_frames=1))
    >>> result.seq, result.contact, len(result.markers.position)
    (0, None, 80)
    """

    sensor: str
    seq: int
    t: float
    contact: Contact | None
    flow: Flow | None
    markers: Markers | None
    contact_mask: NDArray[np.uint8] | None
    skipped: Mapping[str, str]
    scale: Scale | None = None
    depth: Depth | None = None
    force: Force | None = None
    slip: Slip | None = None
    image: NDArray[np.uint8] | None = None
    frame: NDArray[np.uint8] | None = None

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Every separate contact, that with the most pixels first; empty without one."""
        if self.contact is None:
            return ()
        return self.contact.separate or (self.contact,)


def stream(
    pipeline: str | Path | Pipeline | None = None,
    *,
    source: str | None = None,
    settings: Settings | None = None,
    sensor: str | None = None,
    realtime: bool = False,
    max_frames: int | None = None,
    images: bool = False,
    sinks: bool = False,
) -> Generator[Result, None, None]:
    """Run a pipeline and iterate over its results.

    The run goes on in the background while the loop works on a result. A recording waits for the loop, so
    nothing is lost; of a live source the loop always gets the newest result. Leaving the loop ends the run.

    Parameters
    ----------
    pipeline, source, settings, sensor, realtime : as for `tactflow.load`, or a loaded pipeline.
    max_frames : stop after so many frames.
    images : give `image` and `frame` with each result.
    sinks : let the pipeline's own sinks work too: files, ZeroMQ, the live page.

    Raises
    ------
    ConfigError : at once, if the pipeline file is wrong.
    TactflowError : from the loop, if a stage or the source failed.

    Examples
    --------
    >>> import tactflow
    >>> areas = [r.contact.area for r in tactflow.stream(source="sim:press", max_frames=50) if r.contact]
    >>> len(areas) > 10
    True
    """
    if not isinstance(pipeline, Pipeline):
        pipeline = load(pipeline, source=source, settings=settings, sensor=sensor, realtime=realtime)
    link: Link[Result] = Link(_SINK, 1, "block")
    runner = make_runner(_with_hand(pipeline, link, images=images, sinks=sinks), max_frames=max_frames)
    return _results(runner, link)


def _results(runner: Runner, link: Link[Result]) -> Generator[Result, None, None]:
    failures: list[BaseException] = []

    def work() -> None:
        try:
            failure = runner.run().failure
            failures.extend([failure] if failure is not None else [])
        except BaseException as error:
            failures.append(error)
        finally:
            link.close()

    thread = threading.Thread(target=work, name="tactflow-stream", daemon=True)
    thread.start()
    try:
        while (result := link.get()) is not None:
            yield result
    finally:
        runner.stop()
        link.abort()
        thread.join()
    if failures:
        raise failures[0]


class _Inputs(NamedTuple):
    image: Image | None
    contact: Contact | None
    flow: Flow | None
    markers: Markers | None
    contact_mask: ContactMask | None
    scale: Scale | None
    depth: Depth | None
    force: Force | None
    slip: Slip | None


class _Hand(Sink):
    """Hands results over to the loop."""

    threaded = True
    when_live = "latest"
    link: Link[Result]
    images: bool

    def __init__(self, params: StageParams, control: Control) -> None:
        super().__init__(params)
        self._control = control

    def open(self) -> None:
        """Of a live source only the newest result waits for the loop."""
        if self._control.source is not None and self._control.source.live:
            self.link.when_full = "latest"

    def write(self, tick: Tick, inputs: _Inputs) -> None:
        frame = tick.frame
        self.link.put(
            Result(
                sensor=frame.sensor,
                seq=frame.seq,
                t=frame.t,
                contact=_locked(inputs.contact),
                flow=inputs.flow,
                markers=_locked(inputs.markers),
                contact_mask=_locked(inputs.contact_mask),
                skipped=dict(tick.skipped),
                scale=inputs.scale,
                depth=_locked(inputs.depth),
                force=inputs.force,
                slip=inputs.slip,
                image=_locked(inputs.image) if self.images else None,
                frame=frame.image if self.images else None,
            )
        )


def _locked(value: Any) -> Any:
    """The same with arrays that cannot be written to: an array, or a dataclass of arrays and numbers."""
    if isinstance(value, np.ndarray):
        view = value.view()
        view.flags.writeable = False
        return view
    if value is None:
        return None
    parts = {field.name: getattr(value, field.name) for field in fields(value)}
    arrays = {name: _locked(part) for name, part in parts.items() if isinstance(part, np.ndarray)}
    if isinstance(value, Contact):
        arrays["separate"] = tuple(map(_locked, value.separate))
    return replace(value, **arrays)


def _with_hand(pipeline: Pipeline, link: Link[Result], *, images: bool, sinks: bool) -> Pipeline:
    """The pipeline with a sink for the loop, and with or without its own."""
    kept = {id_: node for id_, node in pipeline.nodes.items() if sinks or node.component.kind != "sink"}
    kept[_SINK] = own_sink(pipeline, _Hand, _SINK, "tactflow.stream", link=link, images=images)
    return replace(pipeline, nodes=kept)
