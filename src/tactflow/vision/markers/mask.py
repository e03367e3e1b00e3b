"""Where markers cover the gel: spots that differ from their surroundings on all sides."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel, prefetch
from tactflow.vision.geometry.downsample import halve_block
from tactflow.vision.markers.detection import Detection, NoMarkersError, detect_markers

Bytes = NDArray[np.uint8]
Polarity = Literal["dark", "bright"]

CIRCLE_POINTS: Final = 12
"""Points on the circle around a spot that it is compared with; `contrast_with_circle` spells them out.
Chosen by hand."""

SHARPEST_CIRCLE: Final = 4.0
"""px; the circle lies at least this far outside a dot, so that the blurred border of a small dot is not taken
for the gel. Chosen by hand."""

CONTRAST_FRACTION: Final = 0.25
"""Fraction of the dots' median contrast from which on a spot is a dot. Worn dots keep that much.
Chosen by hand."""

ONE_MASK: Final = 1.6
"""Ratio of the radii of dots for which one circle serves: it lies a radius outside a dot, so one of 1.6 times
the radius is still within it. Chosen on handmade_dots."""

LEAST_CONTRAST: Final = 6.0
"""Least contrast of a dot, grey levels: 120 / 20, the threshold of the original script over its gain."""


@dataclass(frozen=True, slots=True)
class Dot:
    """What the markers of a gel look like.

    radius : px, > 0. polarity : darker or brighter than the gel. contrast : difference to the gel above which
    a spot is a marker, grey levels, > 0. others : radii of those of other sizes, px, each > 0.
    """

    radius: float
    polarity: Polarity = "dark"
    contrast: float = LEAST_CONTRAST
    others: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for radius in (self.radius, *self.others):
            if not (radius > 0 and math.isfinite(radius)):
                raise ValueError(f"radius: required > 0 px, got {radius}")
        if self.polarity not in ("dark", "bright"):
            raise ValueError(f"polarity: required 'dark' or 'bright', got {self.polarity!r}")
        if not (self.contrast > 0 and math.isfinite(self.contrast)):
            raise ValueError(f"contrast: required > 0 grey levels, got {self.contrast}")


def find_dot(
    image: Bytes,
    *,
    radius: float | None = None,
    polarity: Literal["dark", "bright", "auto"] = "auto",
    valid: Bytes | None = None,
) -> Dot | None:
    """Size, polarity and contrast of the markers of a gel, from a picture of the untouched gel.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    radius : of a marker, px, if it is known.
    polarity : of the markers; "auto" takes the stronger family of spots.
    valid : (H, W) uint8, not 0 where there is gel; None: everywhere.

    Returns
    -------
    dot : what the markers look like; None where there are none.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> dot = find_dot(open_scene("press?frames=2").frame(0))
    >>> dot.polarity
    'dark'
    """
    try:
        found = detect_markers(image, dot_radius=radius, polarity=polarity, valid=valid)
    except NoMarkersError:
        return None
    contrast = _median_contrast(_even(image), found.dot_radius, found.polarity)
    columns, rows = np.clip(np.rint((found.centers - 0.5) / 2).astype(int).T, 0, None)
    at = contrast[np.minimum(rows, contrast.shape[0] - 1), np.minimum(columns, contrast.shape[1] - 1)]
    least = max(LEAST_CONTRAST, CONTRAST_FRACTION * float(np.median(at)))
    return Dot(found.dot_radius, found.polarity, least, _other_sizes(found))


def _other_sizes(found: Detection) -> tuple[float, ...]:
    """Radii, px, of marks that a circle around one of the usual size would cut or lead past."""
    if found.radii is None:
        return ()
    step = np.rint(np.log(found.radii / found.dot_radius) / np.log(ONE_MASK))
    sizes, counts = np.unique(step, return_counts=True)
    return tuple(found.dot_radius * ONE_MASK ** float(s) for s in sizes[(counts > 1) & (sizes != 0)])


def marker_mask(image: Bytes, dot: Dot) -> Bytes:
    """Mask of spots of a given size and their soft borders.

    A spot differs by more than `dot.contrast` from every point on a circle around it, in at least two of the
    three channels. A difference of Gaussians compares with the mean of the surroundings instead; the least
    difference keeps the edge of a contact, dark on one side or along a line, out of the mask.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    dot : what a marker looks like.

    Returns
    -------
    mask : (H, W) uint8, 255 on markers, else 0. It is computed at half resolution, so it consists of blocks
        of 2 x 2 px, and every spot is dilated by one block to cover its soft border.

    Raises
    ------
    ValueError : the image is not of that kind.

    Examples
    --------
    >>> import cv2
    >>> gel = np.full((60, 80, 3), 150, np.uint8)
    >>> mask = marker_mask(cv2.circle(gel, (40, 30), 5, (30, 30, 30), -1), Dot(radius=5))
    >>> int(mask[30, 40]), int(mask[30, 60])
    (255, 0)
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"required a non-empty (H, W, 3) uint8 image, got shape {image.shape}, dtype {image.dtype}"
        )
    whole = _even(image)
    mask = _mask(whole, dot, dot.radius)
    for radius in dot.others:
        mask |= _mask(whole, dot, radius)
    return np.ascontiguousarray(mask[: image.shape[0], : image.shape[1]])


def _mask(whole: Bytes, dot: Dot, radius: float) -> Bytes:
    """The mask of dots of one size, of an image of even height and width."""
    own = _contrast(whole, radius, dot.polarity)
    mask = np.empty(whole.shape[:2], np.uint8)
    threshold = min(255, math.floor(dot.contrast))
    cover_spots(own.contrast, threshold, own.reach, _corner(radius), own.spots, own.doubled, mask)
    return mask


def _even(image: Bytes) -> Bytes:
    """The image with its last row and column repeated where their number is odd."""
    bottom, right = image.shape[0] % 2, image.shape[1] % 2
    if bottom or right:
        return np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    return np.ascontiguousarray(image)


class _Buffers:
    """What `_contrast` computes in. Pictures at half size have a margin of `reach` px, the circle's."""

    def __init__(self, height: int, width: int, radius: float, polarity: Polarity) -> None:
        outer = _circle_radius(radius)
        rows, columns = _circle_points(outer)
        reach = self.reach = math.ceil(outer)
        high, wide = height + 2 * reach, width + 2 * reach
        # Nothing outside the frame is as dark as a dot, or as bright.
        self.half = np.full((high, 3 * wide), 255 if polarity == "dark" else 0, np.uint8)
        self.inverted = np.empty_like(self.half)
        self.steps = 3 * (rows * wide + columns)
        self.contrast = np.zeros(self.half.size, np.uint8)
        self.spots = np.empty((high, wide), np.uint8)
        self.doubled = np.empty(2 * self.spots.size, np.uint8)


KINDS_KEPT: Final = 6
"""Kinds of frames and dots whose buffers a thread keeps: sizes of dots in one picture. Chosen by hand."""

_kept = threading.local()
"""The buffers of each thread, for the kinds of frames and dots that it saw last."""


def _contrast(whole: Bytes, radius: float, polarity: Polarity) -> _Buffers:
    """Buffers whose `contrast` is that of an image of even height and width, at half resolution."""
    height, width = whole.shape[0] // 2, whole.shape[1] // 2
    kind = (height, width, radius, polarity)
    buffers: dict[tuple[int, int, float, Polarity], _Buffers] = _kept.__dict__.setdefault("buffers", {})
    if kind not in buffers:
        if len(buffers) >= KINDS_KEPT:
            buffers.clear()
        buffers[kind] = _Buffers(*kind)
    own = buffers[kind]
    picture = own.half
    halve_block(
        whole.reshape(len(whole), -1), 0, 0, picture, own.reach, own.reach, height, width, False, False
    )
    if polarity == "bright":
        # A bright dot is a dark one in the negative.
        picture = np.invert(own.half, out=own.inverted)
    contrast_with_circle(picture, own.reach, own.steps, own.contrast)
    return own


def _median_contrast(whole: Bytes, radius: float, polarity: Polarity) -> Bytes:
    """Median contrast of the three channels, half as high and wide; 0 in the corners of the frame."""
    own = _contrast(whole, radius, polarity)
    reach, (high, wide) = own.reach, own.spots.shape
    channels = own.contrast.reshape(high, wide, 3)[reach : high - reach, reach : wide - reach]
    median = np.sort(channels, axis=2)[:, :, 1]
    side = _corner(radius)
    for rows in (slice(0, side), slice(-side, None)):
        median[rows, :side] = 0
        median[rows, -side:] = 0
    return median


def _circle_radius(radius: float) -> float:
    """Radius at half resolution of the circle that a dot of a radius at full resolution is compared with."""
    return (radius + max(radius, SHARPEST_CIRCLE) + 1) / 2


def _corner(radius: float) -> int:
    """Side, px, of the squares in the corners of the half-size frame in which no dot is looked for.

    Most of the circle is missing there, so any dark corner would be a spot.
    """
    return (2 * math.ceil(_circle_radius(radius)) + 1) // 4


@lru_cache(maxsize=32)
def _circle_points(radius: float) -> NDArray[np.int64]:
    """Rows and columns of the points of a circle, from its centre: (2, CIRCLE_POINTS)."""
    turn = np.arange(CIRCLE_POINTS) * (2 * np.pi / CIRCLE_POINTS)
    return np.rint(radius * np.stack([np.sin(turn), np.cos(turn)])).astype(np.int64)


# The kernels run over pictures as one long line. Shifted by a fixed number of bytes, such a line is what each
# pixel has beside it in some direction, so every loop is one over whole vectors of bytes. What wraps from the
# end of a row to the start of the next lies in the margin, which is 255 and never a spot.


@kernel("void(uint8[:, ::1], int64, int64[::1], uint8[::1])")
def contrast_with_circle(picture: Bytes, reach: int, steps: NDArray[np.int64], contrast: Bytes) -> None:
    """How much darker each value is than the least of twelve places around it; 0 where it is not.

    picture : (h + 2 reach, 3 (w + 2 reach)), with a margin of 255. steps : (12,), from a value to the twelve
    of its circle, in bytes; none leads out of a frame of `reach` px. contrast : as long as the picture;
    its first and last `reach` rows and px are left as they are.
    """
    values = picture.reshape(-1)
    start = reach * (picture.shape[1] + 3)
    count = values.size - 2 * start
    here, out = values[start : start + count], contrast[start : start + count]
    # One name for each of the twelve: a loop over them would go through memory for every one.
    a, b = values[start + steps[0] :][:count], values[start + steps[1] :][:count]
    c, d = values[start + steps[2] :][:count], values[start + steps[3] :][:count]
    e, f = values[start + steps[4] :][:count], values[start + steps[5] :][:count]
    g, h = values[start + steps[6] :][:count], values[start + steps[7] :][:count]
    i, j = values[start + steps[8] :][:count], values[start + steps[9] :][:count]
    k, m = values[start + steps[10] :][:count], values[start + steps[11] :][:count]
    for at in range(count):
        least = min(min(min(a[at], b[at]), min(c[at], d[at])), min(min(e[at], f[at]), min(g[at], h[at])))
        least = min(least, min(min(i[at], j[at]), min(k[at], m[at])))
        out[at] = max(least, here[at]) - here[at]


@kernel("void(uint8[::1], int64, int64, int64, uint8[:, ::1], uint8[::1], uint8[:, ::1])")
def cover_spots(
    contrast: Bytes, threshold: int, reach: int, corner: int, spots: Bytes, doubled: Bytes, mask: Bytes
) -> None:
    """255 on and next to every px whose median contrast exceeds a threshold, at twice the size.

    contrast : of `contrast_with_circle`. threshold : grey levels, 0 to 255. corner : px; squares of that side
    in the picture's corners hold no spot. spots : (h + 2 reach, w + 2 reach), reach >= 1, and doubled, of
    twice its length, are written over. mask : (2 h, 2 w) is filled.
    """
    wide, flat = spots.shape[1], spots.reshape(-1)
    least = np.uint8(threshold)
    for at in range(flat.size):
        first, second, third = contrast[3 * at], contrast[3 * at + 1], contrast[3 * at + 2]
        median = max(min(first, second), min(max(first, second), third))
        flat[at] = 255 if median > least else 0
    height, width = mask.shape[0] // 2, mask.shape[1] // 2
    side = min(corner, width)
    for y in range(min(corner, height)):
        for row in (reach + y, reach + height - 1 - y):
            spots[row, reach : reach + side] = 0
            spots[row, reach + width - side : reach + width] = 0
    start = reach * wide
    count = flat.size - 2 * start
    above, here, below = flat[start - wide - 1 :], flat[start - 1 :], flat[start + wide - 1 :]
    for x in range(count):
        near = above[x] | here[x] | below[x]
        near |= above[x + 1] | here[x + 1] | below[x + 1]
        near |= above[x + 2] | here[x + 2] | below[x + 2]
        doubled[2 * x] = near
        doubled[2 * x + 1] = near
    pixels = mask.reshape(-1)
    for y in range(height):
        # The mask is new, in no cache: its lines are asked for ahead, 64 bytes at a time.
        for place in range(4 * (y + 8) * width, 4 * (y + 9) * width, 64):
            prefetch(pixels, place)
        # Copied value by value, which becomes whole vectors; a slice assigned to a slice does not.
        line, upper, lower = doubled[2 * (y * wide + reach) :], mask[2 * y], mask[2 * y + 1]
        for x in range(2 * width):
            upper[x] = line[x]
            lower[x] = line[x]
