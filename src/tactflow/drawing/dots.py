"""A picture of the detected dots and of what else might be dots, for people."""

from __future__ import annotations

import textwrap
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.drawing.lettering import Lettering
from tactflow.drawing.results import DARK, GRAY, GREEN, MAGENTA, WHITE, YELLOW, Colour
from tactflow.vision.markers import Candidate, Detection

MIN_SIDE_PX: Final = 480
"""Smaller frames are enlarged until their shorter side is at least this long, px. Chosen by hand."""
TEXT_SIZE_PX, LINE_SPACING_PX = 15, 21
"""Size of the letters, and distance of two lines of text, px. Chosen by hand."""
LETTER_WIDTH_RATIO: Final = 0.52
"""Mean width of a letter over the letters' size: where lines are broken. Chosen by hand."""
_SUBPIXEL_BITS: Final = 4
"""Binary digits after the point in drawing coordinates, which are exact to 1/16 px."""


def draw_detection(
    image: NDArray[np.uint8],
    marks: Detection | None,
    caption: str,
    *,
    rival: Candidate | None = None,
    valid: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Draw the marks, their neighbours, what else might be marks, and a caption below the frame.

    image : (H, W, 3) or (H, W) uint8. marks : drawn as yellow circles of their radii and green links.
    caption : lines. rival : drawn as thin magenta circles. valid : (H, W) uint8, 0 where the frame is
    darkened. Returns a new picture, (h, w, 3) uint8, enlarged by a whole factor if the frame is small.

    >>> gel = np.full((240, 320, 3), 120, np.uint8)
    >>> draw_detection(gel, None, "0 marks")[0, 0].tolist()
    [120, 120, 120]
    """
    frame = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    if valid is not None:
        frame = np.where(valid[:, :, None] > 0, frame, frame // 3)
    factor = max(1, -(-MIN_SIDE_PX // min(frame.shape[:2])))
    size = (frame.shape[1] * factor, frame.shape[0] * factor)
    picture = np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC), np.uint8).copy()
    if rival is not None:
        _circles(picture, rival.centers, np.full(len(rival.centers), rival.radius), MAGENTA, factor)
    if marks is not None:
        links = list(_fixed(marks.centers, factor)[marks.edges])
        cv2.polylines(picture, links, False, GREEN, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
        sizes = np.full(len(marks.centers), marks.dot_radius) if marks.radii is None else marks.radii
        _circles(picture, marks.centers, sizes, DARK, factor, 3)
        _circles(picture, marks.centers, sizes, YELLOW, factor)
    return np.concatenate([picture, _caption(caption, picture.shape[1])])


def _fixed(points: NDArray[np.float64], factor: int) -> NDArray[np.int32]:
    """Points (N, 2) of the frame in drawing coordinates of the enlarged one."""
    return np.rint(((points + 0.5) * factor - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)


def _circles(
    picture: NDArray[np.uint8],
    centers: NDArray[np.float64],
    radii: NDArray[np.float64],
    colour: Colour,
    factor: int,
    width: int = 1,
) -> None:
    for center, radius in zip(_fixed(centers, factor).tolist(), radii.tolist(), strict=True):
        outline = round((radius * factor + 1) * 2**_SUBPIXEL_BITS)
        cv2.circle(picture, center, outline, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _caption(text: str, width: int) -> NDArray[np.uint8]:
    """(h, width, 3) uint8 with the lines of a text, broken where they are too long.

    A line that begins with the name of a colour and a colon has that colour.
    """
    columns = max(20, int((width - 16) / (TEXT_SIZE_PX * LETTER_WIDTH_RATIO)))
    colours = {"yellow": YELLOW, "green": GREEN, "magenta": MAGENTA, "dim": GRAY}
    lines = [
        (part, colours.get(line.partition(":")[0], WHITE))
        for line in text.splitlines()
        for part in textwrap.wrap(line, columns)
    ]
    strip = np.full((LINE_SPACING_PX * len(lines) + 12, width, 3), DARK, np.uint8)
    letters = Lettering()
    for number, (line, colour) in enumerate(lines):
        letters.write(strip, line, (8, LINE_SPACING_PX * (number + 1)), colour, TEXT_SIZE_PX)
    return strip
