"""Stage `capture`: frames of a simulated sensor, a recording, a camera or a stream."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from tactflow.engine.contract import Source, StageParams
from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame, read_only
from tactflow.sources import KINDS, Arrival, CameraRequest, FrameReader, Watch, open_source
from tactflow.sources.base import log
from tactflow.sources.files import ImageFiles, load_image
from tactflow.sources.pace import paced
from tactflow.sources.references import References


class Capture(Source):
    """Reads frames and marks those that show the untouched gel.

    A recording is read as fast as it is processed, or, with `realtime`, at its own pace and like a live
    camera. Its first frames are examined ahead: a better reference than the first frame is delivered before
    all others, with number -1. Frames of a live source are omitted until it is steady. A recording of
    tactflow has its own references, seq and epochs.

    >>> capture = Capture(Capture.Params(source="sim:press?frames=3"))
    >>> capture.open()
    >>> [frame.reference for frame in capture.frames()]
    [True, False, False]
    """

    class Params(StageParams):
        """Source, reference, and handling of faults."""

        source: str = Field("sim:press", description=KINDS)
        realtime: bool = Field(
            False, description="play a recording at its own pace, with a live camera's drop policy"
        )
        reference: Annotated[int, Field(ge=1, strict=True)] | Annotated[str, Field(min_length=1)] = Field(
            1,
            description="frames that show the untouched gel: the first N in steady light, N >= 1 (more "
            "reduce noise), or an image file, which the stages get before the first frame",
        )
        settle: float = Field(
            3.0,
            ge=0,
            le=60,
            description="longest wait for steady exposure and white balance before the reference, s; 0: none",
        )
        skip: int = Field(0, ge=0, description="frames discarded at the start")
        width: int | None = Field(None, ge=1, description="width requested from the camera, px")
        height: int | None = Field(None, ge=1, description="height requested from the camera, px")
        fps: float | None = Field(
            None,
            gt=0,
            le=10_000,
            description="rate requested from the camera, or of images and arrays (30 by default), frames/s",
        )
        format: str | None = Field(
            None,
            pattern=r"^[ -~]{4}$",
            description="pixel format requested from the camera, four characters: MJPG, YUYV, ...",
        )
        reconnect: bool = Field(
            True,
            description="reopen a camera or stream that is gone, frozen or black; if false, the end of a "
            "stream ends the run, and a camera that stops is an error",
        )
        no_frame_timeout: float | None = Field(
            30.0,
            ge=0,
            description="time without a good frame of a camera or stream after which the run ends with an "
            "error, s; 0: never",
        )
        frozen_after: float | None = Field(
            3.0,
            gt=0,
            description="bit-identical pictures of a camera or stream for this time are a fault, s; null: "
            "never",
        )
        black_after: float | None = Field(
            1.0,
            gt=0,
            description="black pictures of a camera or stream for this time are a fault, s; null: never",
        )

        skip_damaged: bool = Field(
            True,
            description="repeat the results of the frame before for pictures that show no gel or were "
            "damaged on their way from the camera; if false, they are processed like all others",
        )

        @field_validator("source", mode="before")
        @classmethod
        def _index_is_text(cls, value: object) -> object:
            return str(value) if isinstance(value, int) and not isinstance(value, bool) else value

    def __init__(
        self,
        params: Params,
        sensor: str = "main",
        directory: Path | None = None,
        opener: Callable[..., FrameReader] = open_source,
    ) -> None:
        """Prepare; nothing is opened yet.

        sensor : name in every frame. directory : for relative paths, after the current directory. opener :
        opens the source; called like `open_source`.
        """
        super().__init__(params)
        self.live = params.realtime
        self.description = params.source
        self._sensor = sensor
        self._directory = directory
        self._opener = opener
        self._source: FrameReader | None = None
        self._reference_image: NDArray[np.uint8] | None = None
        self._stop = threading.Event()
        self._references = References(
            params.source,
            params.reference if isinstance(params.reference, int) else 1,
            params.settle,
            skip_damaged=params.skip_damaged,
        )

    def open(self) -> None:
        """Open the source; afterwards `live`, `total` and `description` are known.

        Raises SourceError if the source or the reference image cannot be opened.
        """
        p = self.params
        if isinstance(p.reference, str):
            try:
                self._reference_image = load_image(p.reference, self._directory)
            except SourceError as error:
                raise SourceError(f"reference: {error}") from error
        request = CameraRequest(p.width, p.height, p.fps, p.format)
        watch = Watch(p.reconnect, p.no_frame_timeout, p.frozen_after, p.black_after)
        self._source = source = self._opener(
            p.source, directory=self._directory, fps=p.fps, camera=request, watch=watch
        )
        self.live = source.live or p.realtime
        self.pictures = isinstance(source, ImageFiles)
        self.total = None if source.total is None else max(source.total - p.skip, 0)
        self.description = source.description

    def close(self) -> None:
        """Close the source."""
        self._stop.set()
        if self._source is not None:
            self._source.close()

    def stop(self) -> None:
        """End `frames()` soon, even while it waits for the next frame."""
        self._stop.set()
        if self._source is not None:
            self._source.stop()

    def retake(self) -> None:
        """Make the next frames the new reference, in a new epoch: as many as at the start."""
        self._references.retake()

    @property
    def state(self) -> str:
        """State of the source: `running`, `waiting since ...` or `reconnecting since ...`."""
        return "running" if self._source is None else self._source.state

    @property
    def missed(self) -> int:
        """Frames of a live source that a newer one replaced, or that were only examined: gaps in `seq`."""
        return 0 if self._source is None else self._source.missed + self._references.left_out

    def frames(self) -> Iterator[Frame]:
        """All frames of the source in order, until its end or `stop()`.

        Raises SourceError if a frame cannot be read, or the reference image has another size.
        """
        p, source = self.params, self._source
        if source is None:
            raise SourceError(f"{self.description}: is not open")
        arrivals: Iterator[Arrival]
        if source.stamped:
            arrivals = map(self._references.marked, iter(source.read_arrival, None))
        else:
            arrivals = self._references.arranged(self._unskipped(source), source, self._reference_image)
        for arrival in paced(arrivals, p.source, p.realtime and not source.live, self._stop):
            image = read_only(arrival.image)
            captured = arrival.captured or time.perf_counter()
            reference, epoch, damaged = arrival.reference, arrival.epoch, arrival.damaged
            yield Frame(self._sensor, arrival.seq, arrival.t, image, captured, reference, epoch, damaged)
        if not source.live and (count := self._references.repeated) > 1:
            log.warning("%s: all %d pictures are the same: a camera that stood still?", p.source, count)

    def _unskipped(self, source: FrameReader) -> Iterator[Arrival]:
        """The frames without the first ones of the source."""
        while not self._stop.is_set() and (arrival := source.read_arrival()) is not None:
            if arrival.seq >= self.params.skip:
                yield arrival
