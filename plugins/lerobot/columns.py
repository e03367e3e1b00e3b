"""One sensor in a LeRobot dataset: its columns, their descriptions and their statistics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import StageError
from tactflow.message.episodes import MarkerOrder, Moments

from .features import TACTILE_FEATURE, Window, description, marker_features, numbers, padded_window

if TYPE_CHECKING:
    from tactflow.message.result import Result

PICTURE_PREFIX = "observation.images."
WINDOW_ROWS = "window rows"
"""Key of a row of the table under which its window is kept until the length of all windows is known."""
STATISTICS_STEP_FRAMES = 10
"""Every 10th picture counts for the statistics. Chosen by hand."""

Row = dict[str, Any]


class SensorColumns:
    """The columns of one sensor.

    Parameters
    ----------
    video : whether pictures are stored as a video, outside of the table.
    named : whether the names of all its numbers contain that of the sensor.

    Attributes
    ----------
    camera : name of the column of its pictures; empty before the first.
    shape : (H, W, 3), of its pictures.
    features : name of a column -> its description; empty before the first episode is complete.
    """

    def __init__(self, *, video: bool, named: bool) -> None:
        self.camera = self._kind = ""
        self.shape: tuple[int, ...] = ()
        self.features: dict[str, dict[str, Any]] = {}
        self._is_video, self._is_named = video, named
        self._moments: dict[str, Moments] = {}
        self._order = MarkerOrder()
        self._window = Window()
        self._window_length = 0
        self._colors = Moments()
        self._sampled = 0

    def remember(self, results: Iterable[Result]) -> Iterator[Result]:
        """Yield the results of a recording, and remember their numbers for the windows."""
        return self._window.remember(results)

    def check(self, result: Result) -> NDArray[np.uint8]:
        """The picture of a result, if it matches the earlier ones.

        Raises
        ------
        StageError : there is none, or the sensor, the size or whether there is a calibration differ.
        """
        image = result.image
        if image is None:
            raise StageError("the pipeline makes no picture: it needs a stage preprocess")
        camera, size = f"{PICTURE_PREFIX}{result.sensor}", f"{image.shape[1]} x {image.shape[0]} pixels"
        calibrated = result.scale is not None
        kind = f"{camera}, {size}, with{'' if calibrated else 'out'} calibration"
        if not self._kind:
            self._kind, self.camera, self.shape = kind, camera, image.shape
        if kind != self._kind:
            raise StageError(f"{kind}; the earlier ones are {self._kind}: make two datasets")
        if self._is_video and (image.shape[0] % 2 or image.shape[1] % 2):
            raise StageError(f"pictures of {size}: a video needs even numbers; give --pictures png")
        return image

    def row(self, result: Result, image: NDArray[np.uint8], index: int) -> Row:
        """The columns of one frame. index : of the frame in its episode."""
        prefix = f"{TACTILE_FEATURE}.{result.sensor}" if self._is_named else TACTILE_FEATURE
        row: Row = {f"{prefix}.{name}": values for name, values in numbers(result).items()}
        row |= self._marker_row(result)
        window = self._window.take(result.t)
        # The first frame has none before it, though its sensor may run longer than the others.
        row[WINDOW_ROWS] = window if index else window[-1:]
        if index % STATISTICS_STEP_FRAMES == 0:
            self._colors.add(image.reshape(-1, 3)[:, ::-1] / 255.0)
            self._sampled += 1
        if not self._is_video:
            row[self.camera] = {"bytes": cv2.imencode(".png", image)[1].tobytes(), "path": None}
        return row

    def _marker_row(self, result: Result) -> dict[str, NDArray[Any]]:
        """The features of the markers; empty before the first frame with markers."""
        if result.markers is not None:
            return marker_features(result.sensor, self._order.align(result.markers), result)
        return {} if self._order.origin is None else marker_features(result.sensor, self._order.lost())

    def complete(self, rows: list[Row]) -> None:
        """Complete the features of every row of an episode, and add their values to the statistics.

        Raises
        ------
        StageError : this recording has markers, and those before had none.
        """
        sensor = self.camera.removeprefix(PICTURE_PREFIX)
        if self._order.origin is not None:
            lost = marker_features(sensor, self._order.lost())
            rows[:] = [lost | row for row in rows]
        self._complete_windows(rows, f"{TACTILE_FEATURE}.{sensor}.window")
        values = [
            {name: np.asarray(v) for name, v in row.items() if name.startswith(TACTILE_FEATURE)}
            for row in rows
        ]
        if not self.features:
            calibrated = any(name.endswith(".contact_mm") for name in values[0])
            self.features = {
                name: description(name, value, calibrated=calibrated) for name, value in values[0].items()
            }
        if values[0].keys() != self.features.keys():
            raise StageError("it has markers, and the recordings before have none: make two datasets")
        for name in self.features:
            self._moments.setdefault(name, Moments()).add(np.stack([arrays[name] for arrays in values]))

    def _complete_windows(self, rows: list[Row], name: str) -> None:
        """Give the windows one length, that of the longest in the first episode; one of a row is left out."""
        windows = [row.pop(WINDOW_ROWS) for row in rows]
        if not self.features:
            self._window_length = max(map(len, windows))
        if self._window_length > 1:
            columns = len(windows[0][0])
            for row, window in zip(rows, windows, strict=True):
                row[name] = padded_window(window, self._window_length, columns)

    def picture_feature(self, fps: int) -> dict[str, Any]:
        """The description of the pictures."""
        camera: dict[str, Any] = {
            "dtype": "video" if self._is_video else "image",
            "shape": list(self.shape),
            "names": ["height", "width", "channels"],
        }
        if self._is_video:
            camera["info"] = {
                "video.height": self.shape[0],
                "video.width": self.shape[1],
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            }
        return camera

    def statistics(self, frames: int) -> dict[str, dict[str, Any]]:
        """Statistics for normalisation: of each number, and of each color (in [0, 1], red first).

        frames : of the dataset.
        """
        statistics: dict[str, dict[str, Any]] = {
            name: {key: value.tolist() for key, value in moments.summary().items()} | {"count": [frames]}
            for name, moments in self._moments.items()
        }
        colors = self._colors.summary()
        statistics[self.camera] = {key: value.reshape(3, 1, 1).tolist() for key, value in colors.items()}
        statistics[self.camera]["count"] = [self._sampled]
        return statistics
