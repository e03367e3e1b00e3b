"""The force of an indenter on the simulated gel, to test force calibration.

The gel is a linear-elastic bed of springs with independent pressure and shear (Winkler): in contact, normal
pressure is proportional to depth, and traction to displacement. The inputs of a calibration differ from this
model: its heights come from colours, its outline from a threshold, and its shear from a few dots.

References
----------
K. L. Johnson, Contact Mechanics (1985), ch. 4.3 and 8.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from tactflow.sim.gel import Press, displacement, reached, surface

MM: Final = 0.025
"""Millimetres per raw pixel of the simulated gel: its balls have a radius of 2.375 mm."""
STIFFNESS: Final = 1.0
"""Pressure per depth, N/mm^3: a 3 mm layer with a constrained modulus of 3 N/mm^2. Chosen by hand."""
SHEAR_STIFFNESS: Final = 0.1
"""Traction per displacement along the gel, N/mm^3. Chosen by hand."""
_STEP: Final = 3.0
"""Grid spacing for pressure and traction, px. Chosen by hand: halving it changes the force by less than 0.2
%."""


def force(presses: Sequence[Press]) -> tuple[float, float, float]:
    """Total force (x, y, z), N, of the indenters on the gel: x right, y down, z into the gel.

    >>> force(())
    (0.0, 0.0, 0.0)
    """
    total = np.zeros(3)
    area = (_STEP * MM) ** 2
    for press in presses:
        if not press.touching:
            continue
        side = np.arange(-press.shape.reach, press.shape.reach + _STEP, _STEP)
        x, y = (part.astype(np.float32) for part in np.meshgrid(press.x + side, press.y + side))
        depth = reached(press, x, y)
        touched = depth > press.sink * press.depth
        points = np.stack([x[touched], y[touched]], axis=1).astype(np.float64)
        # First-order inverse of the displacement.
        moved = displacement(presses, points - displacement(presses, points))
        total[:2] += SHEAR_STIFFNESS * MM * area * moved.sum(axis=0)
        total[2] += STIFFNESS * MM * area * float(surface(press, depth)[touched].sum())
    return float(total[0]), float(total[1]), float(total[2])
