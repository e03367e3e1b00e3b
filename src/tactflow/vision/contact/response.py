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

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32
from tactflow.vision.compiled import helper, kernel

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
    response = np.empty(4, np.float32)
    weigh_colours(change, inside.view(np.uint8), response)
    return Response(response[0], response[1:])


@kernel("void(float32[:, ::1], uint8[:, ::1], float32[::1])")
def weigh_colours(change: Floats32, inside: NDArray[np.uint8], response: Floats32) -> None:
    """What `light_response` does; response : (4,), filled with the gain and the strongest colour."""
    each, zero = len(change) // (2 * len(inside)), np.float32(0)
    # Over every second pixel: moments of the change's length, in two pixels, and products of the channels.
    mass = sum_x = sum_y = sum_xx = sum_xy = sum_yy = np.float64(1e-9)
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
                    size, size_x, size_xx = (
                        size + length,
                        size_x + length * along,
                        size_xx + length * along * along,
                    )
        mass, sum_x, sum_y = mass + size, sum_x + size_x, sum_y + size * y
        sum_xx, sum_xy, sum_yy = sum_xx + size_xx, sum_xy + size_x * y, sum_yy + size * y * y
    response[0] = 1
    response[1] = response[2] = response[3] = 0
    along_x, along_y = sum_xx - sum_x * sum_x / mass, sum_yy - sum_y * sum_y / mass
    total, mixed = along_x + along_y, sum_xy - sum_x * sum_y / mass
    spread = math.sqrt((along_x - along_y) * (along_x - along_y) + 4 * mixed * mixed)
    if not LEAST * mass < total + spread < LONG * (total - spread):
        return
    elongation, whole = (total + spread) / (total - spread), bb + gg + rr
    first, second, blue, green, red = _principal(bb, bg, br, gg, gr, rr)
    if second * elongation >= first:
        return
    raised = first / max(second * elongation, 1e-6 * first)
    gain = min(raised, LARGEST_GAIN * LARGEST_GAIN) ** min((LONG - elongation) / (LONG - ROUND), 1.0)
    scale = whole / (gain * whole - (gain - 1) * first)
    length = math.sqrt((gain - 1) * scale)
    response[0] = gain * scale
    response[1], response[2], response[3] = length * blue, length * green, length * red


@helper
def _principal(
    bb: float, bg: float, br: float, gg: float, gr: float, rr: float
) -> tuple[float, float, float, float, float]:
    """The two largest eigenvalues of a symmetric matrix; and the first's eigenvector, of length 1, red >= 0.

    The matrix is given by what is on its diagonal and above; it is positive semidefinite and not 0.

    References
    ----------
    O. K. Smith, "Eigenvalues of a symmetric 3 x 3 matrix", Communications of the ACM 4 (1961).
    """
    middle = (bb + gg + rr) / 3
    b, g, r = bb - middle, gg - middle, rr - middle
    radius = math.sqrt((b * b + g * g + r * r + 2 * (bg * bg + br * br + gr * gr)) / 6) + 1e-12 * middle
    half = (b * (g * r - gr * gr) - bg * (bg * r - gr * br) + br * (bg * gr - g * br)) / 2
    cosine = half / (radius * radius * radius)
    turn = math.acos(min(max(cosine, -1.0), 1.0)) / 3
    first, second = 2 * radius * math.cos(turn), 2 * radius * math.cos(turn - 2 * math.pi / 3)
    # Across two rows of the matrix less the eigenvalue; those that span most tell it best.
    b, g, r = b - first, g - first, r - first
    x, y, z = bg * gr - br * g, br * bg - b * gr, b * g - bg * bg
    square = x * x + y * y + z * z
    for turned in range(2):
        u, v, w = g * r - gr * gr, gr * br - bg * r, bg * gr - g * br
        if turned:
            u, v, w = bg * r - gr * br, br * br - b * r, b * gr - br * bg
        if u * u + v * v + w * w > square:
            x, y, z, square = u, v, w, u * u + v * v + w * w
    length = math.copysign(math.sqrt(square) + 1e-300, z)
    return middle + first, middle + second, x / length, y / length, z / length
