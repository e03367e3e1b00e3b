"""One camera of one episode of a LeRobot dataset (layout v3), as a source."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, check_pixel_count, damaged, require
from tactflow.sources.files import decode_image, refuse_playlist
from tactflow.sources.paths import find_path, split_query

SCHEME = "lerobot:"
SETTINGS = {"camera": "key of a camera", "episode": "number of an episode"}


class LeRobotEpisode(FrameReader):
    """The pictures of one camera in one episode; frame i is taken at i / fps.

    spec : `lerobot:PATH?camera=observation.images.left_tactile&episode=3`. directory : as for `open_source`.
    Raises SourceError if there is no such dataset, camera or episode (it lists the valid ones), or a package
    is missing.
    """

    # The parsers of JSON, Parquet and video raise all kinds of errors.
    parser_errors = (Exception,)

    def __init__(self, spec: str, directory: Path | None = None, _fps: float | None = None) -> None:
        require(spec, "LeRobot datasets", "lerobot", "pyarrow", "av")
        name, settings = split_query(spec.removeprefix(SCHEME), directory, SETTINGS)
        root = find_path(name, directory)
        try:
            info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
            self._camera, self._episode, is_video = _choose(spec, info, settings)
            self._data, video, self._begin, self.total = _find(root, info, self._camera, self._episode)
            self.fps = self._rate = float(info["fps"])
        except SourceError:
            raise
        except Exception as error:
            raise damaged(f"{root}: this LeRobot dataset", error) from error
        super().__init__(f"{root}, {self._camera}, episode {self._episode}")
        self._video = video if is_video else None
        if self._video is not None:
            refuse_playlist(self._video)
        self._read_first()
        self.description = f"{spec}, {self.total} frames at {self.fps:g} fps"

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        pictures = self._read_pictures() if self._video is None else self._decode_video(self._video)
        # The column `timestamp` is the same, rounded to 32 bits.
        for index, image in enumerate(pictures):
            yield image, index / self._rate

    def _read_pictures(self) -> Iterator[NDArray[Any]]:
        import pyarrow.dataset as ds  # type: ignore[import-untyped]

        wanted = ds.field("episode_index") == self._episode
        for batch in ds.dataset(self._data).to_batches(columns=[self._camera], filter=wanted, batch_size=16):
            for row in batch.to_pylist():
                yield decode_image(row[self._camera]["bytes"], self.name)

    def _decode_video(self, path: Path) -> Iterator[NDArray[np.uint8]]:
        import av

        left = self.total or 0
        with av.open(str(path)) as file:
            (stream, *_) = file.streams.video
            check_pixel_count(self.name, stream.width, stream.height)
            # Seeks to the key frame before; pictures from there on are decoded.
            file.seek(round(self._begin / (stream.time_base or 1)), stream=stream)
            for frame in file.decode(stream):
                if frame.time is not None and frame.time < self._begin - 0.5 / self._rate:
                    continue
                if left == 0:
                    return
                left -= 1
                yield np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
        if left:
            raise SourceError(f"{self.name}: is damaged or cut off ({left} pictures are missing)")


def _choose(spec: str, info: Any, settings: dict[str, str]) -> tuple[str, int, bool]:
    """The camera, the episode, and whether its pictures are a video."""
    cameras = {
        name: feature["dtype"]
        for name, feature in info["features"].items()
        if feature["dtype"] in ("video", "image")
    }
    episodes = int(info["total_episodes"])
    camera, episode = settings.get("camera", ""), settings.get("episode", "")
    if camera not in cameras or not episode.isdecimal() or int(episode) >= episodes:
        raise SourceError(
            f"{spec}: required ?camera=...&episode=...; cameras: {', '.join(sorted(cameras)) or 'none'}; "
            f"episodes: 0 to {episodes - 1}"
        )
    return camera, int(episode), cameras[camera] == "video"


def _find(root: Path, info: Any, camera: str, episode: int) -> tuple[Path, Path, float, int]:
    """The table and the video of an episode, its start in the video, s, and its number of frames."""
    if str(info["codebase_version"]).startswith("v2"):
        raise SourceError(f"{root}: has layout v2; LeRobot's convert_dataset_v21_to_v30 makes it layout v3")
    import pyarrow.dataset as ds

    table = ds.dataset(root / "meta" / "episodes", format="parquet")
    (row,) = table.to_table(filter=ds.field("episode_index") == episode).to_pylist()

    def file(key: str, suffix: str) -> Path:
        chunk, number = int(row.get(f"{key}/chunk_index", 0)), int(row.get(f"{key}/file_index", 0))
        return root / key / f"chunk-{chunk:03d}" / f"file-{number:03d}{suffix}"

    key = f"videos/{camera}"
    begin = float(row.get(f"{key}/from_timestamp", 0.0))
    return file("data", ".parquet"), file(key, ".mp4"), begin, int(row["length"])
