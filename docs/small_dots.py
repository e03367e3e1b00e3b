"""The table of dots.md on small dots: how many are found in pictures that are shrunk until they are small.

    python docs/small_dots.py [FOLDER]

FOLDER holds the recordings `gels`; without it, `../shared/data` beside the repository. What is found in the
picture of the untouched gel as it is counts as true. Takes half a minute.
"""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.gels import FOLDER, GELS, Gel
from tactflow.sources import open_source
from tactflow.vision.geometry.valid_area import valid_area
from tactflow.vision.markers import family
from tactflow.vision.markers.detection import NoMarkersError, detect_markers

PITCHES = (8.0, 5.0, 4.0, 3.5, 3.0)
"""Distances of neighbouring dots in the shrunk pictures, px."""
LEAST_SIDE = 24
"""Smaller pictures are left out, px."""
TRANSPARENT = "fingervision"
"""A gel that shows what is behind it, so that what is found there is not all dots."""
NEVER = 2.0
"""A likeness that no dot has."""
NEAR = 0.35
"""Distance, pitches, up to which a dot is found."""


def found(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 2) centres of the dots, px."""
    try:
        return detect_markers(image, valid=valid_area(image)).centers
    except NoMarkersError:
        return np.zeros((0, 2))


def counted(image: NDArray[np.uint8]) -> dict[float, NDArray[np.int64]]:
    """Pitch -> sensors (one), dots; found and false, without likeness and with it."""
    whole = detect_markers(image, valid=valid_area(image))
    counts = {}
    for pitch in PITCHES:
        factor = pitch / whole.pitch
        width, height = int(image.shape[1] * factor), int(image.shape[0] * factor)
        if factor >= 1 or min(width, height) < LEAST_SIDE:
            continue
        shrunk = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        scale = np.array([width / image.shape[1], height / image.shape[0]])
        truth = (whole.centers + 0.5) * scale - 0.5
        row = [1, len(truth)]
        for least in (NEVER, family.ALIKE):
            with patch.object(family, "ALIKE", least):
                centers = found(shrunk)
            # The answer to the last picture is remembered.
            found(image)
            near = np.hypot(*(centers[:, None] - truth).transpose(2, 0, 1)) < NEAR * pitch
            row += [np.count_nonzero(near.any(axis=0)), len(centers) - np.count_nonzero(near.any(axis=1))]
        counts[pitch] = np.array(row)
    return counts


def first_picture(gel: Gel, gels: Path) -> NDArray[np.uint8]:
    """Of its first recording, when the camera of the gripper has set its exposure."""
    with closing(open_source(str(gel.sources(gels)[0]))) as reader:
        *_, last = (reader.read() for _ in range((gel.moves or 0) + 1))
    if last is None:
        raise SystemExit(f"{gel.folder}: too short")
    return last[0]


def main() -> None:
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "shared" / "data"
    print("| distance of neighbours, px | sensors | dots | found, false without likeness | found, false |")
    print("| --- | --- | --- | --- | --- |")
    for chosen in (True, False):
        total: dict[float, NDArray[np.int64]] = {}
        for gel in GELS:
            if gel.chosen == chosen and gel.dots != 0 and gel.folder != TRANSPARENT:
                for pitch, row in counted(first_picture(gel, data / FOLDER)).items():
                    total[pitch] = total.get(pitch, 0) + row
        for pitch, (sensors, dots, *shares) in sorted(total.items(), reverse=True):
            told = [f"{count / dots:.1%}" for count in shares]
            kind = "chosen on" if chosen else "test"
            pairs = [", ".join(told[:2]), ", ".join(told[2:])]
            print(f"| {pitch:g} | {sensors}, {kind} | {dots} | {pairs[0]} | {pairs[1]} |")


if __name__ == "__main__":
    main()
