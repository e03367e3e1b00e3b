"""The features of touch in a LeRobot dataset: their names, and their values in a frame.

The layout of `points` is that of the open proposal for a tactile module in LeRobot
(https://github.com/huggingface/lerobot/pull/4469), that of `window` the way its users store sensors that are
faster than the video (https://github.com/huggingface/lerobot/issues/2421).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from tactflow.engine.frame import Absent
from tactflow.vision.types import MarkerStatus

if TYPE_CHECKING:
    from tactflow.message.episodes import AlignedMarkers
    from tactflow.message.result import Result

TACTILE_FEATURE: Final = "observation.tactile"
"""Beginning of the names of all features of touch."""
PIXEL_NUMBERS: Final = {
    "contact": ["touching", "x", "y", "area", "angle"],
    "flow": ["known", "dx", "dy"],
}
"""Feature -> names of its numbers, in px. All numbers are 0 where the first is 0."""
CALIBRATED_NUMBERS: Final = PIXEL_NUMBERS | {
    "contact_mm": ["touching", "x_mm", "y_mm", "area_mm2"],
    "flow_mm": ["known", "dx_mm", "dy_mm"],
    "depth": ["known", "depth_mm", "volume_mm3"],
    "force": ["known", "z_N", "in_range"],
    "drag": ["known", "x_N", "y_N"],
    "pose": ["known", "x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"],
}
"""The same for a sensor with any calibration."""
FORCES: Final = ("Fx_N", "Fy_N", "Fz_N")
"""Force on a marker, which is never known: tactflow measures the force on the whole gel."""


def numbers(result: Result) -> dict[str, list[float]]:
    """The numbers of each feature of a frame, in the order of their names; all 0 if unknown."""
    names = PIXEL_NUMBERS if result.scale is None else CALIBRATED_NUMBERS
    known = _known_numbers(result)
    return {
        name: [1.0, *map(float, known[name])] if name in known else [0.0] * len(names[name]) for name in names
    }


def _known_numbers(result: Result) -> dict[str, Sequence[float]]:
    """The numbers behind the first one of each feature that is known in this frame."""
    contact, depth, force, scale = result.contact, result.depth, result.force, result.scale
    mean = None if result.flow is None else result.flow.mean
    known: dict[str, Sequence[float]] = {}
    if mean is not None:
        known["flow"] = mean
    if contact is not None:
        known["contact"] = [*contact.center, contact.area, math.radians(contact.angle or 0.0)]
    if scale is None:
        return known
    if contact is not None:
        known["contact_mm"] = [*scale.point(contact.center), scale.area(contact.area)]
    if mean is not None:
        known["flow_mm"] = scale.vector(mean)
    if depth is not None:
        known["depth"] = [depth.greatest, depth.volume]
    if force is not None:
        x, y, z = force.value
        known["force"] = [z, force.in_range]
        if x is not None and y is not None:
            known["drag"] = [x, y]
    if result.pose is not None and result.pose.status == "tracked":
        known["pose"] = [*result.pose.translation, *result.pose.rotation]
    return known


def marker_features(
    sensor: str, markers: AlignedMarkers, result: Result | None = None
) -> dict[str, NDArray[Any]]:
    """The features of N markers.

    Parameters
    ----------
    sensor : its name.
    markers : of the frame.
    result : of the frame, with the scale and the depth; None for a frame in which nothing is known.
    """
    prefix = f"{TACTILE_FEATURE}.{sensor}"
    points = marker_points(markers, result)
    return {
        f"{prefix}.marker_offset": markers.offset,
        f"{prefix}.marker_status": markers.status,
        f"{prefix}.points": points,
        f"{prefix}.points_mask": np.isfinite(points),
    }


def marker_points(markers: AlignedMarkers, result: Result | None) -> NDArray[np.float64]:
    """Displacement of and force on each marker, NaN where unknown.

    Everything is unknown for a lost marker. The surface of the gel under a marker stands for its height.

    Returns
    -------
    (N, 6) float64: dx, dy, dz in mm, right, down and out of the gel, so that dz is negative where the gel is
    pushed in; Fx, Fy, Fz in N. Without a calibration, dx and dy are in px, and dz is unknown.
    """
    points = np.full((len(markers.offset), 6), np.nan)
    if result is None:
        return points
    scale = result.scale
    points[:, :2] = markers.offset * ((1.0, 1.0) if scale is None else (scale.x, scale.y))
    if result.depth is not None:
        rows_columns = (markers.origin + markers.offset)[:, ::-1].T
        heights = result.depth.heights.astype(np.float64)
        points[:, 2] = -map_coordinates(heights, rows_columns, order=1, mode="constant", cval=np.nan)
    elif scale is not None and result.get("depth") == Absent("no_contact"):
        points[:, 2] = 0.0
    points[markers.status == MarkerStatus.LOST] = np.nan
    return points


class Window:
    """The numbers of the results between two frames of the dataset, for sensors faster than its rate.

    >>> from tactflow.engine.frame import Frame
    >>> from tactflow.message.result import Result
    >>> image, window = np.zeros((4, 4, 3), np.uint8), Window()
    >>> results = [Result(Frame("main", seq, seq / 100, image)) for seq in range(3)]
    >>> _ = list(window.remember(results))
    >>> [row[:2] for row in window.take(0.01)], len(window.take(0.02))
    ([[1.0, -0.01], [1.0, 0.0]], 1)
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[float, list[float]]] = deque()

    def remember(self, results: Iterable[Result]) -> Iterator[Result]:
        """Yield the results and remember their numbers; forget those of an earlier recording."""
        self._recent.clear()
        for result in results:
            self._recent.append((result.t, [number for row in numbers(result).values() for number in row]))
            yield result

    def take(self, end: float) -> list[list[float]]:
        """The numbers of each result that was not taken yet and not captured after `end`, s, oldest first.

        Each begins with 1, for known, and its time relative to `end`, s.
        """
        rows = []
        while self._recent and self._recent[0][0] <= end:
            t, row = self._recent.popleft()
            rows.append([1.0, t - end, *row])
        return rows


def padded_window(rows: list[list[float]], length: int, columns: int) -> NDArray[np.float64]:
    """The last rows of a window, newest last; those that are missing are 0.

    >>> padded_window([[1.0, 2.0]], 2, 2)
    array([[0., 0.],
           [1., 2.]])
    """
    padded = np.zeros((length, columns))
    if rows:
        newest = rows[-length:]
        padded[-len(newest) :] = newest
    return padded


def description(name: str, value: NDArray[Any], *, calibrated: bool) -> dict[str, Any]:
    """The description of a feature in `meta/info.json`.

    Parameters
    ----------
    name : of the feature.
    value : of it in any frame.
    calibrated : whether the sensor has a calibration.
    """
    dtype = "float32" if value.dtype.kind == "f" else value.dtype.name
    ending = name.rpartition(".")[2]
    if ending in CALIBRATED_NUMBERS:
        return {"dtype": dtype, "shape": [len(value)], "names": CALIBRATED_NUMBERS[ending]}
    names = CALIBRATED_NUMBERS if calibrated else PIXEL_NUMBERS
    components = {
        "marker_offset": ["dx_px", "dy_px"],
        "marker_status": ["0 tracked, 1 inferred, 2 lost"],
        "points": [*(["dx_mm", "dy_mm"] if calibrated else ["dx_px", "dy_px"]), "dz_mm", *FORCES],
        "points_mask": ["known"],
        "window": ["known", "t_s", *(f"{part}.{number}" for part in names for number in names[part])],
    }[ending]
    return {"dtype": dtype, "shape": list(value.shape), "names": {"components": components}}
