"""Millimetres per pixel, from the pitch of the dots or the size of the picture."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactflow.vision.arrays import MAD_TO_SIGMA
from tactflow.vision.markers.lattice import nearest
from tactflow.vision.types import Scale

MIN_LINKS: Final = 8
"""Least number of links between neighbouring dots in each direction. Chosen by hand."""
EDGE_STDERR_PX: Final = 0.5
"""Standard error of an edge of the picture, px. Chosen by hand."""
MAX_LINK_RATIO: Final = 1.35
"""Largest distance of neighbours over the typical one: less than the diagonal of a square, 1.41."""


def centre(size: tuple[int, int]) -> tuple[float, float]:
    """The middle of a picture of size (width, height), px: where its mm coordinates are 0.

    >>> centre((320, 240))
    (159.5, 119.5)
    """
    return ((size[0] - 1) / 2, (size[1] - 1) / 2)


def scale_from_pitch(dots: ArrayLike, pitch: float, size: tuple[int, int]) -> Scale:
    """From dots that are printed in a square grid of known pitch.

    The links between neighbours have two directions at right angles in mm; the scales of x and y are those
    that make the mean link of each direction one pitch long. If the grid is rotated so far that this cannot
    distinguish x from y, both get one scale.

    dots : (N, 2), px, on the untouched gel. pitch : mm. size : (width, height) of the picture, px.

    The standard errors contain the scatter of the links and the deviation from a square grid: the difference
    of x and y, since the dots alone cannot distinguish a stretched picture from a grid that is not square,
    and the lengths of single links, which differ from their mean in rings.

    Raises ValueError for too few dots in a grid, or a pitch that is not > 0.

    >>> x, y = np.meshgrid(np.arange(6) * 20.0, np.arange(5) * 25.0)
    >>> scale = scale_from_pitch(np.column_stack([x.ravel(), y.ravel()]), 2.0, (120, 120))
    >>> round(scale.x, 6), round(scale.y, 6)
    (0.1, 0.08)
    >>> round(scale.stderr[0], 3)
    0.016
    """
    if not (np.isfinite(pitch) and pitch > 0):
        raise ValueError(f"pitch: required > 0 mm, got {pitch:g}")
    groups = _links(np.asarray(dots, np.float64).reshape(-1, 2))
    fewest = min(len(group) for group in groups)
    if fewest < MIN_LINKS:
        raise ValueError(
            f"scale by pitch: required a grid with {MIN_LINKS} pairs of neighbours along each direction, "
            f"found {fewest}; give the size of the picture with --area instead"
        )
    means = np.array([np.median(group, axis=0) for group in groups])
    x, y = _square(means, pitch)
    deviations = [np.abs(group - mean) for group, mean in zip(groups, means, strict=True)]
    spread = MAD_TO_SIGMA * np.array([np.median(deviation, axis=0) for deviation in deviations])
    error = spread / np.sqrt([[len(group)] for group in groups])
    # Along an axis the relative error of the scale is that of the links that run along it.
    along = np.argmax(np.abs(means), axis=0)
    scattered = np.array([error[along[k], k] / abs(means[along[k], k]) for k in (0, 1)])
    lengths = np.array([np.median(np.hypot(*(group * (x, y)).T)) for group in groups])
    bent = lengths[along] / pitch - 1
    # The part of the difference that the scatter explains must not count twice.
    apart = max((2 * (x - y) / (x + y)) ** 2 - float((scattered**2).sum()), 0.0) / 2
    relative = np.sqrt(scattered**2 + bent**2 + apart)
    return Scale(x, y, (float(x * relative[0]), float(y * relative[1])), centre(size))


def _square(means: NDArray[np.float64], pitch: float) -> tuple[float, float]:
    """Scales of x and y that make both mean links, (2, 2) px, one pitch long."""
    squares = means**2
    if abs(np.linalg.det(squares)) < 0.25 * squares.sum() ** 2 / 4:
        both = float(pitch / np.sqrt(squares.sum(axis=1)).mean())
        return both, both
    x, y = np.sqrt(np.maximum(np.linalg.solve(squares, [pitch**2, pitch**2]), 0)).tolist()
    if not (x > 0 and y > 0):
        raise ValueError(
            "scale by pitch: the dots are in no square grid; give the size of the picture with --area instead"
        )
    return x, y


def scale_from_area(area: tuple[float, float], size: tuple[int, int]) -> Scale:
    """From the width and height, mm, of a whole picture of size (width, height), px.

    The standard errors are those of edges known to half a pixel.

    >>> scale = scale_from_area((24, 32), (240, 320))
    >>> scale.x, scale.y, round(scale.stderr[0], 6)
    (0.1, 0.1, 0.000295)
    """
    x, y = area[0] / size[0], area[1] / size[1]
    stderr = math.sqrt(2) * EDGE_STDERR_PX * x / size[0], math.sqrt(2) * EDGE_STDERR_PX * y / size[1]
    return Scale(x, y, stderr, centre(size))


def _links(dots: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Links between neighbours, (N, 2) px each: those along x, right, and those along y, down."""
    distances, near = nearest(dots, 4)
    if not distances.size:
        return np.zeros((0, 2)), np.zeros((0, 2))
    typical = np.median(distances[:, : min(2, distances.shape[1])])
    first = np.repeat(np.arange(len(dots)), near.shape[1])
    links = dots[near.ravel()] - dots[first]
    links = links[np.hypot(*links.T) < MAX_LINK_RATIO * typical]
    across = np.abs(links[:, 0]) >= np.abs(links[:, 1])
    # Each pair of neighbours is found from both sides.
    return links[across & (links[:, 0] > 0)], links[~across & (links[:, 1] > 0)]
