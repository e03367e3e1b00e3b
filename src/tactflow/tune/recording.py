"""The recording that is tuned for: the part of it with a contact, as an array on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.doctor.measures import DIM, Pair
from tactflow.doctor.observation import KEPT, Observation
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline
from tactflow.sources import open_source

Image = NDArray[np.uint8]

MOST_READ: Final = 1800
"""Frames of a recording that are looked at, at most: 30 s at 60 a second."""
MOST_USED: Final = 160
"""Frames that pipelines run on, at most: 230 MB at 800 x 600 in a temporary file."""
LEAST: Final = 20
"""Frames without which nothing is measured. Chosen by hand."""
HEAD: Final = 8
"""First frames that are always used: references are taken from them."""
CHANGE: Final = 0.04
"""Relative change of the light somewhere in the small picture from which on there is a contact. By hand: 1.6
times what `difference` takes for the gel's own (repeatability)."""


@dataclass
class Recording:
    """Part of a recording.

    source : how it was named. path : its frames, a `.npy` file. frames : how many. size : (width, height),
    px, before the pipeline shrinks them. seen : some of these frames, for the doctor's measures. changes :
    how far the light of each frame is from the first, relative.
    """

    source: str
    path: Path
    frames: int
    size: tuple[int, int]
    seen: Observation
    changes: list[float]


def take(source: str, pipeline: Pipeline, folder: Path) -> Recording:
    """Copy the part of a recording that is used.

    source : as `open_source` takes it; not live. pipeline : its geometry is applied to what is looked at, but
    for `downsample`. folder : where the frames go.

    Raises
    ------
    SourceError
        If it cannot be read, is live, too short, or shows no contact.
    """
    changes = _changes(source)
    if len(changes) < LEAST:
        raise SourceError(f"{source}: {len(changes)} frames are too few to tune on; required {LEAST} or more")
    touched = int(np.argmax(changes))
    if changes[touched] < CHANGE:
        raise SourceError(
            f"{source}: nothing touches the gel in its {len(changes)} first frames (the light changes by "
            f"{100 * changes[touched]:.1f} % at most); record some presses, with the gel untouched at first"
        )
    start = max(HEAD, min(touched - MOST_USED // 2, len(changes) - MOST_USED + HEAD))
    wanted = [*range(HEAD), *range(start, min(len(changes), start + MOST_USED - HEAD))]
    frames = _copy(source, wanted, folder / "recording.npy")
    straight = _geometry(pipeline)
    pairs = [
        Pair(n, straight(frames[n]), straight(frames[n + 1]))
        for n in range(0, len(frames) - 1, max(1, len(frames) // KEPT))
    ]
    seen = Observation(source, source, False, frames=len(frames), pairs=pairs)
    height, width = pairs[0].image.shape[:2]
    used = [changes[index] for index in wanted]
    return Recording(source, folder / "recording.npy", len(frames), (width, height), seen, used)


def _changes(source: str) -> list[float]:
    """How far each frame is from the first, relative, where it is farthest."""
    reader = open_source(source)
    try:
        if reader.live:
            raise SourceError(f"{source}: tune needs a recording; make one: tactflow record --out FILE.mcap")
        first: NDArray[np.float32] | None = None
        found: list[float] = []
        while len(found) < MOST_READ and (frame := reader.read()) is not None:
            small = _small(frame[0])
            first = small if first is None else first
            found.append(_change(first, small))
        return found
    finally:
        reader.close()


def change_between(first: Image, now: Image) -> float:
    """How far the light of two pictures (H, W, 3) uint8 is apart, relative, where it is farthest."""
    return _change(_small(first), _small(now))


def _small(image: Image) -> NDArray[np.float32]:
    # A contact fills several pixels of a picture that is 96 px wide.
    size = (96, max(1, round(96 * image.shape[0] / image.shape[1])))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _change(first: NDArray[np.float32], now: NDArray[np.float32]) -> float:
    ratio = np.where(first > DIM, now / np.maximum(first, DIM), 1.0)
    ratio = ratio / np.maximum(np.median(ratio, axis=(0, 1)), 0.1)
    smooth = cv2.blur(np.abs(ratio - 1.0).max(axis=2).astype(np.float32), (7, 7))
    return float(smooth.max())


def _copy(source: str, wanted: list[int], path: Path) -> NDArray[np.uint8]:
    """The wanted frames of a source, (N, H, W, 3), in a file."""
    reader = open_source(source)
    frames: NDArray[np.uint8] | None = None
    places = {index: place for place, index in enumerate(wanted)}
    try:
        for index in range(wanted[-1] + 1):
            frame = reader.read()
            if frame is None:
                raise SourceError(f"{source}: ended sooner when it was read again")
            if frames is None:
                shape = (len(wanted), *frame[0].shape)
                frames = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
            if index in places:
                frames[places[index]] = frame[0]
    finally:
        reader.close()
    assert frames is not None
    return frames


def _geometry(pipeline: Pipeline) -> Callable[[Image], Image]:
    """What the pipeline's `preprocess` does to a picture, (H, W, 3) uint8, without shrinking it."""
    node = pipeline.nodes.get("preprocess")
    if node is None:
        return np.array
    params = {**node.params.model_dump(exclude_unset=True, by_alias=True), "downsample": 1}
    try:
        stage = node.component.cls(node.component.params.model_validate(params))
    except ValueError as error:
        raise ConfigError(f"stages.preprocess: {error}") from None

    def straight(image: Image) -> Image:
        return np.array(stage.process(Frame("tune", 0, 0.0, np.array(image))).image)

    return straight
