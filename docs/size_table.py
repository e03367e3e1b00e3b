"""How small a picture may be: the table of accuracy.md on small pictures.

    python docs/size_table.py

prints the table; simulated contacts, their outlines against the truth. Takes a minute.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.sim import open_scene
from tactflow.vision.geometry import Preprocessor

SCENES = ("press", "finger", "cable")
DOTS = ("14x10", "18x14", "26x20")
DOWNSAMPLE = (2, 4)
FRAMES = 60
PRESSED = range(16, 44, 4)
"""Frames of the scenes in which all contacts are at least half as deep as they get."""


def overlaps(scene: str, downsample: int) -> Iterator[float]:
    """Of the pressed frames: the overlap of the hull with the true one, 0 for a contact that is missed."""
    simulated = open_scene(scene)
    mapping = Preprocessor(simulated.size, rotate=0, downsample=downsample).mapping
    settings = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": downsample, "skipping": False}
    for result in tactflow.stream("default", source=f"sim:{scene}", settings=settings):
        if result.seq in PRESSED:
            truth = simulated.truth(result.seq, mapping)
            found = np.zeros_like(truth.contact_mask) if result.contact is None else None
            if found is None:
                assert result.contact is not None
                found = _filled(np.asarray(result.contact.hull), truth.contact_mask.shape)
            true = _filled(truth.hull, truth.contact_mask.shape)
            yield float((found & true).sum() / (found | true).sum())


def _filled(hull: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), (1.0,))
    return mask > 0


def main() -> None:
    """Print the table."""
    print("| picture, px | dots | " + " | ".join(f"`{scene}`" for scene in SCENES) + " |")
    print("| --- | --- |" + " --- |" * len(SCENES))
    for downsample in DOWNSAMPLE:
        for dots in DOTS:
            cells = []
            for scene in SCENES:
                found = list(overlaps(f"{scene}?frames={FRAMES}&markers={dots}", downsample))
                cells.append(f"{statistics.median(found):.2f}, {min(found):.2f}")
            size = f"{800 // downsample} x {600 // downsample}"
            print(f"| {size} | {dots.replace('x', ' x ')} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
