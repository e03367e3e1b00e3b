"""Calibration of a sensor: from pixels to millimetres, depth and force.

`file` is the calibration file; `scale` finds millimetres per pixel, `presses` finds presses of a
ball in results, `photometric` learns from them which slope of the gel has which colour, and `force` how the
force follows from a contact. `session` makes a calibration of them, `check` tests one. Nothing here runs a
pipeline: results come in, numbers go out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

KINDS: Final = Path(__file__).parent / "kinds"
"""Folder of the default calibrations, one for each kind of sensor, that come with the package."""


def kinds() -> list[str]:
    """Names of the kinds of sensors that the package has a default calibration for."""
    return sorted(path.stem for path in KINDS.glob("*.yaml"))
