"""Draw the heights of ten real objects on four Minis, next to those of the pixel network of gs_sdk.

    .venv-peers/bin/python -m lab.heights --data ../shared/data [--out docs/accuracy/heights.jpg]

Both were learned from the same presses of balls on a fifth sensor (`mini_ball_gelslam`): ours is the default
calibration, the network is that of `lab.peers.depth`, which needs PyTorch. None of the ten was seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from lab.depth import SETS, radii_of, read, scale_of
from lab.peers.common import one_thread
from lab.peers.depth import CHOICES, PixelNetwork
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Press
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Scale

Picture = NDArray[np.uint8]
OBJECTS: Mapping[str, tuple[str, str]] = {
    "ball with a thread": ("gels/franka_mini/ball_white_thread-2-0.avi", "mini"),
    "mug": ("gels/franka_mini/blue_mug-2-0.avi", "mini"),
    "tube": ("gels/franka_mini/cheese_tube-5-2.avi", "mini"),
    "pen": ("gels/franka_mini/marker_pen-2-0.avi", "mini"),
    "pliers": ("gels/franka_mini/plier-3-2.avi", "mini"),
    "USB hub": ("gels/franka_mini/usb_hub-2-0.avi", "mini"),
    "wooden mat": ("gels/franka_mini/wooden_mat-3-0.avi", "mini"),
    "edge of a box": ("gels/mini_box", "mini_plain"),
    "ball of 5 mm": ("gels/mini_ball", "mini"),
    "ball of 9.5 mm": ("mini_ball_9mm", "mini_plain"),
}
"""Name -> recording and pipeline."""
SETTLING_FRAMES = 30
"""Frames of a video in which the camera may still change its exposure."""
MAX_DEPTH_MM = 1.5
"""Depth of the brightest colour, mm."""
TILE_SIZE_PX = (240, 180)
"""Width and height of a picture, px."""


def largest(source: str, pipeline: str) -> tuple[Press, Picture, Picture]:
    """The largest contact, its picture, and the untouched gel without dots."""
    best: tuple[Press, Picture, Picture] | None = None
    untouched, settings = Path(source) / "background.png", {}
    if untouched.exists():
        settings["stages.capture.reference"] = str(untouched)
    for result in tactflow.stream(pipeline, source=source, settings=settings, images=True):
        mask, contact, image = result.contact_mask, result.contact, result.image
        settling = source.endswith(".avi") and result.seq < SETTLING_FRAMES
        if contact is None or mask is None or image is None or settling:
            continue
        radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
        if best is None or radius > best[0].radius:
            unmarked: Picture = result.get("unmarked", image)
            hidden = result.get("marker_mask", np.zeros_like(mask)) > 0
            press = Press(result.seq, unmarked.copy(), mask, hidden, contact.center, radius)
            best = press, image.copy(), result["untouched"]
    assert best is not None, f"no contact in {source}"
    return best


def network(data: Path) -> PixelNetwork:
    """Learned from the presses of the default calibration."""
    balls = SETS["gelslam"]
    session, names = read(balls, data)
    scale, radii = scale_of(balls, session), radii_of(balls, names)
    centers = fit_photometry(session, scale, radii).centers
    choice: Mapping[str, Any] = CHOICES[0]
    return PixelNetwork(session, scale, radii, centers, **choice)


def tiles(data: Path) -> Iterator[NDArray[np.uint8]]:
    """A column for each object: its picture, our heights, those of the network."""
    known, learned = Calibration.load(KINDS / "mini.yaml"), network(data)
    assert known.slopes is not None
    assert known.photometric is not None
    for name, (recording, pipeline) in OBJECTS.items():
        press, image, untouched = largest(str(data / recording), pipeline)
        height, width = press.mask.shape
        scale: Scale = known.scale_at((width, height))
        surface = Surface(known.slopes, scale, known.photometric.errors())
        ours = surface.depth(press.image, Rest(untouched), press.mask).heights
        learned.rest, learned.scale = untouched.astype(np.float32) / 255, scale
        learned.flat = learned.angles(untouched)
        theirs = learned(press)[1]
        print(f"{name:20} greatest depth, mm: {ours.max():5.2f} {theirs.max():5.2f}", flush=True)
        outline = cv2.findContours(press.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(image, outline, -1, (255, 255, 255), 1)
        column = [cv2.resize(part, TILE_SIZE_PX) for part in (image, coloured(ours), coloured(theirs))]
        for part, words in zip(column, (name, "tactflow", "pixel network"), strict=True):
            cv2.putText(part, words, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        yield np.vstack(column)


def coloured(heights: NDArray[np.floating]) -> Picture:
    """(H, W, 3) uint8, from 0 to `MAX_DEPTH_MM`."""
    grey = np.clip(255 * heights / MAX_DEPTH_MM, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), np.uint8)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description="draw the heights of ten real objects")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("docs/accuracy/heights.jpg"))
    args = parser.parse_args()
    one_thread()
    columns = list(tiles(args.data))
    half = len(columns) // 2
    picture = np.vstack([np.hstack(columns[:half]), np.hstack(columns[half:])])
    cv2.imwrite(str(args.out), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
