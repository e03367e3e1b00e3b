"""Extract the part of a recording with a contact, as an array on disk."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline
from tactflow.sources import Arrival, open_source
from tactflow.tools.doctor.measures import MIN_LIT_GREY, Pair
from tactflow.tools.doctor.observation import Observation, watch
from tactflow.vision.arrays import ColorImage

MAX_READ_FRAMES: Final = 1800
"""Maximum number of frames searched for a contact: 30 s at 60 frames/s."""
MAX_KEPT_FRAMES: Final = 160
"""Maximum number of frames that are kept around the strongest press."""
MIN_FRAMES: Final = 20
"""Minimum length of a recording, frames. Chosen by hand."""
FIRST_FRAME_COUNT: Final = 48
"""Number of first frames that are kept: a second or two."""
MAX_KEPT_BYTES: Final = 256_000_000
"""Bytes of the frames that are kept around the strongest press, at most `MAX_KEPT_FRAMES` of them."""
CONTACT_CHANGE: Final = 0.04
"""Threshold for a contact: maximum relative change of light in the small picture. Chosen by hand, 1.6 times
the repeatability of the gel that `difference` assumes."""


class Kept:
    """The first frames of a sensor, and those around the strongest press.

    They are consecutive, because pipelines also judge by what changes from frame to frame: of every eighth
    pair of frames with presses, `markerless` finds a contact in a tenth.
    """

    def __init__(self) -> None:
        self._first: list[ColorImage] = []
        self._window: deque[tuple[float, ColorImage]] = deque()

    def __len__(self) -> int:
        return len(self._first) + len(self._window)

    @property
    def frames(self) -> list[ColorImage]:
        """(H, W, 3) uint8 each, in order."""
        return [*self._first, *(image for _, image in self._window)]

    def add(self, image: ColorImage, *, at_rest: bool = False) -> None:
        """Keep a frame, or let it go. at_rest : only as one of the first."""
        if len(self._first) < FIRST_FRAME_COUNT:
            self._first.append(image.copy())
            return
        if at_rest:
            return
        room = int(np.clip(MAX_KEPT_BYTES // image.nbytes, FIRST_FRAME_COUNT, MAX_KEPT_FRAMES))
        changes = [change for change, _ in self._window]
        change = change_between(self._first[0], image)
        if len(changes) == room:
            # Once the strongest press has reached the middle, it stays there.
            if change <= max(changes) and int(np.argmax(changes)) <= room // 2:
                return
            self._window.popleft()
        self._window.append((change, image.copy()))


@dataclass
class Recording:
    """The extracted part of a recording.

    Attributes
    ----------
    source : as given by the user.
    path : `.npy` file of the frames.
    frames : number of frames.
    size : (width, height), px, before downsampling.
    observation : some of the frames, for the doctor's measures.
    """

    source: str
    path: Path
    frames: int
    size: tuple[int, int]
    observation: Observation


def take(source: str, pipeline: Pipeline, folder: Path) -> Recording:
    """Extract the first frames and those around the strongest contact.

    source : as for `open_source`; not live. pipeline : its geometry, except for `downsample`, is applied to
    the observation. folder : where to write the frames.

    Raises
    ------
    SourceError
        The source cannot be read, is live or too short, or shows no contact.
    """
    kept, observation = Kept(), Observation(source, source, live=False)

    def keep(arrival: Arrival) -> bool:
        kept.add(arrival.image)
        return observation.frames < MAX_READ_FRAMES

    with closing(open_source(source)) as reader:
        if reader.live:
            raise SourceError(f"{source}: tune needs a recording; make one: tactflow record --out FILE.mcap")
        watch(reader, math.inf, observation, keep)
    if observation.stopped:
        raise SourceError(observation.stopped)
    if observation.frames < MIN_FRAMES:
        raise SourceError(
            f"{source}: {observation.frames} frames are too few to tune on; required {MIN_FRAMES} or more"
        )
    frames = kept.frames
    change = max(change_between(frames[0], image) for image in frames)
    if change < CONTACT_CHANGE:
        raise SourceError(
            f"{source}: no contact in the first {observation.frames} frames (the light changes by at most "
            f"{100 * change:.1f} %); record some presses, with the gel untouched at first"
        )
    path, transform = folder / "recording.npy", _geometry(pipeline)
    np.save(path, frames)
    observation.pairs[:] = [
        Pair(number, transform(image), None if after is None else transform(after))
        for number, image, after in observation.pairs
    ]
    height, width = observation.pairs[0].image.shape[:2]
    return Recording(source, path, len(frames), (width, height), observation)


def change_between(first: ColorImage, now: ColorImage) -> float:
    """Maximum relative change of light between two pictures (H, W, 3) uint8."""
    # 96 px are enough for a contact to cover several pixels.
    size = (96, max(1, round(96 * first.shape[0] / first.shape[1])))
    before, after = (cv2.resize(i, size, interpolation=cv2.INTER_AREA).astype(float) for i in (first, now))
    ratio = np.where(before > MIN_LIT_GREY, after / np.maximum(before, MIN_LIT_GREY), 1.0)
    ratio = ratio / np.maximum(np.median(ratio, axis=(0, 1)), 0.1)
    return float(cv2.blur(np.abs(ratio - 1.0).max(axis=2), (7, 7)).max())


def _geometry(pipeline: Pipeline) -> Callable[[ColorImage], ColorImage]:
    """The geometry of the pipeline's `preprocess` without downsampling, a function on (H, W, 3) uint8."""
    if "preprocess" not in pipeline.nodes:
        return np.array
    node = pipeline.nodes["preprocess"]
    process = node.component.cls(node.params.changed(downsample=1)).process
    return lambda image: np.array(process(Frame("tune", 0, 0.0, np.array(image))).image)
