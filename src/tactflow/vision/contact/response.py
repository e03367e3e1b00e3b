"""How evenly the light on a gel answers to slopes of different directions.

A ball tilts the gel in all directions alike, but lamps that are dim, white or too high hardly show some of
them, and an outline that follows the size of the change is dented there. What a round contact shows tells by
how much. On an elliptic paraboloid z = x^2 / a^2 + y^2 / b^2 the covariance of the slopes is that of the
places, turned round: slopes across are b / a times those along. So a colour whose share in the change is
smaller than this is one to which the light answers weakly.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats, Floats32
from tactflow.vision.compiled import kernel

LARGEST_GAIN: Final = 2.0
"""By how much a weak answer is raised at most, since noise is raised with it. Chosen by hand; 3 gives the
same outlines of real gels within 0.003 in IoU."""

ROUND: Final = 3.0
LONG: Final = 5.0
"""Ratio of the variances along and across a contact up to which it is taken for a paraboloid, and from which
it is not: the flanks of an edge have two slopes, and its ends are no measure of the light. Chosen by hand,
around an axis ratio of 2."""

LEAST: Final = 0.1
"""Twice the variance of the places along a contact, in squares of two pixels, from which on it has a shape.
Rounding makes up to 1e-3 at 150 px."""


class Response(NamedTuple):
    """How to weigh a change v of the three channels so that slopes of all directions count alike.

    Its squared strength is gain |v|^2 - (strongest . v)^2, of the same sum over a contact as |v|^2.

    gain : >= 0. strongest : (3,) float32, along the colour that the light answers with most, red
    >= 0; 0 for even light.
    """

    gain: np.float32
    strongest: Floats32


EVEN: Final = Response(np.float32(1), np.zeros(3, np.float32))
"""The response of light that answers evenly."""


def light_response(change: Floats32, inside: NDArray[np.bool_]) -> Response:
    """Tell from the change in a contact's window how evenly the light answers.

    change : (n h, 3 n w) float32, channels side by side, standard deviations; n even. inside : (h, w) bool,
    cells that belong to the contact.

    Red answers to slopes in x, green half as strongly to those in y, and counts nearly as much then:

    >>> import numpy as np
    >>> y, x = np.mgrid[:32, :32].astype(np.float32) - 15.5
    >>> change = np.stack([0 * x, y / 2, x], axis=2) * (np.hypot(x, y) < 14)[..., None]
    >>> gain, strongest = light_response(change.reshape(32, 96), np.ones((16, 16), bool))
    >>> weighed = np.sqrt(gain * (change**2).sum(axis=2) - (change @ strongest) ** 2)
    >>> bool(weighed[25, 16] > 0.8 * weighed[16, 25])
    True
    """
    moments, colours = np.zeros(6), np.zeros((3, 3))
    add_moments(change, inside.view(np.uint8), moments, colours)
    mass, sum_x, sum_y, sum_xx, sum_xy, sum_yy = moments.tolist()
    if not mass > 0:
        return EVEN
    along_x, along_y = sum_xx - sum_x * sum_x / mass, sum_yy - sum_y * sum_y / mass
    total, spread = along_x + along_y, math.hypot(along_x - along_y, 2 * (sum_xy - sum_x * sum_y / mass))
    if not LEAST * mass < total + spread < LONG * (total - spread):
        return EVEN
    elongation = (total + spread) / (total - spread)
    _, powers, directions = cv2.eigen(colours)
    first, second, _ = powers.ravel().tolist()
    if second * elongation >= first:
        return EVEN
    raised = first / max(second * elongation, 1e-6 * first)
    gain = min(raised, LARGEST_GAIN**2) ** min((LONG - elongation) / (LONG - ROUND), 1.0)
    # So that the sum over the contact stays as it was.
    whole = float(powers.sum())
    scale = whole / (gain * whole - (gain - 1) * first)
    strongest = directions[0] * math.copysign(math.sqrt((gain - 1) * scale), directions[0, 2])
    return Response(np.float32(gain * scale), np.asarray(strongest, np.float32))


@kernel("void(float32[:, ::1], uint8[:, ::1], float64[::1], float64[:, ::1])")
def add_moments(change: Floats32, inside: NDArray[np.uint8], moments: Floats, colours: Floats) -> None:
    """Add up, over every second pixel that counts, the places and the channels.

    change, inside : of `light_response`. moments : (6,), sums of the change's length times 1, x, y, x^2, x y,
    y^2, in two pixels. colours : (3, 3), sums of the products of channels.
    """
    each, zero = len(change) // (2 * len(inside)), np.float32(0)
    bb = bg = br = gg = gr = rr = np.float64(0)
    for y in range(each * len(inside)):
        cells, line = inside[y // each], change[2 * y]
        size = size_x = size_xx = zero
        for cell in range(cells.size):
            if cells[cell]:
                for x in range(each * cell, each * cell + each):
                    b, g, r, along = line[6 * x], line[6 * x + 1], line[6 * x + 2], np.float32(x)
                    bb, gg, rr = bb + b * b, gg + g * g, rr + r * r
                    bg, br, gr = bg + b * g, br + b * r, gr + g * r
                    length = np.sqrt(b * b + g * g + r * r)
                    size, size_x = size + length, size_x + length * along
                    size_xx += length * along * along
        moments[0] += size
        moments[1], moments[2] = moments[1] + size_x, moments[2] + size * y
        moments[3], moments[4] = moments[3] + size_xx, moments[4] + size_x * y
        moments[5] += size * y * y
    colours[0, 0], colours[1, 1], colours[2, 2] = bb, gg, rr
    colours[0, 1] = colours[1, 0] = bg
    colours[0, 2] = colours[2, 0] = br
    colours[1, 2] = colours[2, 1] = gr
