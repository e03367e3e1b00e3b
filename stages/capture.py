"""Stage `capture`: frames from a simulated sensor, a recording, a camera or a stream."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from tactflow.engine.contract import Source, StageParams
from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.sources import KINDS, CameraRequest, FrameReader, StampedReader, Watch, Watched, open_source
from tactflow.sources.files import ImageFiles, load_image
from tactflow.sources.first import FirstFrames
from tactflow.sources.pace import paced
from tactflow.sources.watch import Arrival

logger = logging.getLogger("tactflow")


class Capture(Source):
    """Reads frames and says which of them show the untouched gel.

    Recordings are handed over as fast as they are taken, or, with `realtime`, at their own pace and then
    like a live camera. Their first frames are examined ahead: if one of them is a better reference than the
    very first, it comes before all others, with number -1. Those of a live source are left out until it is
    steady. A recording of tactflow's own brings its references, seq and epochs.
    """

    class Params(StageParams):
        """What to capture, and which frames are the reference."""

        source: str = Field("sim:press", description=KINDS)
        realtime: bool = Field(
            False, description="play a recording at its own pace, with a live camera's drop policy"
        )
        reference: int | str = Field(
            1,
            description="which frames show the untouched gel: the first N in steady light, N >= 1 (more "
            "average out noise), or an image file that is shown to the stages before the first frame",
        )
        settle: float = Field(
            3.0,
            ge=0,
            le=60,
            description="the reference is taken once exposure and white balance of the camera are steady, "
            "after so many seconds at most; 0: at once",
        )
        skip: int = Field(0, ge=0, description="frames thrown away at the start")
        width: int | None = Field(None, ge=1, description="ask the camera for this width, px")
        height: int | None = Field(None, ge=1, description="ask the camera for this height, px")
        fps: float | None = Field(
            None,
            gt=0,
            le=10_000,
            description="ask the camera for this rate; for images and arrays, their rate (30 if not given); "
            "frames per second",
        )
        format: str | None = Field(
            None,
            pattern=r"^[ -~]{4}$",
            description="ask the camera for this pixel format, four characters: MJPG, YUYV, ...",
        )

        reconnect: bool = Field(
            True,
            description="open a camera or stream anew when it is gone, frozen or black; if false, a camera "
            "that stops is an error and a stream that ends is the end",
        )
        on_reconnect: Literal["keep", "retake"] = Field(
            "keep",
            description="after a reconnection, keep the reference, or retake it: the first frames then must "
            "show the untouched gel",
        )
        no_frame_timeout: float | None = Field(
            30.0,
            ge=0,
            description="a camera or stream without a good frame for so long ends the run with an error, s; "
            "0 waits for ever",
        )
        frozen_after: float | None = Field(
            3.0,
            gt=0,
            description="pictures of a camera or stream that are the same bit for bit for so long are a "
            "fault, s; null never",
        )
        black_after: float | None = Field(
            1.0,
            gt=0,
            description="black pictures of a camera or stream for so long are a fault, s; null never",
        )

        @field_validator("source", mode="before")
        @classmethod
        def _index_is_text(cls, value: object) -> object:
            return str(value) if isinstance(value, int) and not isinstance(value, bool) else value

        @field_validator("reference", mode="before")
        @classmethod
        def _at_least_one_frame(cls, value: object) -> object:
            if isinstance(value, bool) or not isinstance(value, int | str) or value == "":
                raise ValueError(f"required a number of frames or an image file, got {value!r}")
            if isinstance(value, int) and value < 1:
                raise ValueError(f"required at least 1 frame, got {value}")
            return value

    def __init__(
        self,
        params: Params,
        sensor: str = "main",
        directory: Path | None = None,
        opener: Callable[..., FrameReader] = open_source,
    ) -> None:
        """Prepare; nothing is opened yet.

        Parameters
        ----------
        sensor : name given to every frame.
        directory : where relative paths are looked for if they are not in the current directory.
        opener : opens the source; called like `open_source`.
        """
        super().__init__(params)
        self.live = params.realtime
        self.description = params.source
        self._sensor = sensor
        self._directory = directory
        self._opener = opener
        self._source: FrameReader | None = None
        self._reference_image: NDArray[np.uint8] | None = None
        self._count = params.reference if isinstance(params.reference, int) else 1
        self._references_left = 0
        self._epoch = 0
        self._examined = 0
        """Frames of a live source that were examined for the reference and left out."""
        self._stop = threading.Event()
        self._retake = threading.Event()

    def open(self) -> None:
        """Open the source; afterwards `live`, `total` and `description` are known.

        Raises SourceError if the source or the reference image cannot be opened.
        """
        p = self.params
        request = CameraRequest(p.width, p.height, p.fps, p.format)
        if isinstance(p.reference, str):
            try:
                self._reference_image = load_image(p.reference, self._directory)
            except SourceError as error:
                raise SourceError(f"reference: {error}") from error
        watch = Watch(p.reconnect, p.no_frame_timeout, p.frozen_after, p.black_after)
        self._source = self._opener(
            p.source, directory=self._directory, fps=p.fps, camera=request, watch=watch
        )
        self.live = self._source.live or p.realtime
        self.total = None if self._source.total is None else max(self._source.total - p.skip, 0)
        self.description = self._source.description

    def close(self) -> None:
        """Give the source back."""
        self._stop.set()
        if self._source is not None:
            self._source.close()

    def stop(self) -> None:
        """End `frames()` soon; wakes it if it waits for the next frame."""
        self._stop.set()
        if isinstance(self._source, Watched):
            self._source.stop()

    @property
    def state(self) -> str:
        """How the source is: `running`, `waiting since ...` or `reconnecting since ...`."""
        return self._source.state if isinstance(self._source, Watched) else "running"

    @property
    def missed(self) -> int:
        """Frames of a live source that a newer one overtook, or that were only examined: gaps in `seq`."""
        return self._source.missed + self._examined if isinstance(self._source, Watched) else 0

    @property
    def live_threads(self) -> Sequence[int]:
        """Native ids of threads of its own that frames arrive in."""
        reader = self._source.reader.native_id if isinstance(self._source, Watched) else None
        return [] if reader is None else [reader]

    def retake(self) -> None:
        """Make the next frames the new reference, in a new epoch: as many as at the start."""
        self._retake.set()

    def frames(self) -> Iterator[Frame]:
        """Every frame of the source, in order, until its end or `stop()`.

        Raises SourceError if a frame cannot be read, or the reference image is not as large as the frames.
        """
        if self._source is None:
            raise SourceError(f"{self.description}: is not open")
        if isinstance(self._source, StampedReader):
            return self._replay(self._source)
        if isinstance(self._source, Watched):
            return self._watch(self._source)
        return self._play(self._source)

    def _play(self, source: FrameReader) -> Iterator[Frame]:
        """Frames of a recording, after those that show the untouched gel if these are not the first ones."""
        p = self.params
        for _ in range(p.skip):
            if self._stop.is_set() or source.read() is None:
                return
        shown_before, self._references_left = self._choose(source)
        realtime = p.realtime and not source.live
        for seq, (image, t) in enumerate(paced(source.read, p.source, realtime, self._stop), p.skip):
            for picture in shown_before:
                yield self._shown_before(picture, image, t)
            shown_before = []
            yield self._frame(image, t, seq)

    def _choose(self, source: FrameReader) -> tuple[list[NDArray[np.uint8]], int]:
        """Pictures to show before the first frame, and how many of the first frames are references."""
        if self._reference_image is not None:
            return [self._reference_image], 0
        first = self._first_frames()
        if first is None or source.live:
            return [], self._count
        pictures: list[NDArray[np.uint8]] = []
        while not self._stop.is_set() and (item := source.peek()) is not None:
            pictures.append(item[0])
            if first.look(*item):
                break
        chosen = first.references() if pictures else []
        if isinstance(source, ImageFiles) and first.separate and chosen[0] == 0:
            logger.info(
                "%s: separate pictures; %s, the first by name, is taken for the untouched gel. "
                "If another one shows that, name it: stages.capture.reference",
                self.params.source,
                source.first,
            )
        if chosen == list(range(len(chosen))):
            return [], len(chosen)
        return [pictures[index] for index in chosen], 0

    def _replay(self, source: StampedReader) -> Iterator[Frame]:
        """Frames as they were captured the first time; references that are retaken now come on top."""
        p = self.params
        for image, t, stamp in paced(source.read_stamped, p.source, p.realtime, self._stop):
            again = self._is_reference(retake=stamp.seq >= 0)
            reference, epoch = stamp.reference or again, stamp.epoch + self._epoch
            captured = time.perf_counter()
            yield Frame(self._sensor, stamp.seq, t, _read_only(image), captured, reference, epoch)

    def _watch(self, source: Watched) -> Iterator[Frame]:
        """Frames of a source that numbers them where they arrive, and that may go and come back."""
        p, image = self.params, self._reference_image
        self._references_left = self._count if image is None else 0
        first = self._first_frames() if image is None else None
        held: list[Arrival] = []
        connection, begins = 0, p.skip
        while not self._stop.is_set() and (arrival := source.read_arrival()) is not None:
            if arrival.connection != connection:
                connection, begins = arrival.connection, arrival.seq + p.skip
                if p.on_reconnect == "retake":
                    self._retake.set()
                    first, held = self._first_frames(), []
            if arrival.seq < begins:
                continue
            if image is not None:
                yield self._shown_before(image, arrival.image, arrival.t)
                image = None
            held.append(arrival)
            if first is not None:
                if not first.look(arrival.image, arrival.t):
                    continue
                chosen = first.references()
                self._examined += len(held) - len(chosen)
                held = [held[index] for index in chosen]
                # Whatever was requested before, these are the references.
                self._is_reference()
                self._references_left = len(chosen)
                first = None
            for arrived in held:
                yield self._frame(arrived.image, arrived.t, arrived.seq, arrived.captured)
            held = []

    def _first_frames(self) -> FirstFrames | None:
        """What examines the first frames; None if they are handed out at once."""
        p = self.params
        return FirstFrames(p.source, p.settle, self._count) if p.settle > 0 else None

    def _is_reference(self, *, retake: bool = True) -> bool:
        """Whether the next frame is a reference. retake : whether a new epoch may begin with it."""
        if retake and self._retake.is_set():
            self._retake.clear()
            self._epoch += 1
            self._references_left = self._count
        reference = self._references_left > 0
        self._references_left -= reference
        return reference

    def _frame(self, image: NDArray[np.uint8], t: float, seq: int, captured: float | None = None) -> Frame:
        reference = self._is_reference()
        captured = time.perf_counter() if captured is None else captured
        return Frame(self._sensor, seq, t, _read_only(image), captured, reference, self._epoch)

    def _shown_before(self, image: NDArray[np.uint8], first: NDArray[np.uint8], t: float) -> Frame:
        """A reference that comes before the first frame, which was taken at t."""
        if image.shape != first.shape:
            raise SourceError(
                f"stages.capture.reference is an image of {image.shape[1]} x {image.shape[0]} pixels, the "
                f"frames of {self.params.source} have {first.shape[1]} x {first.shape[0]}; they must be "
                "equally large"
            )
        return Frame(self._sensor, -1, t, _read_only(image), time.perf_counter(), reference=True)


def _read_only(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = image.view()
    image.setflags(write=False)
    return image
