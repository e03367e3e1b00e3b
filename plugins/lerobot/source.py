"""The pictures of one camera of a LeRobot dataset (layouts v2 and v3), as a source."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, damaged, log, require
from tactflow.sources.files import decode_image
from tactflow.sources.paths import find_path, split_query
from tactflow.sources.video import decode, refuse_playlist

SCHEME = "lerobot:"
SETTINGS = {"camera": "key of a camera", "episode": "number of an episode (all if not given)"}
EPISODES_PER_FOLDER = 1000
"""Episodes per folder of layout v2, if the dataset does not say: LeRobot's default."""


class Episode(NamedTuple):
    """Where an episode is.

    Attributes
    ----------
    number : in the dataset.
    length : number of frames.
    table, video : its files.
    begin : its start in the video, s.
    """

    number: int
    length: int
    table: Path
    video: Path
    begin: float


class LeRobotEpisodes(FrameReader):
    """The pictures of one camera of a dataset of layout v2.0, v2.1 or v3.0; frame i is taken at i / fps.

    Each episode is an epoch with a reference of its own.

    Parameters
    ----------
    spec : `PATH?camera=observation.images.left_tactile&episode=3`, with or without the prefix `lerobot:`;
        the only camera need not be named.
    directory : as for `open_source`. Raises SourceError if there is no such dataset, camera or episode (it
        lists the valid ones), or a package is missing.
    """

    # The parsers of JSON, Parquet and video raise all kinds of errors.
    parser_errors = (Exception,)

    def __init__(self, spec: str, directory: Path | None = None, _fps: float | None = None) -> None:
        require(spec, "LeRobot datasets", "lerobot", "pyarrow", "av")
        name, settings = split_query(spec.removeprefix(SCHEME), directory, SETTINGS)
        root = find_path(name, directory)
        try:
            info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
            self._camera, number, self._is_video = _choose(spec, info, settings)
            self._episodes = _find(root, info, self._camera, number)
            self.fps = self._rate = float(info["fps"])
        except SourceError:
            raise
        except Exception as error:
            raise damaged(f"{root}: this LeRobot dataset", error) from error
        episodes = "" if number is None else f", episode {number}"
        super().__init__(f"{root}, {self._camera}{episodes}")
        self.total = sum(episode.length for episode in self._episodes)
        self._read_first()
        self.description = f"{spec}, {self.total} frames at {self.fps:g} fps"
        if len(self._episodes) > 1:
            text = "%s: %d episodes, each with a reference of its own; ?episode=N plays one of them"
            log.info(text, self.name, len(self._episodes))

    def _frames(self) -> Iterator[tuple[NDArray[Any], float, int, bool, int]]:
        index = 0
        for epoch, episode in enumerate(self._episodes):
            pictures = self._decode_video(episode) if self._is_video else self._read_pictures(episode)
            # The column `timestamp` is the same, rounded to 32 bits.
            for image in pictures:
                yield image, index / self._rate, index, False, epoch
                index += 1

    def _read_pictures(self, episode: Episode) -> Iterator[NDArray[Any]]:
        import pyarrow.dataset as ds  # type: ignore[import-untyped]

        wanted = ds.field("episode_index") == episode.number
        # By default, a scan reads whole row groups, and several ahead.
        options = ds.ParquetFragmentScanOptions(pre_buffer=False, use_buffered_stream=True)
        batches = ds.dataset(episode.table).to_batches(
            columns=[self._camera],
            filter=wanted,
            batch_size=16,
            batch_readahead=1,
            fragment_readahead=1,
            fragment_scan_options=options,
            use_threads=False,
        )
        for batch in batches:
            for row in batch.to_pylist():
                yield decode_image(row[self._camera]["bytes"], self.name)

    def _decode_video(self, episode: Episode) -> Iterator[NDArray[Any]]:
        refuse_playlist(episode.video)
        left = episode.length
        # Half a frame earlier, because times are rounded.
        for image, _ in decode(episode.video, self.name, episode.begin - 0.5 / self._rate):
            if left == 0:
                return
            left -= 1
            yield image
        if left:
            raise SourceError(f"{self.name}: is damaged or cut off ({left} pictures are missing)")


def _choose(spec: str, info: Any, settings: dict[str, str]) -> tuple[str, int | None, bool]:
    """The camera, the number of the episode or None for all, and whether the pictures are a video."""
    cameras = {
        name: feature["dtype"]
        for name, feature in info["features"].items()
        if feature["dtype"] in ("video", "image")
    }
    count = int(info["total_episodes"])
    camera = settings.get("camera") or (next(iter(cameras)) if len(cameras) == 1 else "")
    episode = settings.get("episode")
    valid = episode is None or (episode.isdecimal() and int(episode) < count)
    if camera not in cameras or not valid:
        raise SourceError(
            f"{spec}: required ?camera=...&episode=...; cameras: {', '.join(sorted(cameras)) or 'none'}; "
            f"episodes: 0 to {count - 1} (all if not given)"
        )
    return camera, None if episode is None else int(episode), cameras[camera] == "video"


def _find(root: Path, info: Any, camera: str, number: int | None) -> list[Episode]:
    """The requested episode, or all of them in order. Raises SourceError if the metadata lack them."""
    version = str(info["codebase_version"])
    if not version.startswith(("v2.", "v3.")):
        raise SourceError(f"{root}: has layout {version}; required v2.0, v2.1 or v3.0")
    if version.startswith("v2."):
        episodes = _find_v2(root, camera, number, int(info.get("chunks_size", EPISODES_PER_FOLDER)))
    else:
        episodes = _find_v3(root, camera, number)
    if not episodes:
        raise SourceError(f"{root}: meta/episodes does not hold {'an' if number is None else 'this'} episode")
    return sorted(episodes)


def _find_v2(root: Path, camera: str, number: int | None, per_folder: int) -> list[Episode]:
    """The requested episodes of layout v2, in which each has files of its own, so many in a folder."""
    episodes = []
    with (root / "meta" / "episodes.jsonl").open(encoding="utf-8") as lines:
        for line in filter(str.strip, lines):
            described = json.loads(line)
            index = int(described["episode_index"])
            if number in (None, index):
                folder, name = f"chunk-{index // per_folder:03d}", f"episode_{index:06d}"
                table = root / "data" / folder / f"{name}.parquet"
                video = root / "videos" / folder / camera / f"{name}.mp4"
                episodes.append(Episode(index, int(described["length"]), table, video, 0.0))
    return episodes


def _find_v3(root: Path, camera: str, number: int | None) -> list[Episode]:
    """The requested episodes of layout v3, in which several share a file."""
    import pyarrow.dataset as ds

    table = ds.dataset(root / "meta" / "episodes", format="parquet")
    video = f"videos/{camera}"
    columns = [name for name in table.schema.names if name.startswith((f"{video}/", "data/"))]
    wanted = None if number is None else ds.field("episode_index") == number
    rows = table.to_table(columns=["episode_index", "length", *columns], filter=wanted).to_pylist()

    def file(row: Any, key: str, suffix: str) -> Path:
        chunk, part = int(row.get(f"{key}/chunk_index", 0)), int(row.get(f"{key}/file_index", 0))
        return root / key / f"chunk-{chunk:03d}" / f"file-{part:03d}{suffix}"

    return [
        Episode(
            int(row["episode_index"]),
            int(row["length"]),
            file(row, "data", ".parquet"),
            file(row, video, ".mp4"),
            float(row.get(f"{video}/from_timestamp", 0.0)),
        )
        for row in rows
    ]
