"""What is known of recordings of real gels: outlines, circles, lines and the motion of the dots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.types import Contact

REST, TOUCHED = 0.35, 1.5
"""Below the first the gel is at rest, above the second it is touched: 95th percentile of the displacement of
the dots, px of the raw frame. From the README of the recordings of a gripper's grasps."""

_LOCAL = 41
"""Side of the square whose mean takes the light out before dots are followed, px; chosen by hand."""


@dataclass(frozen=True, slots=True)
class Label:
    """What a look at one frame says about the contact, in pixels of the frame after `downsample`.

    outlines : polygons (N, 2) that cover it. center : (x, y) of a ball, or None. angle : of an edge, degrees
    counter-clockwise in (-90, 90], or None.
    """

    outlines: tuple[NDArray[np.float64], ...]
    center: tuple[float, float] | None = None
    angle: float | None = None

    def mask(self, shape: tuple[int, int]) -> NDArray[np.uint8]:
        """(H, W): 255 inside the outlines."""
        return filled(self.outlines, shape)

    def overlap(self, contact: Contact | None, shape: tuple[int, int]) -> float:
        """Intersection over union of the contact's hull with the outlines, in [0, 1]."""
        if contact is None:
            return 0.0
        return metrics.mask_iou(self.mask(shape), filled([contact.hull], shape))


def filled(polygons: Sequence[NDArray[Any]], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W) uint8: 255 inside any of the polygons (N, 2), px."""
    mask = np.zeros(shape, np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [np.rint(polygon).astype(np.int32)], (255,))
    return mask


def outlines_by_eye(gels: Path) -> dict[str, dict[int, tuple[int, NDArray[np.float64]]]]:
    """Recording -> frame -> (downsample, polygon (N, 2)): those of the data and those drawn for this bench.

    gels : folder of the recordings. Outlines drawn by eye are good to 0.05 to 0.1 of overlap.
    """
    own = files("tactflow.bench") / "gel_outlines.json"
    drawn = json.loads(own.read_text(encoding="utf-8"))
    theirs = gels / "polygons.json"
    if theirs.exists():
        drawn += json.loads(theirs.read_text(encoding="utf-8"))
    found: dict[str, dict[int, tuple[int, NDArray[np.float64]]]] = {}
    for one in drawn:
        polygon = np.asarray(one["polygon"], dtype=np.float64)
        found.setdefault(one["rec"], {})[int(one["frame"])] = (int(one["downsample"]), polygon)
    return found


def labels_of(
    source: Path,
    gels: Path,
    downsample: int,
    drawn: Mapping[str, Mapping[int, tuple[int, NDArray[np.float64]]]],
) -> dict[int, Label]:
    """Frame -> label of one recording.

    source : a folder of pictures with or without a `labels.json`, or a video. gels : folder of all of them.
    downsample : of the frames that are judged. drawn : from `outlines_by_eye`.
    """
    path = source / "labels.json"
    if path.exists():
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {int(frame): _label(entry) for frame, entry in stored.items()}
    name = str(source.relative_to(gels).with_suffix("")).removesuffix("/video")
    return {
        frame: Label((polygon * (of / downsample),)) for frame, (of, polygon) in drawn.get(name, {}).items()
    }


def _label(entry: Mapping[str, Any]) -> Label:
    """One entry of a `labels.json`: the circle of a ball, or the two flanks and the line of an edge."""
    if "radius" in entry:
        x, y = entry["center"]
        turn = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        circle = np.stack([x + entry["radius"] * np.cos(turn), y + entry["radius"] * np.sin(turn)], axis=1)
        return Label((circle,), (float(x), float(y)))
    # Their angle is that of image coordinates, y down.
    flanks = (np.asarray(entry["rect1"], np.float64), np.asarray(entry["rect2"], np.float64))
    return Label(flanks, angle=-float(entry["line_angle"]))


@dataclass(slots=True)
class DotMotion:
    """Tells rest from touch by following the dots through the raw frames, apart from what is measured.

    With Lucas-Kanade (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2001) on grey
    levels divided by those around, so that a change of exposure is no motion.

    reference : frame that shows the gel at rest.
    """

    reference: int
    _images: list[NDArray[np.uint8]] = field(default_factory=list[NDArray[np.uint8]])
    _dots: NDArray[np.float32] | None = None

    def add(self, image: NDArray[np.uint8]) -> None:
        """Take the next frame, (H, W, 3) uint8 BGR."""
        if len(self._images) == self.reference:
            self._dots = detect_markers(image).centers.astype(np.float32).reshape(-1, 1, 2)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        around = np.maximum(cv2.blur(grey, (_LOCAL, _LOCAL)), 4.0)
        self._images.append(np.clip(128.0 * grey / around, 0, 255).astype(np.uint8))

    def touched(self) -> NDArray[np.int8]:
        """(frames,): 1 touched, 0 at rest, -1 neither."""
        known = np.full(len(self._images), -1, np.int8)
        if self._dots is None:
            return known
        start = self._images[self.reference]
        for index, image in enumerate(self._images):
            now, found, _ = cv2.calcOpticalFlowPyrLK(
                start,
                image,
                self._dots,
                None,
                winSize=(15, 15),
                maxLevel=3,  # type: ignore[call-overload]
            )
            moved = np.hypot(*(now - self._dots)[found[:, 0] == 1, 0].T)
            if len(moved):
                far = float(np.percentile(moved, 95))
                known[index] = 0 if far < REST else 1 if far > TOUCHED else -1
        return known
