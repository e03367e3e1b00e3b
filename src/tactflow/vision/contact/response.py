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
    seen = change[:, ::2, ::2] * inside
    moments = cv2.moments(cv2.magnitude(cv2.magnitude(seen[0], seen[1]), seen[2]))
    total = moments["mu20"] + moments["mu02"]
    spread = math.hypot(moments["mu20"] - moments["mu02"], 2 * moments["mu11"])
    if not total + spread < LONG * (total - spread):
        return EVEN
    elongation = (total + spread) / (total - spread)
    colours = seen.reshape(3, -1)
    # LAPACK, called once a frame, takes eight times as long: nothing of it is in the caches.
    _, powers, directions = cv2.eigen(cv2.mulTransposed(colours, False))
    first, second, _ = powers.ravel().tolist()
    if second * elongation >= first:
        return EVEN
    raised = min(first / max(second * elongation, 1e-6 * first), LARGEST_GAIN**2)
    gain = raised ** min((LONG - elongation) / (LONG - ROUND), 1.0)
    whole = float(powers.sum())
    scale = whole / (gain * whole - (gain - 1) * first)
    strongest = directions[0] * np.float32(math.sqrt((gain - 1) * scale))
    return Response(np.float32(gain * scale), np.asarray(strongest, np.float32))
