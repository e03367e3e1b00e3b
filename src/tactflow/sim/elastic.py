"""The force of an indenter on the simulated gel by a linear-elastic law, to test fits of the force.

The gel is a bed of springs on which shear acts apart from pressure (Winkler): where it is in contact, each
bit of it pushes back in proportion to how far it has sunk, and drags back in proportion to how far it moved.
What a calibration sees is not of this form: its heights come from colours, its outline from a threshold, and
its shear from a few dots.

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
"""Millimetres per raw pixel that the simulated gel is given: its balls have a radius of 2.375 mm."""
STIFFNESS: Final = 1.0
"""Pressure per depth, N/mm^3: a layer of 3 mm of a gel whose constrained modulus is 3 N/mm^2. By hand."""
SHEAR_STIFFNESS: Final = 0.1
"""Traction per displacement along the gel, N/mm^3. Chosen by hand."""
_STEP: Final = 3.0
"""Distance of the points at which pressure and traction are computed, px. Chosen by hand: half of it changes
the force by less than 0.2 %."""


def force(presses: Sequence[Press]) -> tuple[float, float, float]:
    """(x, y, z), N, by which all indenters act on the gel: x right and y down in the gel, z presses.

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
        # Gel that is here now was where its displacement here, to first order, says.
        moved = displacement(presses, points - displacement(presses, points))
        total[:2] += SHEAR_STIFFNESS * MM * area * moved.sum(axis=0)
        total[2] += STIFFNESS * MM * area * float(surface(press, depth)[touched].sum())
    return float(total[0]), float(total[1]), float(total[2])
