"""Extract the part of a recording with a contact, as an array on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from tactflow.bench.lockstep import with_params
from tactflow.doctor.measures import DIM, Pair
from tactflow.doctor.observation import KEPT, Observation
from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline
from tactflow.sources import open_source
from tactflow.vision.arrays import ColorImage

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
    frames = _frames(source, MAX_READ)
    first = next(frames, None)
    changes = [] if first is None else [0.0, *(change_between(first, image) for image in frames)]
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
    path, transform = folder / "recording.npy", _geometry(pipeline)
    used = [image for index, image in enumerate(_frames(source, indices[-1] + 1)) if index in indices]
    np.save(path, used)
    pairs = [
        Pair(n, transform(used[n]), transform(used[n + 1]))
        for n in range(0, len(used) - 1, max(1, len(used) // KEPT))
    ]
    observation = Observation(source, source, False, frames=len(used), pairs=pairs)
    height, width = pairs[0].image.shape[:2]
    return Recording(source, path, len(used), (width, height), observation, [changes[i] for i in indices])


def _frames(source: str, count: int) -> Iterator[ColorImage]:
    """The first frames of a recording."""
    with closing(open_source(source)) as reader:
        if reader.live:
            raise SourceError(f"{source}: tune needs a recording; make one: tactflow record --out FILE.mcap")
        for _ in range(count):
            if (frame := reader.read()) is None:
                return
            yield frame[0].copy()


def change_between(first: ColorImage, now: ColorImage) -> float:
    """Maximum relative change of light between two pictures (H, W, 3) uint8."""
    # 96 px are enough for a contact to cover several pixels.
    size = (96, max(1, round(96 * first.shape[0] / first.shape[1])))
    before, after = (cv2.resize(i, size, interpolation=cv2.INTER_AREA).astype(float) for i in (first, now))
    ratio = np.where(before > DIM, after / np.maximum(before, DIM), 1.0)
    ratio = ratio / np.maximum(np.median(ratio, axis=(0, 1)), 0.1)
    return float(cv2.blur(np.abs(ratio - 1.0).max(axis=2), (7, 7)).max())


def _geometry(pipeline: Pipeline) -> Callable[[ColorImage], ColorImage]:
    """The geometry of the pipeline's `preprocess` without downsampling, a function on (H, W, 3) uint8."""
    if "preprocess" not in pipeline.nodes:
        return np.array
    params = pipeline.nodes["preprocess"].params
    kept = params.model_dump(exclude={"downsample"}, exclude_unset=True, by_alias=True)
    node = with_params(pipeline, "preprocess", **kept).nodes["preprocess"]
    process = node.component.cls(node.params).process
    return lambda image: np.array(process(Frame("tune", 0, 0.0, np.array(image))).image)
