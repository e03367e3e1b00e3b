"""Recordings of tactflow, played again: the frames bit for bit, with their original seq, t and flags."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from tactflow.engine.errors import SourceError
from tactflow.recording import missing_packages
from tactflow.sources.base import BgrImage, Stamp, StampedReader, damaged, log
from tactflow.sources.paths import describe_settings, find_path, split_query

if TYPE_CHECKING:
    from mcap.records import Message

    from tactflow.recording.frames import StoredFrame
    from tactflow.recording.reader import Contents

SETTINGS = {"start": "SECONDS (from the beginning)", "loop": "N (play N times; 0 is for ever)"}

LATEST_START = 1e9
"""A start beyond this, s, lies behind the end of every recording: 30 years. Chosen by hand."""


class Recording(StampedReader):
    """An .mcap file that tactflow recorded.

    A recording brings its own references: capture's parameters `reference` and `skip` do not apply. With
    `start`, the references that were in force at that time come first.

    With `loop`, seq and t keep growing from lap to lap, and every lap is an epoch of its own: it takes its
    references again, so that it gives the same results as the first.

    Parameters
    ----------
    spec : `file.mcap`, or `file.mcap?start=2.5&loop=2`.
    directory : where a relative path is looked for if it is not in the current directory.

    Raises
    ------
    SourceError
        If it is not there, is not a recording of tactflow, or an option is wrong.
    """

    def __init__(self, spec: str, directory: Path | None = None) -> None:
        problem = missing_packages()
        if problem is not None:
            raise SourceError(f"{spec}: {problem}")
        name, start, self._laps = _parse(spec, directory)
        self._path = find_path(name, directory)
        super().__init__(str(self._path))
        contents = self._contents = _look_into(self._path)
        seconds = ((contents.end or 0) - (contents.start or 0)) / 1e9
        self._start = None if not start or contents.start is None else contents.start + round(start * 1e9)
        length = "" if contents.end is None else f"; it is {seconds:g} s long"
        self._read_first(f"there is no frame {f'after {start:g} s{length}' if start else 'in it'}")
        if contents.frames is not None:
            self.fps = (contents.frames - 1) / seconds if seconds > 0 else None
            self.total = contents.frames * self._laps if self._laps and self._start is None else None
        frames = "an unknown number of" if contents.frames is None else str(contents.frames)
        self.description = f"{spec}, {frames} frames, {'{} x {}'.format(*self.size or (0, 0))}"
        if not contents.finished:
            log.warning(
                "%s: was not finished (killed?); it is played up to where it ends; "
                "tactflow repair makes it whole for other programs too",
                self._path,
            )

    def _frames(self) -> Iterator[tuple[BgrImage, float, Stamp]]:
        """All laps: each frame, its time, and its stamp."""
        lap = seqs = epochs = 0
        seconds = latest = 0.0
        while not self._laps or lap < self._laps:
            lap += 1
            times: list[float] = []
            last_seq = last_epoch = -1
            for frame, due in self._lap():
                seq = frame.seq if frame.seq < 0 else frame.seq + seqs
                if due:
                    times = [times[0] if times else frame.t, *times[-1:], frame.t]
                last_seq, last_epoch = max(last_seq, frame.seq), max(last_epoch, frame.epoch)
                t = latest = frame.t if lap == 1 else max(frame.t + seconds, latest)
                yield self._decode(frame), t, Stamp(seq, frame.reference, frame.epoch + epochs, due)
            if not times:
                return
            # The last frame lasts as long as the one before it.
            seconds += times[-1] - times[0] + (times[-1] - times[-2])
            seqs += last_seq + 1
            epochs += last_epoch + 1

    def _decode(self, frame: StoredFrame) -> BgrImage:
        try:
            return frame.image()
        except ValueError as error:
            raise SourceError(f"{self._path}, frame {frame.seq}: {error}") from error

    def _lap(self) -> Iterator[tuple[StoredFrame, bool]]:
        """The frames of one lap, and whether each comes at its time (True) or ahead of it."""
        from tactflow.recording.frames import nanoseconds
        from tactflow.recording.reader import messages
        from tactflow.recording.records import DAMAGE

        contents, start = self._contents, self._start
        topics = {contents.frame_topic, contents.reference_topic}
        try:
            played = messages(self._path, contents, topics, start=start)
            if start is not None:
                first = next(played, None)
                if first is None:
                    return
                before = messages(self._path, contents, {contents.reference_topic}, end=start)
                yield from ((frame, False) for frame in _in_force([self._stored(m) for m in before]))
                played = chain([first], played)
            for message in played:
                frame = self._stored(message)
                # A recording begun late brings the references of before, at the time it began.
                late = frame.reference and message.log_time != max(nanoseconds(frame.t), 0)
                yield frame, not late and frame.seq >= 0
        except DAMAGE as error:
            raise SourceError(
                f"{self._path}: is damaged ({error or type(error).__name__}); "
                "tactflow repair keeps all that is intact"
            ) from error

    def _stored(self, message: Message) -> StoredFrame:
        from tactflow.recording.frames import StoredFrame

        try:
            return StoredFrame.parse(message.data)
        except ValueError as error:
            raise SourceError(f"{self._path}, {message.log_time / 1e9:g} s: {error}") from error


def _look_into(path: Path) -> Contents:
    from tactflow.recording.reader import look_into
    from tactflow.recording.records import NotARecordingError

    try:
        return look_into(path)
    except NotARecordingError as error:
        raise SourceError(f"{path}: {error}") from None
    except OSError as error:
        raise damaged(str(path), error) from error


def _in_force(references: list[StoredFrame]) -> list[StoredFrame]:
    epoch = max((frame.epoch for frame in references), default=0)
    return [frame for frame in references if frame.epoch == epoch]


def _parse(spec: str, directory: Path | None) -> tuple[str, float, int]:
    """Path, start in s, and number of laps."""
    name, settings = split_query(spec, directory, SETTINGS)
    try:
        start, laps = float(settings.get("start", 0)), int(settings.get("loop", 1))
    except ValueError:
        start, laps = -1.0, 1
    if not 0 <= start <= LATEST_START or laps < 0:
        raise SourceError(f"{spec}: required {describe_settings(SETTINGS)}")
    return name, start, laps
