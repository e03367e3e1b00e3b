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

from tactflow.vision.compiled import helper, kernel

Float = NDArray[np.float32]
Double = NDArray[np.float64]

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
    strongest: Float


EVEN: Final = Response(np.float32(1), np.zeros(3, np.float32))
"""The response of light that answers evenly."""


def light_response(change: Float, inside: NDArray[np.bool_]) -> Response:
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


@kernel("void(float32[:, ::1], uint8[:, ::1], float32[::1])", reorder=True)
def weigh_colours(change: Float, inside: NDArray[np.uint8], response: Float) -> None:
    """What `light_response` does; response : (4,), filled with the gain and the strongest colour."""
    sums = _sum_change(change, inside)
    response[0], response[1:] = 1, 0
    mass = max(sums[0], 1e-9)
    along, across = sums[3] - sums[1] * sums[1] / mass, sums[5] - sums[2] * sums[2] / mass
    total = along + across
    spread = math.hypot(along - across, 2 * (sums[4] - sums[1] * sums[2] / mass))
    if not LEAST * mass < total + spread < LONG * (total - spread):
        return
    elongation = (total + spread) / (total - spread)
    first, second, direction = _principal(sums[6:])
    if second * elongation >= first:
        return
    raised = min(first / max(second * elongation, 1e-6 * first), LARGEST_GAIN**2)
    gain = raised ** min((LONG - elongation) / (LONG - ROUND), 1.0)
    whole = sums[6] + sums[9] + sums[11]
    scale = whole / (gain * whole - (gain - 1) * first)
    length = math.copysign(math.sqrt((gain - 1) * scale), direction[2])
    response[0] = gain * scale
    for c in range(3):
        response[1 + c] = length * direction[c]


@helper
def _sum_change(change: Float, inside: NDArray[np.uint8]) -> Double:
    """(12,) float64: sums over every second pixel of a change where `inside` is not 0.

    The moments of its size: 1, x, y, x^2, x y, y^2, in two pixels; and the products of its channels: blue
    blue, blue green, blue red, green green, green red, red red.
    """
    sums, zero = np.zeros(12), np.float32(0)
    each = len(change) // (2 * len(inside))
    for y in range(each * len(inside)):
        cells, line = inside[y // each], change[2 * y]
        bb = bg = br = gg = gr = rr = size = size_x = size_xx = zero
        for cell in range(cells.size):
            if cells[cell]:
                for x in range(each * cell, each * cell + each):
                    b, g, r = line[6 * x], line[6 * x + 1], line[6 * x + 2]
                    bb, gg, rr = bb + b * b, gg + g * g, rr + r * r
                    bg, br, gr = bg + b * g, br + b * r, gr + g * r
                    length, along = np.sqrt(b * b + g * g + r * r), np.float32(x)
                    size, size_x, size_xx = (
                        size + length,
                        size_x + length * along,
                        size_xx + length * along * along,
                    )
        sums[0], sums[1], sums[2] = sums[0] + size, sums[1] + size_x, sums[2] + size * y
        sums[3], sums[4], sums[5] = sums[3] + size_xx, sums[4] + size_x * y, sums[5] + size * y * y
        sums[6], sums[7], sums[8] = sums[6] + bb, sums[7] + bg, sums[8] + br
        sums[9], sums[10], sums[11] = sums[9] + gg, sums[10] + gr, sums[11] + rr
    return sums


@helper
def _principal(matrix: Double) -> tuple[float, float, Double]:
    """The two largest eigenvalues of a symmetric matrix, and the first's eigenvector, of length 1.

    matrix : (6,), what is on and above its diagonal, row by row; positive semidefinite.

    References
    ----------
    O. K. Smith, "Eigenvalues of a symmetric 3 x 3 matrix", Communications of the ACM 4 (1961).
    """
    bg, br, gr = matrix[1], matrix[2], matrix[4]
    middle = (matrix[0] + matrix[3] + matrix[5]) / 3
    b, g, r = matrix[0] - middle, matrix[3] - middle, matrix[5] - middle
    radius = math.sqrt((b * b + g * g + r * r + 2 * (bg * bg + br * br + gr * gr)) / 6)
    half = (b * (g * r - gr * gr) - bg * (bg * r - gr * br) + br * (bg * gr - g * br)) / 2
    turn = math.acos(min(max(half / max(radius**3, 1e-30), -1.0), 1.0)) / 3
    first, second = 2 * radius * math.cos(turn), 2 * radius * math.cos(turn - 2 * math.pi / 3)
    # Across two rows of the matrix less the eigenvalue; those that span most tell it best.
    b, g, r = b - first, g - first, r - first
    direction, longest = np.zeros(3), 0.0
    for x, y, z in (
        (bg * gr - br * g, br * bg - b * gr, b * g - bg * bg),
        (g * r - gr * gr, gr * br - bg * r, bg * gr - g * br),
        (bg * r - gr * br, br * br - b * r, b * gr - br * bg),
    ):
        length = math.sqrt(x * x + y * y + z * z)
        if length > longest:
            longest = length
            direction[0], direction[1], direction[2] = x / length, y / length, z / length
    return middle + first, middle + second, direction
