"""The types of ports between the built-in stages and sinks.

Besides these arrays and signals, `Frame` and the dataclasses of `tactflow.vision.types` (`Contact`,
`Markers`, `Flow`, ...) are port types; their port is named after them: `frame`, `contact`, `markers`, `flow`.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.ports import ArrayPort, SignalPort

Image = Annotated[NDArray[np.uint8], ArrayPort("image", ("H", "W", 3), "uint8", "grey levels, BGR")]
"""The processed frame."""

Valid = Annotated[NDArray[np.uint8], ArrayPort("valid", ("H", "W"), "uint8", "0 or 255")]
"""255 where the picture shows gel, 0 on a black or saturated surround; the same array for a whole epoch."""

MarkerMask = Annotated[NDArray[np.uint8], ArrayPort("marker_mask", ("H", "W"), "uint8", "0 or 255")]
"""255 where a marker covers the gel."""

Unmarked = Annotated[NDArray[np.uint8], ArrayPort("unmarked", ("H", "W", 3), "uint8", "grey levels, BGR")]
"""The processed frame without its markers."""

Untouched = Annotated[NDArray[np.uint8], ArrayPort("untouched", ("H", "W", 3), "uint8", "grey levels, BGR")]
"""The untouched gel without its markers; the same array for a whole epoch."""

ContactMask = Annotated[NDArray[np.uint8], ArrayPort("contact_mask", ("H", "W"), "uint8", "0 or 255")]
"""255 where something touches the gel: within the outer edge of its imprint."""

CoreMask = Annotated[NDArray[np.uint8], ArrayPort("core_mask", ("H", "W"), "uint8", "0 or 255")]
"""255 where the gel clings to what touches it, inside the contact mask; 0 where that is not known."""

Deviations = Annotated[NDArray[np.float32], ArrayPort("deviations", (2, "h", "w"), "float32", "variances")]
"""Squared change of each cell of 4 x 4 px, of its light and of its colour alone, in variances of noise. On a
gray camera, the second is that of the light minus its mean nearby."""

Picture = Annotated[NDArray[np.uint8], ArrayPort("annotated", ("H", "W", 3), "uint8", "grey levels, BGR")]
"""The processed frame with the results drawn on it."""

Gradients = Annotated[NDArray[np.float32], ArrayPort("gradients", ("H", "W", 2), "float32", "slope")]
"""Slope of the indentation to the right and down, mm per mm, for each pixel."""

Normals = Annotated[NDArray[np.float32], ArrayPort("normals", ("H", "W", 3), "float32", "unit vectors")]
"""Normals of the gel's surface out of the gel, x right, y down; (0, 0, 1) where it is at rest."""

Touching = Annotated[bool, SignalPort("touching", closed="no_contact")]
"""True while something touches the gel."""

Slipping = Annotated[bool, SignalPort("slipping", closed="no_slip")]
"""True while what touches the gel slides over it."""

Changed = Annotated[bool, SignalPort("changed", closed="unchanged", otherwise="repeat")]
"""True when anything may have moved by more than its tolerance since the last processed frame."""

Suspect = Annotated[bool, SignalPort("suspect", closed="at_rest", otherwise="repeat")]
"""True when the contact may differ from that in the last fully processed frame."""

Held = Annotated[bool, SignalPort("held", closed=None)]
"""Another signal, extended in time."""


class ContactPorts(NamedTuple):
    """The outputs of a stage that detects contact.

    Attributes
    ----------
    contact_mask : 255 in contact.
    touching : whether anything is.
    """

    contact_mask: ContactMask
    touching: Touching
