"""Encoding of a frame for the page, with compact markers and height maps.

Marker coordinates are rounded to tenths of a pixel, and height maps reduced to the resolution of the screen.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
import orjson
from numpy.typing import NDArray

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.drawing.results import dimmed, field_arrows
from tactflow.message.fields import STATUS_NAMES
from tactflow.message.result import Result, encode_message
from tactflow.ports import Image, Valid
from tactflow.vision.types import Depth, Markers

STATUS_LETTERS: Final = np.array([ord(name[0]) for name in STATUS_NAMES], np.uint8)
"""The first letter of the word for each value of `MarkerStatus`."""
MAX_CELLS: Final = 96
"""Maximum number of cells along the longer side of a surface: its panel is about 600 px wide."""
MIN_CELL_PX: Final = 2.0
"""Minimum side of a cell, px: heights are computed at half the resolution of the picture."""
HEIGHT_LEVELS: Final = 65535
"""Quantisation steps from 0 to the greatest height; 255 would show as terraces on the shaded surface."""
FIELD_ARROW_SPACING_PX = 14.0
"""Spacing of the arrows of a displacement field in a picture of 400 px, px. Chosen by hand."""


def encode_packet(
    result: Result,
    valid: Valid | None,
    *,
    latency_ms: float,
    guide: Mapping[str, Any] | None,
    quality: int,
    max_size: int,
) -> tuple[bytes, bytes]:
    """The header, JSON without its closing brace, and the heights of a surface followed by the JPEG picture.

    The picture is dimmed outside the gel; the page draws the results over it.

    latency_ms : since capture; -1 if unknown.
    guide : state of a guided session. max_size : of the longer side of the picture, px.
    """
    contact, markers, scale = result.contact, result.markers, result.scale
    if contact is not None:
        contact = dataclasses.replace(contact, hull=np.round(contact.hull, 1), separate=())
    image = result.frame.image if result.image is None else result.image
    arrows, surface, heights = b"null", b"null", b""
    if result.field is not None:
        spacing = FIELD_ARROW_SPACING_PX * max(1.0, max(image.shape) / 400)
        arrows = compact_markers(field_arrows(result.field, spacing))
    if result.depth is not None:
        surface, heights = compact_surface(result.depth)
    parts = {
        b"latency_ms": b"%.3f" % latency_ms,
        b"epoch": b"%d" % result.frame.epoch,
        b"message": encode_message(result.replace(contact=contact, markers=None), detail=True),
        b"markers": b"null" if markers is None else compact_markers(markers),
        b"scale": b"null" if scale is None else b"[%.8g,%.8g]" % (scale.x, scale.y),
        b"field": arrows,
        b"surface": surface,
        b"guide": orjson.dumps(guide),
    }
    header = b"{" + b",".join(b'"%b":%b' % part for part in parts.items())
    picture = _reduced(image if valid is None else dimmed(image, valid), max_size)
    return header, heights + encode_jpeg(picture, quality)


def _reduced(image: Image, max_size: int) -> Image:
    height, width = image.shape[:2]
    factor = max_size / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def compact_markers(markers: Markers) -> bytes:
    """Encode markers as JSON: x0, y0, x1, ... in tenths of a pixel, and the first letter of each status.

    >>> origin = np.array([[10.0, 20.0]])
    >>> compact_markers(Markers(origin, origin + 1.25, np.zeros(1, np.uint8), np.zeros(1)))
    b'{"origin":[100,200],"position":[112,212],"status":"t"}'
    """

    def tenths(points: NDArray[np.float64]) -> NDArray[np.int32]:
        return np.rint(points * 10).astype(np.int32).ravel()

    return orjson.dumps(
        {
            "origin": tenths(markers.origin),
            "position": tenths(markers.position),
            "status": STATUS_LETTERS[markers.status].tobytes().decode(),
        },
        option=orjson.OPT_SERIALIZE_NUMPY,
    )


def compact_surface(depth: Depth) -> tuple[bytes, bytes]:
    """Encode a height map as a JSON header and binary heights.

    Returns
    -------
    header : JSON with `box`, (x, y, width, height) of the non-zero part, px; `size`, (columns, rows) of its
        cells; `step`, mm; `bytes`, length of the heights.
    heights : of the cells in steps, row by row, little-endian uint16.

    >>> heights = np.zeros((40, 60), np.float32)
    >>> heights[10:20, 30:50] = 0.65535
    >>> header, data = compact_surface(Depth(heights, 0.65535, None, 1.0, None))
    >>> header
    b'{"box":[30,10,20,10],"size":[10,5],"step":1e-05,"bytes":100}'
    """
    x, y, width, height = cv2.boundingRect((depth.heights > 0).view(np.uint8))
    if not width:
        return b"null", b""
    side = max(MIN_CELL_PX, max(width, height) / MAX_CELLS)
    columns, rows = math.ceil(width / side), math.ceil(height / side)
    part = depth.heights[y : y + height, x : x + width]
    cells = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)
    step = float(cells.max()) / HEIGHT_LEVELS
    data = np.rint(cells * np.float32(1 / step)).astype("<u2").tobytes()
    header = b'{"box":[%d,%d,%d,%d],"size":[%d,%d],"step":%.8g,"bytes":%d}'
    return header % (x, y, width, height, columns, rows, step, len(data)), data
