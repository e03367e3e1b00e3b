"""Dirt on the lens, and shadows: changes that take light away, and nothing else.

Dirt multiplies the light of all channels by the same factor, at most 1. An object that presses on a gel that
lamps of different colours light turns its surface towards some and away from others, so that the colour
changes, or a flank brightens. Under lamps of one colour a contact may darken as a whole, as dirt does, and
nothing in a picture tells them apart.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats32
from tactflow.vision.contact.components import SQUARE

MIN_COLOUR_SPREAD: Final = 0.06
"""Spread of the colours of an untouched gel, standard deviation of the unit vectors of its light, from which
its lamps have different colours: 0.07 to 0.28 on gels of fourteen labs, 0.01 and 0.02 on two lit in white."""
MAX_UNEXPLAINED_SHARE: Final = 0.1
"""Largest share of the power of a change that a loss of light does not explain, if it is dirt. It is 0.3 or
more for the outlined contacts of fifteen labs, and below 0.01 for most specks drawn onto their pictures
(`python -m lab.judges.judge --dirt 3`)."""


def light_directions(light: Floats32, gel: Flags | None) -> Floats32 | None:
    """Colour of the light of each cell, (3, h, w) float32 unit vectors; None under lamps of one colour, or
    without any cell of gel.

    light : (3, h, w) float32, grey levels of the untouched gel. gel : (h, w) bool, cells that show it; None:
    all do.

    >>> red_to_blue = np.stack([np.eye(8), np.full((8, 8), 0.1), 1 - np.eye(8)]).astype(np.float32)
    >>> light_directions(red_to_blue, None) is None, light_directions(np.ones_like(red_to_blue), None) is None
    (False, True)
    """
    if gel is not None and not gel.any():
        return None
    colours = light / np.maximum(np.linalg.norm(light, axis=0), np.float32(1e-6))
    mean = (colours if gel is None else colours[:, gel]).reshape(3, -1).mean(axis=1)
    coloured = 1 - float(mean @ mean) >= MIN_COLOUR_SPREAD**2
    return np.asarray(colours, np.float32) if coloured else None


def attenuated_cells(change: Floats32, colours: Floats32, changed: Flags) -> Flags | None:
    """Connected changes that a loss of light explains, with the cells around them; (h, w) bool, or None.

    change : (3, h, w) float32, signed, in a unit that is the same for all channels. colours : (3, h, w)
    float32, from `light_directions`. changed : (h, w) bool.

    >>> gel = np.full((3, 9, 9), 0.577, np.float32)
    >>> speck, tilt = np.zeros((2, 3, 9, 9), np.float32)
    >>> speck[:, 3:6, 3:6], tilt[0, 3:6, 3:6] = -40, -40
    >>> changed = speck[0] < 0
    >>> attenuated_cells(speck, gel, changed).sum(), attenuated_cells(tilt, gel, changed)
    (np.int64(25), None)
    """
    _, labels = cv2.connectedComponents(changed.view(np.uint8), connectivity=8)
    cells = np.flatnonzero(changed)
    signed, directions = (planes.reshape(3, -1).take(cells, axis=1) for planes in (change, colours))
    lost = np.minimum((signed * directions).sum(axis=0), np.float32(0))
    unexplained = (signed * signed).sum(axis=0) - lost * lost * np.float32(1 / (1 - MAX_UNEXPLAINED_SHARE))
    dirt = np.bincount(labels.ravel()[cells], unexplained, minlength=1) < 0
    if not dirt.any():
        return None
    return np.asarray(cv2.dilate(dirt[labels].view(np.uint8), SQUARE)).view(np.bool_)
