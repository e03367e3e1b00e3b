"""The surface as a part of the page that may be turned."""

from __future__ import annotations

import base64
from importlib.resources import files
from string import Template
from typing import Final

import numpy as np

from tactflow.tools.page import Html
from tactflow.vision.arrays import Floats

from .ply import MAX_MEDIANS, RAMP, error_colours
from .surface import Points

MAX_POINTS: Final = 60_000
"""Largest number of points of the page: a megabyte, which is drawn in a tenth of a second."""
RANGE: Final = 32_767
"""Half of the surface's largest side, in the integers that places are written as."""


def viewer(points: Points, cell: float, axes: Floats) -> Html:
    """A fragment of a page. cell : distance of points, mm. axes : (3, 3), directions to the right, downwards
    and away from the viewer at first."""
    every = -(-len(points) // MAX_POINTS)
    shown = points.at(np.arange(0, len(points), every))
    low, high = shown.place.min(axis=0), shown.place.max(axis=0)
    unit = max(float((high - low).max()) / 2, cell) / RANGE
    parts = (
        np.rint((shown.place - (low + high) / 2) / unit).astype("<i2"),
        np.rint(127 * shown.normal).astype("i1"),
        error_colours(shown),
    )
    template = Template(files("tactflow.plugins.map").joinpath("viewer.html").read_text(encoding="utf-8"))
    colours = [f"rgb({', '.join(f'{255 * part:.0f}' for part in colour)})" for colour in np.transpose(RAMP)]
    return Html(
        template.substitute(
            data=base64.b64encode(b"".join(part.tobytes() for part in parts)).decode(),
            axes=np.round(axes, 6).tolist(),
            cell=f"{cell * np.sqrt(every) / unit:.1f}",
            ramp=", ".join(colours),
            most=f"{MAX_MEDIANS * np.median(shown.error):.3f}",
        )
    )
