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

from tactflow.vision.compiled import kernel

Float = NDArray[np.float32]

LARGEST_GAIN: Final = 2.0
"""By how much a weak answer is raised at most, since noise is raised with it. Chosen by hand; 3 gives the
same outlines of real gels within 0.003 in IoU."""

ROUND: Final = 3.0
LONG: Final = 5.0
"""Ratio of the variances along and across a contact up to which it is taken for a paraboloid, and from which
it is not: the flanks of an edge have two slopes, and its ends are no measure of the light. Chosen by hand,
around an axis ratio of 2."""


class Response(NamedTuple):
    """How to weigh a change v of the three channels so that slopes of all directions count alike.

    Its squared strength is gain |v|^2 - (strongest . v)^2, of the same sum over a contact as |v|^2.

    gain : >= 0. strongest : (3,) float32, along the colour that the light answers with most; 0 for even
    light.
    """

    gain: np.float32
    strongest: Float


EVEN: Final = Response(np.float32(1), np.zeros(3, np.float32))
"""The response of light that answers evenly."""


def light_response(change: Float, inside: NDArray[np.bool_]) -> Response:
    """Tell from the change in a contact's window how evenly the light answers.

    change : (3, 2h, 2w) float32, standard deviations. inside : (h, w) bool, cells that belong to the contact.

    Red answers to slopes in x, green half as strongly to those in y, and counts nearly as much then:

    >>> import numpy as np
    >>> y, x = np.mgrid[:32, :32].astype(np.float32) - 15.5
    >>> change = np.stack([0 * x, y / 2, x]) * (np.hypot(x, y) < 14)
    >>> gain, strongest = light_response(change, np.ones((16, 16), bool))
    >>> weighed = np.sqrt(gain * (change**2).sum(axis=0) - np.tensordot(strongest, change, 1) ** 2)
    >>> bool(weighed[25, 16] > 0.8 * weighed[16, 25])
    True
    """
    moments, colours = np.zeros(6), np.zeros((3, 3))
    sum_change(change, np.ascontiguousarray(inside).view(np.uint8), moments, colours)
    mass, x, y, xx, xy, yy = moments.tolist()
    mass = max(mass, 1e-9)
    along, across, mixed = xx - x * x / mass, yy - y * y / mass, xy - x * y / mass
    total, spread = along + across, math.hypot(along - across, 2 * mixed)
    if not total + spread < LONG * (total - spread):
        return EVEN
    elongation = (total + spread) / (total - spread)
    # LAPACK, called once a frame, takes eight times as long: nothing of it is in the caches.
    _, powers, directions = cv2.eigen(colours)
    first, second, third = powers.ravel().tolist()
    if second * elongation >= first:
        return EVEN
    raised = min(first / max(second * elongation, 1e-6 * first), LARGEST_GAIN**2)
    gain = raised ** min((LONG - elongation) / (LONG - ROUND), 1.0)
    whole = first + second + third
    scale = whole / (gain * whole - (gain - 1) * first)
    strongest = directions[0] * np.float32(math.sqrt((gain - 1) * scale))
    return Response(np.float32(gain * scale), np.asarray(strongest, np.float32))


@kernel("void(float32[:, :, ::1], uint8[:, ::1], float64[::1], float64[:, ::1])", reorder=True)
def sum_change(
    change: Float, inside: NDArray[np.uint8], moments: NDArray[np.float64], colours: NDArray[np.float64]
) -> None:
    """Sums over every second pixel of a change, (3, 2 h, 2 w), where `inside`, (h, w), is not 0.

    moments : (6,), 0, becomes those of its size: 1, x, y, x^2, x y, y^2, in cells. colours : (3, 3), 0,
    becomes the products of its channels.
    """
    zero = np.float32(0)
    for y in range(inside.shape[0]):
        blue, green, red = change[0, 2 * y], change[1, 2 * y], change[2, 2 * y]
        bb = bg = br = gg = gr = rr = size = size_x = size_xx = zero
        for x in range(inside.shape[1]):
            seen = np.float32(inside[y, x])
            b, g, r = blue[2 * x] * seen, green[2 * x] * seen, red[2 * x] * seen
            bb, gg, rr = bb + b * b, gg + g * g, rr + r * r
            bg, br, gr = bg + b * g, br + b * r, gr + g * r
            length = np.sqrt(b * b + g * g + r * r)
            size, size_x = size + length, size_x + length * np.float32(x)
            size_xx += length * np.float32(x * x)
        colours[0, 0] += bb
        colours[1, 1] += gg
        colours[2, 2] += rr
        colours[0, 1] += bg
        colours[0, 2] += br
        colours[1, 2] += gr
        moments[0] += size
        moments[1] += size_x
        moments[2] += size * y
        moments[3] += size_xx
        moments[4] += size_x * y
        moments[5] += size * y * y
    for i in range(3):
        for j in range(i):
            colours[i, j] = colours[j, i]
