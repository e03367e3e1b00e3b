"""Pictures of the results, for people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.drawing.lettering import Lettering
from tactflow.drawing.relief import colour_bar, normals_picture, relief
from tactflow.vision.flow import DisplacementField, inside_mask
from tactflow.vision.types import Contact, Depth, Flow, Markers, MarkerStatus, Scale

View = Literal["frame", "contact", "depth", "normals"]
Colour = tuple[int, int, int]

YELLOW: Final[Colour] = (0, 255, 255)
WHITE: Final[Colour] = (255, 255, 255)
GRAY: Final[Colour] = (120, 120, 120)
PALE: Final[Colour] = (200, 200, 200)
GREEN: Final[Colour] = (90, 230, 60)
ORANGE: Final[Colour] = (40, 150, 255)
MAGENTA: Final[Colour] = (255, 120, 255)
DARK: Final[Colour] = (25, 25, 25)
"""Colours, blue, green, red."""

_SUBPIXEL_BITS: Final = 4
"""Binary digits after the point in drawing coordinates, which are exact to 1/16 px."""
_MAX_COORDINATE_PX: Final = 1e5
"""Largest drawing coordinate, px: far outside any picture, and within 32 bits with `_SUBPIXEL_BITS`
digits."""
_UNIT_SIDE_PX: Final = 300
"""Shorter side of a picture, px, up to which everything is drawn at the sizes below; they grow with larger
pictures. It and all sizes below are chosen by how the pictures look."""
_DIMMING_FACTOR: Final = 3
"""How many times darker a place without gel is shown."""
_LINE_WIDTH_PX, _DARK_LINE_WIDTH_PX, _HALO_WIDTH_PX = 1.2, 2.6, 1.4
"""Widths of a line and of the dark line below it, and by how much the dark arrow is wider, px."""
_MIN_ARROW_PX: Final = 2.0
"""Length below which an arrow is a dot, px."""
_ARROW_HEAD: Final = (0.45, 5.0)
"""Length of an arrow's head as a fraction of the arrow, and its maximum, px."""
_AXIS_OVERHANG_PX: Final = 14
"""Length of the principal axis beyond the hull, px."""
_CENTROID_RADII_PX: Final = (4.0, 2.8)
"""Radii of the dark and of the coloured dot on the centroid, px."""
_TEXT_SIZE_PX, _LINE_SPACING_PX = 11, 14
"""Size of the text, and distance of its lines, px."""
_COLOUR_BAR_PX: Final = (70, 6)
"""Width and height of the bar that explains the colours of heights, px."""
_VIEW_MARGIN_PX: Final = 8
"""How far outside the contact the "contact" view reaches, px. Chosen by hand."""
_MIN_ARROW_SPACING_PX: Final = 12.0
"""Minimum distance of the arrows of a field, px."""
_STATUS_COLOURS: Final = (
    (MarkerStatus.LOST, GRAY),
    (MarkerStatus.INFERRED, WHITE),
    (MarkerStatus.TRACKED, YELLOW),
)
"""Colours of the arrows, in drawing order: the most certain ones are on top."""


def dimmed(image: NDArray[np.uint8], valid: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture, (H, W, 3) uint8, darkened where `valid`, (H, W) uint8, is 0: where there is no gel.

    Returns the same array if gel is everywhere. Raises ValueError if `valid` is not of the picture's size.

    >>> dimmed(np.full((1, 2, 3), 90, np.uint8), np.array([[255, 0]], np.uint8))[0, :, 0].tolist()
    [90, 30]
    """
    if valid.shape != image.shape[:2]:
        raise ValueError(f"required valid of shape {image.shape[:2]}, got {valid.shape}")
    if valid.all():
        return image
    return np.where(valid[:, :, None] == 0, image // _DIMMING_FACTOR, image)


class Annotator:
    """Draws contact, markers and flow on a copy of the processed frame.

    Arrows are yellow for tracked markers, white for inferred ones, dim gray for lost ones. The hull is green,
    the principal axis orange with a dot on the centroid and its angle beside it.

    Raises ValueError for values out of range. Not to be shared between threads: it owns a font with a cache.

    Parameters
    ----------
    arrow_scale : length of an arrow over the displacement it shows; 1 ends it where the marker is now.
    view : "frame" shows the whole frame; "contact" only the contact and the arrows inside it, the rest
        black; "depth" the height map instead of the picture.
    text : whether numbers are written.
    deepest : mm, for the "depth" view: height of the lightest colour.

    Examples
    --------
    >>> image = np.zeros((300, 400, 3), np.uint8)
    >>> hull = np.array([[100.0, 100], [200, 100], [200, 180]])
    >>> contact = Contact(4000.0, (166.0, 127.0), -38.7, 0.8, hull, None)
    >>> picture = Annotator(text=False)(image, contact=contact)
    >>> bool(picture[100, 150].any())
    True
    """

    def __init__(
        self,
        *,
        arrow_scale: float = 3.0,
        view: View = "frame",
        text: bool = True,
        deepest: float = 1.0,
    ) -> None:
        if view not in get_args(View):
            raise ValueError(f"required view to be one of {', '.join(get_args(View))}, got {view!r}")
        if not (0 <= arrow_scale < math.inf and 0 < deepest < math.inf):
            raise ValueError(
                f"required finite arrow_scale >= 0 and deepest > 0 mm, got {arrow_scale} and {deepest}"
            )
        self._arrow_scale = arrow_scale
        self._view = view
        self._text = text
        self._deepest = deepest
        self._letters = Lettering()

    def __call__(
        self,
        image: NDArray[np.uint8],
        *,
        contact: Contact | None = None,
        flow: Flow | None = None,
        markers: Markers | None = None,
        contact_mask: NDArray[np.uint8] | None = None,
        valid: NDArray[np.uint8] | None = None,
        field: DisplacementField | None = None,
        depth: Depth | None = None,
        scale: Scale | None = None,
        normals: NDArray[np.float32] | None = None,
    ) -> NDArray[np.uint8]:
        """A new picture of the size of `image`, with these results drawn on it.

        image : (H, W, 3) uint8 BGR. contact_mask : (H, W) uint8, needed by the "contact" view alone.
        valid : (H, W) uint8, 0 where no gel is, which is shown darker. depth, scale : for the "depth" view;
        without the first the gel lies flat, without both there is no calibration. normals : (H, W, 3)
        float32, for the "normals" view; without them the gel lies flat.
        Returns (H, W, 3) uint8; the inputs stay as they are. Raises ValueError on another shape.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"required a (H, W, 3) uint8 image, got {image.shape} {image.dtype}")
        if self._view == "contact":
            shown, picture = self._shown(image, contact_mask), np.zeros_like(image)
            cv2.copyTo(image, shown, picture)
            if markers is not None:
                markers = _inside(markers, shown)
        elif self._view == "depth":
            picture = self._heights(image, depth, scale)
        elif self._view == "normals":
            flat = np.zeros(image.shape, np.float32) + np.array([0, 0, 1], np.float32)
            picture = normals_picture(flat if normals is None else normals)
        else:
            picture = (image if valid is None else dimmed(image, valid)).copy()
        unit = max(1.0, min(image.shape[:2]) / _UNIT_SIDE_PX)
        if contact is not None and len(contact.hull):
            _strokes(picture, [contact.hull], DARK, _DARK_LINE_WIDTH_PX * unit, closed=True)
            _strokes(picture, [contact.hull], GREEN, _LINE_WIDTH_PX * unit, closed=True)
        if field is not None:
            between = field_arrows(field, _MIN_ARROW_SPACING_PX * unit)
            if self._view == "contact":
                between = _inside(between, shown)
            draw_arrows(picture, between, self._arrow_scale, unit)
        if markers is not None:
            draw_arrows(picture, markers, self._arrow_scale, unit)
        if contact is not None:
            self._axis(picture, contact, unit)
        if self._text:
            lines = self._lines(contact, flow, markers)
            if self._view == "depth":
                lines.append(_depth_line(depth, scale))
                self._bar(picture, unit)
            self._write(picture, lines, unit)
        return picture

    def _heights(
        self, image: NDArray[np.uint8], depth: Depth | None, scale: Scale | None
    ) -> NDArray[np.uint8]:
        if depth is None or scale is None:
            return relief(np.zeros(image.shape[:2], np.float32), Scale(1, 1, (0, 0), (0, 0)), self._deepest)
        if depth.heights.shape != image.shape[:2]:
            raise ValueError(f"required heights of shape {image.shape[:2]}, got {depth.heights.shape}")
        return relief(depth.heights, scale, self._deepest)

    def _bar(self, picture: NDArray[np.uint8], unit: float) -> None:
        """The colour scale of heights, in the lower left corner."""
        width, height = (round(side * unit) for side in _COLOUR_BAR_PX)
        left, bottom = round(6 * unit), picture.shape[0] - round(6 * unit)
        if left + width >= picture.shape[1] or bottom - height < 0:
            return
        picture[bottom - height : bottom, left : left + width] = colour_bar(width, height)
        cv2.rectangle(picture, (left - 1, bottom - height - 1), (left + width, bottom), WHITE, 1)
        place = (left + width + round(4 * unit), bottom)
        self._letters.write(picture, f"{self._deepest:g} mm", place, WHITE, round(_TEXT_SIZE_PX * unit))

    def _shown(self, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        """(H, W): the contact and a margin around it."""
        if mask is None:
            return np.zeros(image.shape[:2], np.uint8)
        if mask.shape != image.shape[:2] or mask.dtype != np.uint8:
            raise ValueError(
                f"required a contact_mask of shape {image.shape[:2]} uint8, got {mask.shape} {mask.dtype}"
            )
        side = 2 * _VIEW_MARGIN_PX + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        return np.asarray(cv2.dilate(mask, disc), np.uint8)

    def _axis(self, picture: NDArray[np.uint8], contact: Contact, unit: float) -> None:
        center = np.array(contact.center)
        if contact.angle is not None:
            theta = math.radians(contact.angle)
            along = np.array([math.cos(theta), -math.sin(theta)])
            spread = (contact.hull - center) @ along
            overhang = _AXIS_OVERHANG_PX * unit
            ends = center + along * [[spread.min() - overhang], [spread.max() + overhang]]
            _strokes(picture, [ends], DARK, _DARK_LINE_WIDTH_PX * unit)
            _strokes(picture, [ends], ORANGE, _LINE_WIDTH_PX * unit)
        for colour, radius in zip((DARK, ORANGE), _CENTROID_RADII_PX, strict=True):
            _dots(picture, center[None], colour, radius * unit)
        if self._text and contact.angle is not None:
            label = _signed(contact.angle, 1) + "°"
            x, y = ends[1] + along * 3 * unit
            self._halo_text(picture, label, (round(x), round(y + 4 * unit)), ORANGE, unit)

    def _lines(
        self, contact: Contact | None, flow: Flow | None, markers: Markers | None
    ) -> list[tuple[str, Colour]]:
        lines: list[tuple[str, Colour]] = []
        if contact is None:
            lines.append(("no contact", WHITE))
        else:
            x, y = contact.center
            lines.append((f"contact {contact.area:.0f} px²  at {x:.1f}, {y:.1f}", GREEN))
        if flow is not None and flow.mean is not None:
            right, down = flow.mean
            plural = "" if flow.count == 1 else "s"
            mean = f"flow {_signed(right, 2)}, {_signed(down, 2)} px"
            lines.append((f"{mean}  ({flow.count} marker{plural})", YELLOW))
            if flow.rotation is not None and flow.divergence is not None:
                twist = f"twist {_signed(flow.rotation, 1)}°"
                lines.append((f"{twist}  spread {_signed(100 * flow.divergence, 1)} %", YELLOW))
        if markers is not None:
            lost = int(np.count_nonzero(markers.status == MarkerStatus.LOST))
            if lost:
                lines.append((f"{lost} lost", PALE))
        return lines

    def _write(self, picture: NDArray[np.uint8], lines: Sequence[tuple[str, Colour]], unit: float) -> None:
        size = round(_TEXT_SIZE_PX * unit)
        step = round(_LINE_SPACING_PX * unit)
        height = picture.shape[0]
        longest = max((self._letters.size(picture, text, size)[0] for text, _ in lines), default=0)
        bar: NDArray[Any] = picture[: min(height, step * len(lines) + round(5 * unit)), : longest + step]
        bar[...] = bar // 3
        for index, (text, colour) in enumerate(lines):
            place = (round(5 * unit), round(2 * unit) + step * (index + 1) - round(3 * unit))
            self._letters.write(picture, text, place, colour, size)

    def _halo_text(
        self, picture: NDArray[np.uint8], text: str, place: tuple[int, int], colour: Colour, unit: float
    ) -> None:
        """Text kept inside the picture, on a shade."""
        size = round(_TEXT_SIZE_PX * unit)
        height, width = picture.shape[:2]
        wide, tall = self._letters.size(picture, text, size)
        x = min(max(place[0], 2), max(2, width - wide - 3))
        y = min(max(place[1], tall + 2), max(tall + 2, height - 3))
        shade: NDArray[Any] = picture[max(0, y - tall - 1) : y + 3, max(0, x - 2) : x + wide + 3]
        shade[...] = shade // 3
        self._letters.write(picture, text, (x, y), colour, size)


def _inside(markers: Markers, mask: NDArray[np.uint8]) -> Markers:
    keep = inside_mask(markers.position, mask)
    return Markers(markers.origin[keep], markers.position[keep], markers.status[keep], markers.stderr[keep])


def _depth_line(depth: Depth | None, scale: Scale | None) -> tuple[str, Colour]:
    if depth is not None:
        return (f"{depth.greatest:.2f} mm deep  {depth.volume:.2f} mm³", WHITE)
    return ("no calibration" if scale is None else "0 mm deep", PALE)


def field_arrows(field: DisplacementField, distance: float) -> Markers:
    """Points of a displacement field for `draw_arrows`, inferred as markers are from their neighbours.

    distance : of two points at least, px. Returns as many rows and columns of the grid as fit.

    >>> from tactflow.vision.flow import FieldModel
    >>> origin = np.array([[20.0, 20], [60, 20], [20, 60], [60, 60]])
    >>> markers = Markers(origin, origin + 1, np.zeros(4, np.uint8), np.full(4, 0.02))
    >>> len(field_arrows(FieldModel(origin, (80, 80))(markers), 20.0).origin)
    16
    """
    step = max(1, math.ceil(distance / field.grid.spacing))
    chosen = (slice(step // 2, None, step),) * 2
    origin = field.grid.points[chosen].reshape(-1, 2)
    moved = field.displacement[chosen].reshape(-1, 2)
    status = np.full(len(origin), MarkerStatus.INFERRED, np.uint8)
    return Markers(origin, origin + moved, status, np.full(len(origin), np.nan))


def draw_arrows(picture: NDArray[np.uint8], markers: Markers, scale: float = 1.0, unit: float = 1.0) -> None:
    """Draw every marker's displacement into `picture`, from its origin, to 1/16 px.

    picture : (H, W, 3) uint8, changed. scale : arrow length over displacement. unit : line width, px.
    Tracked markers are yellow, inferred white, lost dim gray; a displacement too short for a head is a dot.

    >>> picture = np.zeros((40, 60, 3), np.uint8)
    >>> origin = np.array([[10.0, 20.0]])
    >>> draw_arrows(picture, Markers(origin, origin + [30, 0], np.zeros(1, np.uint8), np.zeros(1)))
    >>> bool(picture[20, 25].any())
    True
    """
    for status, colour in _STATUS_COLOURS:
        chosen = markers.status == status
        if not chosen.any():
            continue
        tail = np.asarray(markers.origin[chosen], np.float64)
        moved = (np.asarray(markers.position[chosen], np.float64) - tail) * scale
        length = np.hypot(moved[:, 0], moved[:, 1])
        long = length >= _MIN_ARROW_PX * unit
        along = moved[long] / length[long, None]
        across = along[:, ::-1] * [-1.0, 1.0]
        tip = tail[long] + moved[long]
        back = np.minimum(_ARROW_HEAD[0] * length[long], _ARROW_HEAD[1] * unit)[:, None]
        neck = tip - along * back
        left, right = neck + across * back * 0.5, neck - across * back * 0.5
        shafts = np.stack([tail[long], neck], axis=1)
        heads = np.stack([tip, left, right], axis=1)
        for paint, extra in ((DARK, _HALO_WIDTH_PX * unit), (colour, 0.0)):
            if status == MarkerStatus.LOST and extra:
                continue
            _strokes(picture, shafts, paint, _LINE_WIDTH_PX * unit + extra)
            if extra:
                _strokes(picture, heads, paint, extra, closed=True)
            _fill(picture, heads, paint)
            _dots(picture, tail[~long], paint, _LINE_WIDTH_PX * unit + extra / 2)


def _fixed(points: NDArray[Any]) -> NDArray[np.int32]:
    fixed: NDArray[np.int32] = np.rint(
        np.clip(points, -_MAX_COORDINATE_PX, _MAX_COORDINATE_PX) * 2**_SUBPIXEL_BITS
    ).astype(np.int32)
    return fixed


def _strokes(
    picture: NDArray[np.uint8],
    lines: Sequence[NDArray[Any]] | NDArray[Any],
    colour: Colour,
    width: float,
    closed: bool = False,
) -> None:
    if len(lines):
        points = [_fixed(line) for line in lines]
        cv2.polylines(picture, points, closed, colour, max(1, round(width)), cv2.LINE_AA, _SUBPIXEL_BITS)


def _fill(picture: NDArray[np.uint8], polygons: NDArray[Any], colour: Colour) -> None:
    for polygon in _fixed(polygons):
        cv2.fillConvexPoly(picture, polygon, colour, cv2.LINE_AA, _SUBPIXEL_BITS)


def _dots(picture: NDArray[np.uint8], centers: NDArray[Any], colour: Colour, radius: float) -> None:
    for x, y in _fixed(centers).tolist():
        cv2.circle(
            picture,
            (x, y),
            round(radius * 2**_SUBPIXEL_BITS),
            colour,
            cv2.FILLED,
            cv2.LINE_AA,
            _SUBPIXEL_BITS,
        )


def _signed(value: float, digits: int) -> str:
    """A number with a true minus sign; no sign for what rounds to zero."""
    text = f"{abs(value):.{digits}f}"
    if float(text) == 0:
        return text
    return ("−" if value < 0 else "+") + text
