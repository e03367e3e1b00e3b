"""`tactflow export lerobot`: datasets of LeRobot (layout v3.0) with pictures, contact, flow and markers at a
constant rate, and all results between two pictures; of a calibrated sensor also in mm and N.

The layout is described at https://huggingface.co/docs/lerobot/lerobot-dataset-v3. Each recording is an
episode, in files of its own.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow import __version__
from tactflow.engine.errors import StageError
from tactflow.message.episodes import MarkerOrder, Moments, at_rate
from tactflow.system.extras import missing

from .features import (
    TACTILE_FEATURE,
    Window,
    description,
    marker_features,
    numbers,
    padded_window,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from tactflow.message.result import Result

log = logging.getLogger("tactflow")

VERSION = "v3.0"
"""Version of the layout, which LeRobot checks."""
PICTURE_PREFIX = "observation.images."
INTEGERS = ("frame_index", "episode_index", "index", "task_index")
"""Integer columns that every dataset has, besides `timestamp`."""
WINDOW_ROWS = "window rows"
"""Key of a row of the table under which its window is kept until the length of all windows is known."""
FILES_PER_FOLDER = 1000
"""Files per folder, as in LeRobot."""
ENCODER_OPTIONS = {"crf": "18", "g": "2", "preset": "veryfast"}
"""Options of the encoder: hardly any visible loss, and every other picture is a key frame, for random access.
Chosen by hand."""
STATISTICS_STEP_FRAMES = 10
"""Every 10th picture counts for the statistics. Chosen by hand."""


def export(
    folder: Path,
    episodes: Iterable[tuple[str, Iterable[Result]]],
    *,
    fps: int,
    task: str = "touch",
    pictures: str = "video",
    **_: object,
) -> None:
    """Write a dataset, for `tactflow export`.

    Parameters
    ----------
    folder : empty or missing.
    episodes : the name of each recording, and its results with pictures.
    fps : of the dataset, frames per second.
    task : description of the task.
    pictures : "video" (H.264, lossy) or "png" (lossless).

    Raises
    ------
    StageError : a package is missing, or a recording does not match the earlier ones. OSError : the files
        cannot be written.
    """
    writer = DatasetWriter(folder, fps, task, video=pictures == "video")
    for name, results in episodes:
        log.info("%s: %d frames", name, writer.add(results))
    writer.finish()


class DatasetWriter:
    """Writes one dataset. Parameters as for `export`;

    Parameters
    ----------
    video : whether to store pictures as a video.
    """

    def __init__(self, folder: Path, fps: int, task: str, *, video: bool = True) -> None:
        problem = missing("LeRobot datasets", "lerobot", ["pyarrow", "av"])
        if problem is not None:
            raise StageError(problem)
        self._folder, self._fps, self._task, self._is_video = folder, fps, task, video
        self._episodes: list[dict[str, Any]] = []
        self._frames = 0
        self._kind = self._camera = ""
        self._shape: tuple[int, ...] = ()
        self._features: dict[str, dict[str, Any]] = {}
        self._moments: dict[str, Moments] = {}
        self._order = MarkerOrder()
        self._window = Window()
        self._window_length = 0
        self._colors = Moments()
        self._sampled = 0

    def add(self, results: Iterable[Result]) -> int:
        """Write one episode; returns the number of its frames.

        results : of one sensor, with pictures.

        Raises
        ------
        StageError : the sensor or the size of its pictures differs from the episodes before, only some have a
            calibration, or there is no picture. OSError : the files cannot be written.
        """
        episode = len(self._episodes)
        file = f"chunk-{episode // FILES_PER_FOLDER:03d}/file-{episode % FILES_PER_FOLDER:03d}"
        rows: list[dict[str, Any]] = []
        encode: Callable[[NDArray[np.uint8] | None], None] | None = None
        with ExitStack() as stack:
            for index, result in enumerate(at_rate(self._window.remember(results), self._fps)):
                image = self._check(result)
                if self._is_video and encode is None:
                    path = self._folder / "videos" / self._camera / f"{file}.mp4"
                    encode = _open_video(stack, path, self._fps, image)
                rows.append(self._row(result, image, index, episode))
                if encode is not None:
                    encode(image)
            # After a failed write, this would crash the process.
            if encode is not None:
                encode(None)
        if not rows:
            raise StageError("there is no frame in it")
        self._complete(rows)
        self._write_rows(rows, self._folder / "data" / f"{file}.parquet")
        self._episodes.append(self._episode(episode, len(rows)))
        self._frames += len(rows)
        return len(rows)

    def finish(self) -> None:
        """Write the description of the dataset."""
        import pyarrow as pa  # type: ignore[import-untyped]

        meta = self._folder / "meta"
        _write(pa.Table.from_pylist(self._episodes), meta / "episodes" / "chunk-000" / "file-000.parquet")
        # LeRobot looks up a task by the index of a pandas table; this names the index column.
        types = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
        columns = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
            for name, (kind, stored) in types.items()
        ]
        pandas = {"index_columns": ["task"], "columns": columns, "column_indexes": []}
        tasks = pa.table({"task_index": [0], "task": [self._task]})
        _write(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), meta / "tasks.parquet")
        (meta / "info.json").write_text(json.dumps(self._info(), indent=4))
        (meta / "stats.json").write_text(json.dumps(self._statistics(), indent=4))

    def _check(self, result: Result) -> NDArray[np.uint8]:
        """The picture of a result, if it matches the earlier ones."""
        image = result.image
        if image is None:
            raise StageError("the pipeline makes no picture: it needs a stage preprocess")
        camera, size = f"{PICTURE_PREFIX}{result.sensor}", f"{image.shape[1]} x {image.shape[0]} pixels"
        calibrated = result.scale is not None
        kind = f"{camera}, {size}, with{'' if calibrated else 'out'} calibration"
        if not self._kind:
            self._kind, self._camera, self._shape = kind, camera, image.shape
        if kind != self._kind:
            raise StageError(f"{kind}; the earlier ones are {self._kind}: make two datasets")
        if self._is_video and (image.shape[0] % 2 or image.shape[1] % 2):
            raise StageError(f"pictures of {size}: a video needs even numbers; give --pictures png")
        return image

    def _row(self, result: Result, image: NDArray[np.uint8], index: int, episode: int) -> dict[str, Any]:
        row: dict[str, Any] = {
            f"{TACTILE_FEATURE}.{name}": values for name, values in numbers(result).items()
        }
        row |= self._marker_rows(result)
        row[WINDOW_ROWS] = self._window.take(result.t)
        if index % STATISTICS_STEP_FRAMES == 0:
            self._colors.add(image.reshape(-1, 3)[:, ::-1] / 255.0)
            self._sampled += 1
        if not self._is_video:
            row[self._camera] = {"bytes": cv2.imencode(".png", image)[1].tobytes(), "path": None}
        integers = (index, episode, self._frames + index, 0)
        return row | {"timestamp": index / self._fps} | dict(zip(INTEGERS, integers, strict=True))

    def _marker_rows(self, result: Result) -> dict[str, NDArray[Any]]:
        """The features of the markers; empty before the first frame with markers."""
        if result.markers is not None:
            return marker_features(result.sensor, self._order.align(result.markers), result)
        return {} if self._order.origin is None else marker_features(result.sensor, self._order.lost())

    def _complete(self, rows: list[dict[str, Any]]) -> None:
        """Complete the features of every row of an episode, and add their values to the statistics.

        Raises
        ------
        StageError : this recording has markers, and those before had none.
        """
        sensor = self._camera.removeprefix(PICTURE_PREFIX)
        if self._order.origin is not None:
            lost = marker_features(sensor, self._order.lost())
            rows[:] = [lost | row for row in rows]
        self._complete_windows(rows, f"{TACTILE_FEATURE}.{sensor}.window")
        values = [
            {name: np.asarray(v) for name, v in row.items() if name.startswith(TACTILE_FEATURE)}
            for row in rows
        ]
        if not self._features:
            calibrated = f"{TACTILE_FEATURE}.contact_mm" in values[0]
            self._features = {
                name: description(name, value, calibrated=calibrated) for name, value in values[0].items()
            }
        if values[0].keys() != self._features.keys():
            raise StageError("it has markers, and the recordings before have none: make two datasets")
        for name in self._features:
            self._moments.setdefault(name, Moments()).add(np.stack([arrays[name] for arrays in values]))

    def _complete_windows(self, rows: list[dict[str, Any]], name: str) -> None:
        """Give the windows one length, that of the longest in the first episode; one of a row is left out."""
        windows = [row.pop(WINDOW_ROWS) for row in rows]
        if not self._features:
            self._window_length = max(map(len, windows))
        if self._window_length > 1:
            columns = len(windows[0][0])
            for row, window in zip(rows, windows, strict=True):
                row[name] = padded_window(window, self._window_length, columns)

    def _write_rows(self, rows: list[dict[str, Any]], path: Path) -> None:
        import pyarrow as pa

        types: dict[str, Any] = {}
        for name, feature in self._features.items():
            value = pa.bool_() if feature["dtype"] == "bool" else getattr(pa, feature["dtype"])()
            length, *columns = feature["shape"]
            types[name] = pa.list_(pa.list_(value)) if columns else pa.list_(value, length)
        if not self._is_video:
            types[self._camera] = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        types |= {"timestamp": pa.float32(), **dict.fromkeys(INTEGERS, pa.int64())}
        for row in rows:
            row |= {name: np.asarray(row[name]).tolist() for name in self._features}
        _write(pa.Table.from_pylist(rows, pa.schema(types)), path)

    def _episode(self, episode: int, frames: int) -> dict[str, Any]:
        place = {"chunk_index": episode // FILES_PER_FOLDER, "file_index": episode % FILES_PER_FOLDER}
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [self._task],
            "length": frames,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        row |= {f"data/{key}": value for key, value in place.items()}
        if self._is_video:
            video = place | {"from_timestamp": 0.0, "to_timestamp": frames / self._fps}
            row |= {f"videos/{self._camera}/{key}": value for key, value in video.items()}
        return row

    def _info(self) -> dict[str, Any]:
        camera: dict[str, Any] = {
            "dtype": "video" if self._is_video else "image",
            "shape": list(self._shape),
            "names": ["height", "width", "channels"],
        }
        if self._is_video:
            camera["info"] = {
                "video.height": self._shape[0],
                "video.width": self._shape[1],
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": self._fps,
                "video.channels": 3,
                "has_audio": False,
            }
        features: dict[str, Any] = {self._camera: camera}
        features |= self._features
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in INTEGERS}
        video_path = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        return {
            "codebase_version": VERSION,
            "robot_type": None,
            "tactflow_version": __version__,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": 1,
            "chunks_size": FILES_PER_FOLDER,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": video_path if self._is_video else None,
            "features": features,
        }

    def _statistics(self) -> dict[str, Any]:
        """Statistics for normalisation: of each number, and of each color (in [0, 1], red first)."""
        statistics: dict[str, dict[str, Any]] = {
            name: {key: value.tolist() for key, value in moments.summary().items()}
            | {"count": [self._frames]}
            for name, moments in self._moments.items()
        }
        colors = self._colors.summary()
        statistics[self._camera] = {key: value.reshape(3, 1, 1).tolist() for key, value in colors.items()}
        statistics[self._camera]["count"] = [self._sampled]
        return statistics


def _open_video(
    stack: ExitStack, path: Path, fps: int, image: NDArray[np.uint8]
) -> Callable[[NDArray[np.uint8] | None], None]:
    """Open an H.264 video. The returned function adds a picture, (H, W, 3) uint8 BGR; None flushes it."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    file = stack.enter_context(av.open(str(path), "w"))
    stream: av.VideoStream = file.add_stream("libx264", rate=fps, options=ENCODER_OPTIONS)
    stream.height, stream.width = image.shape[:2]
    stream.pix_fmt = "yuv420p"

    def encode(image: NDArray[np.uint8] | None) -> None:
        file.mux(stream.encode(None if image is None else av.VideoFrame.from_ndarray(image, format="bgr24")))

    return encode


def _write(table: Any, path: Path) -> None:
    import pyarrow.parquet as pq  # type: ignore[import-untyped]

    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)
