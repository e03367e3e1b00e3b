"""Replay of tactflow's recordings: identical frames, with their original seq, t and flags."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from tactflow.engine.errors import SourceError
from tactflow.recording.frames import RawFrame, decode_pixels, nanoseconds, parse_frame
from tactflow.recording.reader import look_into, messages
from tactflow.recording.records import DAMAGE_ERRORS, NotARecordingError
from tactflow.sources.base import FrameReader, damaged, log
from tactflow.sources.paths import describe_settings, find_path, split_query
from tactflow.vision.arrays import ColorImage

SETTINGS = {"start": "SECONDS (from the beginning)"}
MIN_UNIX_TIME_S = 1e9
"""Times of this and more are Unix times, s: those of a recording of a recording begin at 0."""
MAX_START_S = 1e9
"""Maximum start, s: 30 years, longer than any recording."""


class Recording(FrameReader):
    """An .mcap file recorded by tactflow.

    A recording includes its references, so that capture's parameters `reference` and `skip` do not apply.
    With `start`, the references of that time come first.

    Parameters
    ----------
    spec : `file.mcap`, or `file.mcap?start=2.5`.
    directory : as for `open_source`. Raises SourceError if it does not exist, is not a recording of
        tactflow, or an option is invalid.
    """

    stamped = True

    def __init__(self, spec: str, directory: Path | None = None) -> None:
        name, start = _parse(spec, directory)
        self._path = find_path(name, directory)
        super().__init__(str(self._path))
        try:
            contents = look_into(self._path)
        except NotARecordingError as error:
            raise SourceError(f"{self._path}: {error}") from error
        except OSError as error:
            raise damaged(self.name, error) from error
        self._frame_topic, self._reference_topic = contents.frame_topic, contents.reference_topic
        seconds = ((contents.end or 0) - (contents.start or 0)) / 1e9
        self._start = None if not start or contents.start is None else contents.start + round(start * 1e9)
        length = "" if contents.end is None else f"; it is {seconds:g} s long"
        self._read_first(f"there is no frame {f'after {start:g} s{length}' if start else 'in it'}")
        first = self.peek()
        self.begins = 0.0 if first is not None and first[1] >= MIN_UNIX_TIME_S else None
        if contents.frames is not None:
            self.fps = (contents.frames - 1) / seconds if seconds > 0 else None
            self.total = contents.frames if self._start is None else None
        frames = "an unknown number of" if contents.frames is None else str(contents.frames)
        self.description = f"{spec}, {frames} frames, {'{} x {}'.format(*self.size or (0, 0))}"
        if not contents.finished:
            self.remark = "the file was not finished (killed?); tactflow repair adds its index"
            log.warning(
                "%s: was not finished (killed?); it is played up to where it ends; "
                "tactflow repair makes it whole for other programs too",
                self._path,
            )

    def _frames(self) -> Iterator[tuple[ColorImage, float, int, bool, int, bool]]:
        """All frames with their metadata."""
        self._picture = str(self._path)
        try:
            for frame, paced in self._stored_frames():
                self._picture = f"{self._path}, frame {frame.seq}"
                image = decode_pixels(frame)
                yield image, frame.t, frame.seq, frame.reference, frame.epoch, paced
        except DAMAGE_ERRORS as error:
            raise SourceError(
                f"{self._picture}: is damaged ({error or type(error).__name__}); "
                "tactflow repair keeps all that is intact"
            ) from error

    def _stored_frames(self) -> Iterator[tuple[RawFrame, bool]]:
        """The frames, and whether each is delivered at its time (True) or ahead of it."""
        played = messages(self._path, {self._frame_topic, self._reference_topic}, start=self._start)
        if self._start is not None:
            first = next(played, None)
            if first is None:
                return
            before = messages(self._path, {self._reference_topic}, end=self._start)
            references = [parse_frame(message.data) for message in before]
            epoch = max((frame.epoch for frame in references), default=0)
            yield from ((frame, False) for frame in references if frame.epoch == epoch)
            played = chain([first], played)
        for message in played:
            frame = parse_frame(message.data)
            # A recording that was started later has earlier references, logged at its start.
            late = frame.reference and message.log_time != max(nanoseconds(frame.t), 0)
            yield frame, not late and frame.seq >= 0


def _parse(spec: str, directory: Path | None) -> tuple[str, float]:
    """Path, and start in s."""
    name, settings = split_query(spec, directory, SETTINGS)
    try:
        start = float(settings.get("start", 0))
    except ValueError:
        start = -1.0
    if not 0 <= start <= MAX_START_S:
        raise SourceError(f"{spec}: required {describe_settings(SETTINGS)}")
    return name, start
