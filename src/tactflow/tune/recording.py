"""Extract the part of a recording with a contact, as an array on disk."""

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

MAX_READ: Final = 1800
"""Maximum number of frames searched for a contact: 30 s at 60 frames/s."""
MAX_USED: Final = 160
"""Maximum number of frames extracted: 230 MB at 800 x 600 in a temporary file."""
MIN_FRAMES: Final = 20
"""Minimum length of a recording, frames. Chosen by hand."""
HEAD: Final = 8
"""First frames, always extracted because references are taken from them."""
CHANGE: Final = 0.04
"""Threshold for a contact: maximum relative change of light in the small picture. Chosen by hand, 1.6 times
the repeatability of the gel that `difference` assumes."""


@dataclass
class Recording:
    """The extracted part of a recording.

    source : as given by the user. path : `.npy` file of the frames. frames : number of frames. size : (width,
    height), px, before downsampling. observation : some of the frames, for the doctor's measures. changes :
    maximum relative change of light of each frame from the first.
    """

    source: str
    path: Path
    frames: int
    size: tuple[int, int]
    observation: Observation
    changes: list[float]


def take(source: str, pipeline: Pipeline, folder: Path) -> Recording:
    """Extract the first frames and those around the strongest contact.

    source : as for `open_source`; not live. pipeline : its geometry, except for `downsample`, is applied to
    the observation. folder : where to write the frames.

    Raises
    ------
    SourceError
        The source cannot be read, is live or too short, or shows no contact.
    """
    changes = _changes(source)
    if len(changes) < MIN_FRAMES:
        raise SourceError(
            f"{source}: {len(changes)} frames are too few to tune on; required {MIN_FRAMES} or more"
        )
    touched = int(np.argmax(changes))
    if changes[touched] < CHANGE:
        raise SourceError(
            f"{source}: no contact in the first {len(changes)} frames (the light changes by at most "
            f"{100 * changes[touched]:.1f} %); record some presses, with the gel untouched at first"
        )
    start = max(HEAD, min(touched - MAX_USED // 2, len(changes) - MAX_USED + HEAD))
    indices = [*range(HEAD), *range(start, min(len(changes), start + MAX_USED - HEAD))]
    frames = _copy(source, indices, folder / "recording.npy")
    transform = _geometry(pipeline)
    pairs = [
        Pair(n, transform(frames[n]), transform(frames[n + 1]))
        for n in range(0, len(frames) - 1, max(1, len(frames) // KEPT))
    ]
    observation = Observation(source, source, False, frames=len(frames), pairs=pairs)
    height, width = pairs[0].image.shape[:2]
    used = [changes[index] for index in indices]
    return Recording(source, folder / "recording.npy", len(frames), (width, height), observation, used)


def _changes(source: str) -> list[float]:
    """Maximum relative change of light of each frame from the first."""
    reader = open_source(source)
    try:
        if reader.live:
            raise SourceError(f"{source}: tune needs a recording; make one: tactflow record --out FILE.mcap")
        first: NDArray[np.float32] | None = None
        changes: list[float] = []
        while len(changes) < MAX_READ and (frame := reader.read()) is not None:
            small = _small(frame[0])
            first = small if first is None else first
            changes.append(_change(first, small))
        return changes
    finally:
        reader.close()


def change_between(first: Image, now: Image) -> float:
    """Maximum relative change of light between two pictures (H, W, 3) uint8."""
    return _change(_small(first), _small(now))


def _small(image: Image) -> NDArray[np.float32]:
    # 96 px are enough for a contact to cover several pixels.
    size = (96, max(1, round(96 * image.shape[0] / image.shape[1])))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _change(first: NDArray[np.float32], now: NDArray[np.float32]) -> float:
    ratio = np.where(first > DIM, now / np.maximum(first, DIM), 1.0)
    ratio = ratio / np.maximum(np.median(ratio, axis=(0, 1)), 0.1)
    smooth = cv2.blur(np.abs(ratio - 1.0).max(axis=2).astype(np.float32), (7, 7))
    return float(smooth.max())


def _copy(source: str, indices: list[int], path: Path) -> NDArray[np.uint8]:
    """Write the frames (N, H, W, 3) with these indices to a file."""
    reader = open_source(source)
    frames: NDArray[np.uint8] | None = None
    positions = {index: position for position, index in enumerate(indices)}
    try:
        for index in range(indices[-1] + 1):
            frame = reader.read()
            if frame is None:
                raise SourceError(f"{source}: ended earlier when read a second time")
            if frames is None:
                shape = (len(indices), *frame[0].shape)
                frames = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
            if index in positions:
                frames[positions[index]] = frame[0]
    finally:
        reader.close()
    assert frames is not None
    return frames


def _geometry(pipeline: Pipeline) -> Callable[[Image], Image]:
    """The geometry of the pipeline's `preprocess` without downsampling, a function on (H, W, 3) uint8."""
    node = pipeline.nodes.get("preprocess")
    if node is None:
        return np.array
    params = {**node.params.model_dump(exclude_unset=True, by_alias=True), "downsample": 1}
    try:
        stage = node.component.cls(node.component.params.model_validate(params))
    except ValueError as error:
        raise ConfigError(f"stages.preprocess: {error}") from None

    def transform(image: Image) -> Image:
        return np.array(stage.process(Frame("tune", 0, 0.0, np.array(image))).image)

    return transform
