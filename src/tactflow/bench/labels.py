"""What is known of recordings of real gels: outlines, circles, lines, the number and the motion of dots."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.quantities import Tally
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.types import Contact

REST, TOUCHED = 0.35, 1.5
"""Below the first the gel is at rest, above the second it is touched: 95th percentile of the displacement of
the dots, px of the raw frame. From the README of the recordings of a gripper's grasps."""

_LOCAL = 41
"""Side of the square whose mean takes the light out before dots are followed, px. Chosen by hand."""

PROMPT = 4
"""Frames within which a first contact has to be seen. Chosen by hand: 0.16 s at 25 frames a second."""
EARLY = 25
"""Frames within which a first contact is an early one: 1 s at 25 frames a second."""

Polygons = Mapping[str, Mapping[int, tuple[int, NDArray[np.float64]]]]
"""Recording -> frame -> (downsample, polygon (N, 2) px of the frame after it)."""


@dataclass(frozen=True, slots=True)
class Label:
    """What a person sees of the contact in one frame, in pixels of the frame after `downsample`.

    outlines : polygons (N, 2) that cover it. center : (x, y) of a ball, or None. angle : of an edge, degrees
    counter-clockwise in (-90, 90], or None.
    """

    outlines: tuple[NDArray[np.float64], ...]
    center: tuple[float, float] | None = None
    angle: float | None = None

    def mask(self, shape: tuple[int, int]) -> NDArray[np.uint8]:
        """(H, W): 255 inside the outlines."""
        return metrics.filled_polygons(self.outlines, shape)

    def compare(self, tally: Tally, contact: Contact | None, shape: tuple[int, int]) -> float:
        """Add the errors of a contact; returns the overlap of its hull, 0 where none was found.

        shape : (H, W) of the frame.
        """
        overlap = 0.0
        if contact is not None:
            overlap = metrics.mask_iou(self.mask(shape), metrics.filled_polygons([contact.hull], shape))
            if self.center is not None:
                tally.add(label_distance_p50=metrics.distance(contact.center, self.center))
            if contact.angle is not None and self.angle is not None:
                error = metrics.angle_error(contact.angle, self.angle)
                tally.add(line_angle_p50=error, line_angle_max=error)
        tally.add(outline_iou_p50=overlap, outline_iou_min=overlap)
        return overlap


def outlines_by_eye(gels: Path) -> Polygons:
    """The outlines that came with the recordings, and those drawn for this bench.

    gels : folder of the recordings. Two people's outlines overlap by 0.9 to 0.95.
    """
    own = files("tactflow.bench") / "gel_outlines.json"
    drawn = json.loads(own.read_text(encoding="utf-8"))
    theirs = gels / "polygons.json"
    if theirs.exists():
        drawn += json.loads(theirs.read_text(encoding="utf-8"))
    outlines: dict[str, dict[int, tuple[int, NDArray[np.float64]]]] = {}
    for entry in drawn:
        polygon = np.asarray(entry["polygon"], dtype=np.float64)
        outlines.setdefault(entry["rec"], {})[int(entry["frame"])] = (int(entry["downsample"]), polygon)
    return outlines


def labels_of(source: Path, gels: Path, downsample: int, drawn: Polygons) -> dict[int, Label]:
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


def compare_decisions(tally: Tally, touched: NDArray[np.int8], found: NDArray[np.bool_]) -> None:
    """Compare the decisions on a recording with what is known.

    touched : (N,): 1 touched, 0 at rest, -1 unknown. found : (N,), whether a contact was found.
    """
    tally.percent(false_contacts=found[touched == 0], missed_contacts=~found[touched == 1])


def compare_first_contact(tally: Tally, touched: NDArray[np.int8], found: NDArray[np.bool_]) -> None:
    """Judge whether the first contact of a recording was seen in time, if it is early; as above."""
    resting = np.flatnonzero(touched == 0)
    begun = np.flatnonzero(touched[resting[0] :] == 1) + resting[0] if len(resting) else resting
    if len(begun) and begun[0] <= EARLY:
        tally.percent(early_found=found[begun[0] : begun[0] + PROMPT].any())


class DotMotion:
    """Tells rest from touch by following the dots through the raw frames, independently of the pipeline.

    With Lucas-Kanade (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2001) on grey
    levels divided by those around, so that a change of exposure is no motion.

    reference : number of a frame that shows the gel at rest.
    """

    def __init__(self, reference: int) -> None:
        self._reference = reference
        self._images: list[NDArray[np.uint8]] = []
        self._dots = np.zeros((0, 1, 2), np.float32)

    def add(self, image: NDArray[np.uint8]) -> None:
        """Take the next frame, (H, W, 3) uint8 BGR."""
        if len(self._images) == self._reference:
            self._dots = detect_markers(image).centers.astype(np.float32).reshape(-1, 1, 2)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        around = np.maximum(cv2.blur(grey, (_LOCAL, _LOCAL)), 4.0)
        self._images.append(np.clip(128.0 * grey / around, 0, 255).astype(np.uint8))

    def touched(self) -> NDArray[np.int8]:
        """(N,): 1 touched, 0 at rest, -1 neither."""
        touched = np.full(len(self._images), -1, np.int8)
        for index, image in enumerate(self._images if len(self._dots) else []):
            start, options = self._images[self._reference], {"winSize": (15, 15), "maxLevel": 3}
            now, found, _ = cv2.calcOpticalFlowPyrLK(start, image, self._dots, None, **options)  # type: ignore[call-overload]
            moved = metrics.distance(now, self._dots)[found[:, 0] == 1]
            if len(moved):
                far = float(np.percentile(moved, 95))
                touched[index] = 0 if far < REST else 1 if far > TOUCHED else -1
        return touched
