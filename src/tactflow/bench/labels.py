"""What is known of recordings of real gels: outlines, circles, lines, rest and touch."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.label_file import load_labels
from tactflow.bench.quantities import Tally
from tactflow.vision.types import Contact

OUTLINES: Final = Path(__file__).with_name("outlines.json")
"""Outlines that were drawn for the package, see `label_file`, and frames at rest."""

FOLDER: Final = "gels"
"""Where the recordings of gels are, in the folder of recordings."""

Polygons = Mapping[str, Mapping[int, tuple[NDArray[np.float64], ...]]]
"""Recording -> frame -> polygons (N, 2), px of the raw frame."""


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

    gels : folder of the recordings. Outlines that one person drew twice overlap by 0.88 (median of 40).
    """
    outlines: dict[str, dict[int, tuple[NDArray[np.float64], ...]]] = {}
    for label in load_labels(OUTLINES):
        name = _name(Path(label.recording))
        if label.round == 1 and label.outlines and name.startswith(f"{FOLDER}/"):
            polygons = tuple(np.asarray(outline) for outline in label.outlines)
            outlines.setdefault(name.removeprefix(f"{FOLDER}/"), {})[int(label.frame)] = polygons
    theirs = gels / "polygons.json"
    for entry in json.loads(theirs.read_text(encoding="utf-8")) if theirs.exists() else ():
        polygon = np.asarray(entry["polygon"], np.float64) * int(entry["downsample"])
        outlines.setdefault(entry["rec"], {})[int(entry["frame"])] = (polygon,)
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
    outlines = drawn.get(_name(source.relative_to(gels)), {})
    return {
        frame: Label(tuple(polygon / downsample for polygon in polygons))
        for frame, polygons in outlines.items()
    }


def touch_of(source: Path, gels: Path) -> NDArray[np.int8] | None:
    """(N,) for the frames of a recording: 1 touched, 0 at rest, -1 neither; None where nobody knows.

    From the displacement of its dots against a frame at rest, followed by Lucas and Kanade's method in
    grey levels without the light: 95th percentile up to 0.35 px at rest, from 1.5 px on touched.
    """
    runs = json.loads((files("tactflow.bench") / "gel_touch.json").read_text()).get(
        _name(source.relative_to(gels))
    )
    return None if runs is None else np.repeat(*np.transpose(runs)).astype(np.int8)


def _name(recording: Path) -> str:
    return str(recording.with_suffix("")).removesuffix("/video")


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
