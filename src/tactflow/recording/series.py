"""A recording in one file, or in several that follow each other: press.mcap, press-001.mcap, ..."""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from tactflow.engine.errors import StageError
from tactflow.recording.writer import About, Entry, RecordingWriter
from tactflow.system.files import next_name

log = logging.getLogger("tactflow")


class FileSeries:
    """The files that a run records, one at a time.

    Each begins with the references that its first frame is compared with, so that it can be played by itself.

    Parameters
    ----------
    path : the file; others carry its name and a number, and never replace one that is there.
    about : gives what a file says about itself; asked when it is opened.
    rotate_size : MB from which on a further file is begun, or None.
    rotate_after : the same as a length of time, s, or None.

    Attributes
    ----------
    path : of the file that was opened last. frames, files : written so far. bytes : of the finished files.

    Examples
    --------
    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from tactflow.engine.frame import Frame
    >>> from tactflow.recording.frames import FrameCoder
    >>> packed = FrameCoder().encode(Frame("main", 0, 0.0, np.zeros((6, 8, 3), np.uint8)))
    >>> with TemporaryDirectory() as folder:
    ...     series = FileSeries(Path(folder, "press.mcap"), lambda: About("main"), rotate_after=0.5)
    ...     series.begin([], overwrite=False)
    ...     for second in range(3):
    ...         series.write(Entry(second * 10**9, second, second == 0, 0, packed))
    ...     series.finish()
    ...     series.files, series.path.name
    (3, 'press-002.mcap')
    """

    def __init__(
        self,
        path: Path,
        about: Callable[[], About],
        *,
        rotate_size: int | None = None,
        rotate_after: float | None = None,
    ) -> None:
        self.path = path
        self.frames = self.files = self.bytes = 0
        self._name = path
        self._about = about
        self._rotate_size = rotate_size
        self._rotate_after = rotate_after
        self._file: RecordingWriter | None = None
        self._file_begins = 0
        self._late: list[Entry] = []
        self._in_force: list[Entry] = []

    @property
    def is_open(self) -> bool:
        """Whether a file is being written."""
        return self._file is not None

    def begin(self, references: Sequence[Entry], *, overwrite: bool) -> None:
        """Open the file of the name itself. references : of earlier, to be written before its first frame.

        Raises
        ------
        StageError
            If it is there and `overwrite` is not set, or cannot be written.
        """
        try:
            self._open(self._name, overwrite=overwrite)
        except FileExistsError as error:
            raise StageError(
                f"{self._name}: this file exists; set overwrite: true to replace it, or give another path"
            ) from error
        self._late = list(references)

    def begin_next(self, references: Sequence[Entry]) -> None:
        """Open a numbered file. references : as of `begin`.

        Raises
        ------
        StageError
            If it cannot be written.
        """
        while True:
            # Between the two, another run may take the name.
            with suppress(FileExistsError):
                self._open(next_name(self._name), overwrite=False)
                break
        log.info("record: %s", self.path)
        self._late = list(references)

    def write(self, entry: Entry) -> None:
        """Write one frame; where the file is large or long enough, into a further one.

        Raises
        ------
        StageError
            If it cannot be written, or another program has taken the file away. No file is open then.
        """
        assert self._file is not None
        if self._is_full(self._file, entry):
            self.finish()
            self.begin_next([reference for reference in self._in_force if reference.epoch == entry.epoch])
        self._write(self._file, entry)

    def finish(self) -> None:
        """Finish the file. Raises StageError as `write` does."""
        file, self._file = self._file, None
        assert file is not None
        self._refuse_interference(file)
        try:
            file.finish()
        except OSError as error:
            self._give_up(file, error)
        self.files += 1
        self.bytes += file.bytes

    def _open(self, path: Path, *, overwrite: bool) -> None:
        """Raises FileExistsError if the file is there, StageError if it cannot be written."""
        try:
            self._file = RecordingWriter(path, self._about(), overwrite=overwrite)
        except FileExistsError:
            raise
        except OSError as error:
            raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
        self.path = path

    def _write(self, file: RecordingWriter, entry: Entry) -> None:
        self._refuse_interference(file)
        if file.frames == 0:
            self._file_begins, self._in_force = entry.time, []
        try:
            # The references of before stand where the file's time line begins, without results of that time.
            for reference in self._late:
                file.write(replace(reference, message=None, picture=None, annotations=None), entry.time)
            file.write(entry)
        except OSError as error:
            self._give_up(file, error)
        new = [*self._late, *([entry] if entry.reference else [])]
        if new:
            self._in_force = [reference for reference in self._in_force if reference.epoch == new[-1].epoch]
            self._in_force += new
        self._late = []
        self.frames += 1

    def _is_full(self, file: RecordingWriter, entry: Entry) -> bool:
        """Whether an entry is to go into another file."""
        size, after = self._rotate_size, self._rotate_after
        return file.frames > 0 and (
            (size is not None and file.bytes >= size * 1_000_000)
            or (after is not None and entry.time - self._file_begins >= after * 1e9)
        )

    def _refuse_interference(self, file: RecordingWriter) -> None:
        what = file.interference()
        if what is None:
            return
        self._file = None
        file.abandon()
        lost = "what was cut off is lost" if what == "cut" else f"its {file.frames} frames are not in it"
        raise StageError(f"{file.path}: was {what} by another program while the run recorded to it; {lost}")

    def _give_up(self, file: RecordingWriter, error: OSError) -> None:
        self._file = None
        file.abandon()
        hint = "free some space, then " if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        raise StageError(
            f"{file.path}: cannot be written: {error.strerror or error}; the {file.frames} frames written "
            f"before are complete and can be played; {hint}tactflow repair {file.path} adds the index"
        ) from error
