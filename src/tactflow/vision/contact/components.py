"""Connected components of changed cells: which of them are contacts.

`contact_cells` selects strong components by hysteresis; `wide_change` selects faint but wide ones.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats32
from tactflow.vision.compiled import kernel

SQUARE: Final = np.ones((3, 3), np.uint8)
"""A cell and its neighbours."""
MIN_CELLS: Final = 8
"""Minimum size of a contact, cells. Chosen by hand: 128 px^2 is the halo of a ball's first touch."""
WIDE_DEVIATION: Final = 12.0
"""Minimum squared deviation of colour in a wide change: exceeded by 1 cell of 400 by chance (chi-square with
two degrees of freedom)."""


def wide_change(colour: Floats32, extent: float) -> Flags | None:
    """Connected changes of colour that cover at least `extent` cells.

    colour : (h, w) float32, squared deviations. Returns (h, w) bool, or None if there is no such change.

    >>> import numpy as np
    >>> colour = np.zeros((9, 9), np.float32)
    >>> colour[2:6, 2:6] = 20
    >>> wide_change(colour, 16).sum(), wide_change(colour, 17)
    (np.int64(16), None)
    """
    changed = (colour > WIDE_DEVIATION).view(np.uint8)
    if cv2.countNonZero(changed) < extent:
        return None
    _, labels = cv2.connectedComponents(changed, connectivity=8)
    wide = np.bincount(labels.ravel()) >= extent
    wide[0] = False
    return np.asarray(wide[labels], np.bool_) if wide.any() else None


@kernel
def contact_cells(
    squared: Floats32, weak: float, start: float, stay: float, before: Flags, least: int, found: Flags
) -> int:
    """Find cells in contact by hysteresis, small gaps closed; returns their number.

    squared : (h, w) float32, squared deviations. weak : low threshold, for cells connected to a contact.
    start : peak that starts a contact. stay : peak that continues one. before : (h, w) bool, cells in contact
    in the previous frame. least : minimum number of connected cells. found : (h, w) bool, filled.

    >>> import numpy as np
    >>> squared = np.zeros((9, 9), np.float32)
    >>> squared[2:6, 2:6] = 20
    >>> before, found = np.zeros((2, 9, 9), np.bool_)
    >>> [contact_cells(squared, 5, start, 10, before, 8, found) for start in (10, 30)]
    [16, 0]
    """
    changed = cv2.morphologyEx((squared > weak).view(np.uint8), cv2.MORPH_CLOSE, SQUARE)
    count, labels = cv2.connectedComponents(changed, connectivity=8)
    starts, stays, lasts = np.zeros((3, count), np.bool_)
    for into, cells in ((starts, squared >= start), (stays, squared >= stay), (lasts, before)):
        into[labels[cells]] = True
    contact = (starts | (stays & lasts)) & (np.bincount(labels.ravel(), minlength=count) >= least)
    contact[0] = False
    found[:] = contact[labels]
    return int(found.sum())
