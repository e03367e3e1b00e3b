"""The probability that a changed region is a contact, by logistic regression.

It rests on two cues: an object that presses changes the slopes of the gel, and so the colour of its light,
while shadows and lamps change its brightness; and the markers move around a contact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Floats, Floats32, Mask, Points
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.background import CELL_PX
from tactflow.vision.types import Contact

EVIDENCE_WEIGHTS: Final = (0.37, 1.59, 1.67)
"""Constant and weights of `contact_evidence` in the log odds: `python -m lab.probability contacts`."""
MIN_REGION_PROBABILITY: Final = 0.25
"""Probability below which a region beside another is rejected: odds of three to one against it."""
MIN_COLOUR_SHARE: Final = 1e-3
"""Lower bound of the share of colour in a change, so that its logarithm is finite."""


def contact_evidence(parts: Sequence[Contact], mask: Mask, deviations: Floats32) -> Floats:
    """Evidence that each of several regions is a contact.

    Parameters
    ----------
    parts : the separate regions. mask : (H, W) uint8, non-zero inside them.
    deviations : (2, h, w) float32, `ContactResult.deviations`, of the light and of the colour of each cell.

    Returns
    -------
    (n, 2) : logarithm of the share of colour in the region's largest change; 1 if markers moved as well, else
        0.
    """
    whole = np.ascontiguousarray(mask)
    evidence = np.empty((len(parts), 2))
    for row, part in zip(evidence, parts, strict=True):
        light, colour = largest_deviations(deviations, whole, part.hull, CELL_PX)
        row[:] = math.log(max(colour / max(light, 1e-9), MIN_COLOUR_SHARE)), part.evidence == "both"
    return evidence


@kernel
def largest_deviations(deviations: Floats32, mask: Mask, hull: Points, side: int) -> tuple[float, float]:
    """Largest deviations among the cells of a region; 0 if it has none.

    deviations : (2, h, w), >= 0. mask : (H, W), not 0 inside of regions. hull : (n, 2), the region's corners,
    clockwise on the screen. side : of cells, px; a cell belongs to the region if its first pixel does.
    """
    y, x = side * np.array(mask[::side, ::side].nonzero())
    # No pixel is to the left of a side of the hull.
    (corner_x, corner_y), (right, down) = hull.T[:, :, None], (np.roll(hull, -1, axis=0) - hull).T[:, :, None]
    inside = (right * (y - corner_y) >= down * (x - corner_x)).all(axis=0)
    inside &= (x >= corner_x.min()) & (x <= corner_x.max()) & (y >= corner_y.min()) & (y <= corner_y.max())
    light, colour = deviations[:, y[inside] // side, x[inside] // side].max(axis=1, initial=0)
    return float(light), float(colour)


def with_probability(parts: Sequence[Contact], mask: Mask, deviations: Floats32) -> list[Contact]:
    """Set the probability of each region; arguments as in `contact_evidence`.

    Regions that only the markers show have none, because there is no change of light to judge.
    """
    constant, colour, motion = EVIDENCE_WEIGHTS
    evidence = contact_evidence(parts, mask, deviations).tolist()
    return [
        part
        if part.evidence == "dots"
        else replace(part, probability=1 / (1 + math.exp(-(constant + colour * share + motion * moved))))
        for part, (share, moved) in zip(parts, evidence, strict=True)
    ]


def without_doubtful(parts: Sequence[Contact], mask: Mask) -> tuple[list[Contact], Mask]:
    """Remove improbable regions from the list and the mask; the most probable one is always kept.

    parts : all regions of the mask, (H, W) uint8, 0 or 255. The mask itself is returned if all are kept.
    """
    best = max(parts, key=_probability)
    probable = [part for part in parts if part is best or _probability(part) >= MIN_REGION_PROBABILITY]
    if len(probable) == len(parts):
        return probable, mask
    kept = mask.copy()
    for part in parts:
        if not any(part is other for other in probable):
            x, y = part.hull[0]
            cv2.floodFill(kept, None, (int(x), int(y)), (0.0,), flags=8)
    return probable, kept


def _probability(part: Contact) -> float:
    return 1.0 if part.probability is None else part.probability
