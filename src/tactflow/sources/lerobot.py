"""One camera of one episode of a LeRobot dataset (layouts v2 and v3)."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, Normaliser, find_path, refuse_devices, refuse_too_large
from tactflow.sources.files import decode_image, refuse_playlist
from tactflow.sources.query import split_query
from tactflow.sources.stores import damaged
from tactflow.system.extras import missing

SCHEME = "lerobot:"
SETTINGS = {"camera": "key of a camera", "episode": "number of an episode"}
CHUNK = 1000
"""Episodes in one folder of layout v2, where the dataset does not say."""


class Place(NamedTuple):
    """Where an episode is. data, video : files. begin : of the episode in its video, s. frames : of it."""

    data: Path
    video: Path
    begin: float
    frames: int


class LeRobotEpisode:
    """The pictures of one camera in one episode; frame i is taken at i / fps.

    Parameters
    ----------
    spec : `lerobot:PATH?camera=observation.images.left_tactile&episode=3`.
    directory : where a relative path is looked for if it is not in the current directory.

    Raises
    ------
    SourceError
        If there is no such dataset, camera or episode (it lists those that are there), or a package is
        missing.
    """

    live = False

    def __init__(self, spec: str, directory: Path | None = None) -> None:
        problem = missing("LeRobot datasets", "lerobot", ["pyarrow", "av"])
        if problem is not None:
            raise SourceError(f"{spec}: {problem}")
        name, settings = split_query(spec.removeprefix(SCHEME), directory, SETTINGS)
        root = find_path(name, directory)
        refuse_devices(root / "meta")
        try:
            info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
            camera, episode, self._stored = _chosen(spec, info, settings)
            self._name = f"{root}, {camera}, episode {episode}"
            self._place = _find(root, info, camera, episode)
            refuse_devices(self._place.data)
            if self._stored == "video":
                refuse_playlist(self._place.video)
            self.fps: float | None = float(info["fps"])
        except SourceError:
            raise
        except Exception as error:
            # What is wrong with JSON and Parquet files raises whatever their parsers do.
            raise damaged(f"{root}: this LeRobot dataset", error) from error
        self._camera, self._episode = camera, episode
        self.total: int | None = self._place.frames
        self._normalise = Normaliser(self._name)
        self._frames = self._play()
        self._first = self._next()
        self.size = self._normalise.size
        self.description = f"{spec}, {self.total} frames at {self.fps:g} fps"

    def read(self) -> tuple[BgrImage, float] | None:
        """The next frame and its time; see `FrameReader.read`."""
        item, self._first = self._first or self._next(), None
        return item

    def close(self) -> None:
        """Let go of the files."""
        self._frames.close()
        self._first = None

    def _next(self) -> tuple[BgrImage, float] | None:
        try:
            return next(self._frames, None)
        except SourceError:
            raise
        except Exception as error:
            raise damaged(self._name, error) from error

    def _play(self) -> Generator[tuple[BgrImage, float], None, None]:
        import pyarrow.dataset as ds  # type: ignore[import-untyped]

        columns = ["frame_index", *([self._camera] if self._stored == "image" else [])]
        # The column `timestamp` is the same, rounded to 32 bits.
        rate = self.fps or 1.0
        wanted = ds.field("episode_index") == self._episode
        batches = ds.dataset(self._place.data).to_batches(columns=columns, filter=wanted, batch_size=16)
        rows = (row for batch in batches for row in batch.to_pylist())
        if self._stored == "image":
            for row in rows:
                image = decode_image(row[self._camera]["bytes"], self._name)
                yield self._normalise(image), row["frame_index"] / rate
            return
        for row, image in zip(rows, self._film(), strict=True):
            yield self._normalise(image), row["frame_index"] / rate

    def _film(self) -> Iterator[NDArray[np.uint8]]:
        """The pictures of the episode from its video, which may hold several episodes."""
        import av

        place, left = self._place, self._place.frames
        with av.open(str(place.video)) as film:
            (stream, *_) = film.streams.video
            refuse_too_large(self._name, stream.width, stream.height)
            # To the key frame before; from there every picture is decoded.
            film.seek(round(place.begin / (stream.time_base or 1)), stream=stream)
            for frame in film.decode(stream):
                if frame.time is not None and frame.time < place.begin - 0.5 / (self.fps or 1.0):
                    continue
                if left == 0:
                    return
                left -= 1
                yield np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)


def _chosen(spec: str, info: Any, settings: dict[str, str]) -> tuple[str, int, str]:
    """The camera, the episode, and how its pictures are kept: "video" or "image"."""
    cameras = {
        name: feature["dtype"]
        for name, feature in info["features"].items()
        if feature["dtype"] in ("video", "image")
    }
    episodes = int(info["total_episodes"])
    camera, episode = settings.get("camera"), settings.get("episode", "")
    if camera is None or camera not in cameras or not episode.isdecimal() or int(episode) >= episodes:
        raise SourceError(
            f"{spec}: required ?camera=...&episode=...; cameras: {', '.join(sorted(cameras)) or 'none'}; "
            f"episodes: 0 to {episodes - 1}"
        )
    return camera, int(episode), cameras[camera]


def _find(root: Path, info: Any, camera: str, episode: int) -> Place:
    if str(info["codebase_version"]).startswith("v2"):
        chunk = f"chunk-{episode // int(info.get('chunks_size', CHUNK)):03d}"
        data = root / "data" / chunk / f"episode_{episode:06d}.parquet"
        video = root / "videos" / chunk / camera / f"episode_{episode:06d}.mp4"
        lines = (root / "meta" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
        lengths = {one["episode_index"]: int(one["length"]) for one in map(json.loads, lines)}
        return Place(data, video, 0.0, lengths[episode])
    import pyarrow.dataset as ds

    table = ds.dataset(root / "meta" / "episodes", format="parquet")
    (row,) = table.to_table(filter=ds.field("episode_index") == episode).to_pylist()
    data = root / "data" / _file(row, "data", ".parquet")
    if f"videos/{camera}/file_index" not in row:
        return Place(data, data, 0.0, int(row["length"]))
    key = f"videos/{camera}"
    return Place(
        data, root / key / _file(row, key, ".mp4"), float(row[f"{key}/from_timestamp"]), int(row["length"])
    )


def _file(row: Any, key: str, suffix: str) -> str:
    return f"chunk-{int(row[f'{key}/chunk_index']):03d}/file-{int(row[f'{key}/file_index']):03d}{suffix}"
