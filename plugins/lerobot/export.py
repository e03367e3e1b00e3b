"""`tactflow export lerobot`: datasets of LeRobot (layout v3.0) with pictures, contact, flow and markers at a
constant rate, of one sensor or several, and all results between two pictures; of a calibrated sensor also in
mm and N.

The layout is described at https://huggingface.co/docs/lerobot/lerobot-dataset-v3. Each recording is an
episode, in files of its own.
"""

from __future__ import annotations

import json
import logging
from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactflow import __version__
from tactflow.engine.errors import StageError
from tactflow.message.episodes import aligned
from tactflow.system.extras import missing

from .columns import Row, SensorColumns

if TYPE_CHECKING:
    from collections.abc import Callable

    from tactflow.message.episodes import Results
    from tactflow.message.result import Result

log = logging.getLogger("tactflow")

VERSION = "v3.0"
"""Version of the layout, which LeRobot checks."""
INTEGERS = ("frame_index", "episode_index", "index", "task_index")
"""Integer columns that every dataset has, besides `timestamp`."""
FILES_PER_FOLDER = 1000
"""Files per folder, as in LeRobot."""
NO_OVERLAP = "its recordings have no time in common: are they of one session?"
ENCODER_OPTIONS = {"crf": "18", "g": "2", "preset": "veryfast"}
"""Options of the encoder: hardly any visible loss, and every other picture is a key frame, for random access.
Chosen by hand."""


def export(
    folder: Path,
    episodes: Iterable[tuple[str, Results]],
    *,
    fps: int,
    task: str = "touch",
    pictures: str = "video",
    sensors: Sequence[str] = (),
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
    sensors : several, which each episode has; then its results are a mapping.

    Raises
    ------
    StageError : a package is missing, or a recording does not match the earlier ones. OSError : the files
        cannot be written.
    """
    del sensors
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
        self._sensors: dict[str, SensorColumns] = {}

    def add(self, results: Results) -> int:
        """Write one episode; returns the number of its frames.

        results : with pictures, of one sensor; or sensor -> its results, with times of one clock. Then the
            episode is the time in which all run.

        Raises
        ------
        StageError : a sensor or the size of its pictures differs from the episodes before, only some have a
            calibration, or there is no picture. OSError : the files cannot be written.
        """
        streams = results if isinstance(results, Mapping) else {"": results}
        for name in () if self._sensors else streams:
            self._sensors[name] = SensorColumns(video=self._is_video, named=len(streams) > 1)
        if streams.keys() != self._sensors.keys():
            given, earlier = (", ".join(names) for names in (streams, self._sensors))
            raise StageError(f"sensors {given}; the earlier ones are {earlier}: make two datasets")
        episode = len(self._episodes)
        rows = self._read(streams, f"{_file(episode)}.mp4")
        if not rows:
            raise StageError("there is no frame in it" if len(streams) == 1 else NO_OVERLAP)
        for index, row in enumerate(rows):
            integers = (index, episode, self._frames + index, 0)
            row |= {"timestamp": index / self._fps} | dict(zip(INTEGERS, integers, strict=True))
        self._write_rows(rows, self._folder / "data" / f"{_file(episode)}.parquet")
        self._episodes.append(self._episode(episode, len(rows)))
        self._frames += len(rows)
        return len(rows)

    def _read(self, streams: Mapping[str, Iterable[Result]], video: str) -> list[Row]:
        """The columns of all sensors in each frame of an episode; encodes the pictures, if as a video."""
        rows: dict[str, list[Row]] = {name: [] for name in streams}
        encoders: dict[str, Callable[[NDArray[np.uint8] | None], None]] = {}
        watched = {name: self._sensors[name].remember(results) for name, results in streams.items()}
        with ExitStack() as stack:
            for index, moment in enumerate(aligned(watched, self._fps)):
                for name, result in moment.items():
                    sensor = self._sensors[name]
                    image = sensor.check(result)
                    if self._is_video and name not in encoders:
                        path = self._folder / "videos" / sensor.camera / video
                        encoders[name] = _open_video(stack, path, self._fps, image)
                    rows[name].append(sensor.row(result, image, index))
                    if self._is_video:
                        encoders[name](image)
            # After a failed write, this would crash the process.
            for encode in encoders.values():
                encode(None)
        for name, own in rows.items():
            if own:
                self._sensors[name].complete(own)
        return [
            {k: v for part in parts for k, v in part.items()} for parts in zip(*rows.values(), strict=True)
        ]

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
        statistics = [sensor.statistics(self._frames) for sensor in self._sensors.values()]
        (meta / "stats.json").write_text(json.dumps(dict(ChainMap(*statistics)), indent=4))

    def _features(self) -> dict[str, dict[str, Any]]:
        """Columns of all sensors but those of pictures -> their descriptions."""
        sensors = self._sensors.values()
        return {name: feature for sensor in sensors for name, feature in sensor.features.items()}

    def _write_rows(self, rows: list[Row], path: Path) -> None:
        import pyarrow as pa

        types: dict[str, Any] = {}
        features = self._features()
        for name, feature in features.items():
            value = pa.bool_() if feature["dtype"] == "bool" else getattr(pa, feature["dtype"])()
            length, *columns = feature["shape"]
            types[name] = pa.list_(pa.list_(value)) if columns else pa.list_(value, length)
        for sensor in () if self._is_video else self._sensors.values():
            types[sensor.camera] = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        types |= {"timestamp": pa.float32(), **dict.fromkeys(INTEGERS, pa.int64())}
        for row in rows:
            row |= {name: np.asarray(row[name]).tolist() for name in features}
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
        video = place | {"from_timestamp": 0.0, "to_timestamp": frames / self._fps}
        for sensor in self._sensors.values() if self._is_video else ():
            row |= {f"videos/{sensor.camera}/{key}": value for key, value in video.items()}
        return row

    def _info(self) -> dict[str, Any]:
        features = {one.camera: one.picture_feature(self._fps) for one in self._sensors.values()}
        features |= self._features()
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


def _file(episode: int) -> str:
    """Chunk and file of an episode, without the suffix."""
    return f"chunk-{episode // FILES_PER_FOLDER:03d}/file-{episode % FILES_PER_FOLDER:03d}"


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
