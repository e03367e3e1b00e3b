"""JSON Lines: one result message per frame, one line each."""

from __future__ import annotations

import errno
import logging
import sys
import time
from collections.abc import Sequence
from contextlib import suppress

from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Sink, StageParams
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.message.result import Result, encode_message
from tactflow.system.files import expanded, is_device, lead_nowhere, make_folder
from tactflow.system.lines import LineFile, LineStream, open_pipe

log = logging.getLogger("tactflow")


class Jsonl(Sink):
    """Writes result messages to a file, a pipe or standard output, complete lines only.

    Lines reach a file at least every `flush` seconds of frames and at the end, and standard output at once.
    When the reader of standard output goes away, the sink falls silent and wants nothing more. A recording
    waits for a reader who is slow; in a live run, the lines that he does not take are dropped and counted.
    """

    threaded = True
    queue_capacity = 16

    class Params(StageParams):
        """Where to write, and what to do with a file that is there already."""

        path: str = Field(
            "results.jsonl", min_length=1, description="file, relative to the current directory; - is stdout"
        )
        overwrite: bool = Field(False, description="replace an existing file")
        append: bool = Field(False, description="continue an existing file")
        flush: float = Field(
            0.5, ge=0, description="longest time that lines wait before they reach the file, s; 0 is at once"
        )
        detail: bool = Field(
            False,
            description="also write confidence, rotation, divergence, shear, residual, standard errors",
        )
        field: bool = Field(
            False, description="also write the displacement field of the stage field: some 100 kB a frame"
        )

        @model_validator(mode="after")
        def _one_of_both(self) -> Jsonl.Params:
            if self.overwrite and self.append:
                raise ValueError("overwrite and append exclude each other")
            return self

    def __init__(self, params: Params, control: Control | None = None) -> None:
        """Prepare; nothing is opened yet.

        control : the run, which knows whether a slow reader is waited for; None: he is.
        """
        super().__init__(params)
        self._control = control
        self._name = "standard output" if params.path == "-" else params.path
        self.description = self._name
        self._out: LineFile | LineStream | None = None
        self._pending: list[bytes] = []
        self._flushed = 0.0
        self._counts = {"lines": 0}

    @classmethod
    def outputs(cls, params: Jsonl.Params) -> Sequence[Output]:
        """The file, or none for standard output."""
        if params.path == "-":
            return ()
        keeps = not (params.overwrite or params.append)
        return (Output(expanded(params.path), "file", "path", refuses_existing=keeps),)

    @classmethod
    def on_restart(cls, params: Jsonl.Params) -> Jsonl.Params:
        """It continues its file."""
        return params.changed(overwrite=False, append=True)

    def open(self) -> None:
        """Open or create the file, and its folder; of a pipe, wait for its reader.

        Raises
        ------
        StageError
            If the file exists and neither `overwrite` nor `append` is set, or it cannot be written.
        """
        path, p = expanded(self.params.path), self.params
        try:
            if p.path == "-":
                self._out = LineStream(sys.stdout.buffer, self._waits)
            elif is_device(p.path):
                pipe = open_pipe(path, lambda: not self._hurried)
                self._out = None if pipe is None else LineStream(pipe, self._waits)
            elif path.is_file() and path.stat().st_size > 0 and not (p.overwrite or p.append):
                raise StageError(
                    f"{path}: this file exists; set overwrite: true to replace it, append: true to continue "
                    "it, or give another path"
                )
            else:
                make_folder(path.parent)
                self._out = LineFile(path, replaces=p.overwrite, continues=p.append)
        except OSError as error:
            raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._flushed = time.monotonic()

    @property
    def _hurried(self) -> bool:
        return self._control is not None and self._control.hurried

    @property
    def _live(self) -> bool:
        source = None if self._control is None else self._control.source
        return source is not None and source.live

    def _waits(self) -> bool:
        """Whether to wait for a slow reader."""
        return not self._live and not self._hurried

    def wants(self) -> bool:
        """False once the reader of standard output has gone away."""
        return self._out is not None

    def counters(self) -> dict[str, int]:
        """lines : written so far. dropped : lines that the reader of a pipe did not take."""
        if isinstance(self._out, LineStream):
            return {"lines": self._out.delivered, "dropped": self._out.dropped}
        return self._counts if self._out is None else {"lines": self._out.delivered}

    def write(self, result: Result) -> None:
        """Add one line.

        Raises
        ------
        StageError
            If the file cannot be written, for instance because the disk is full. The file then ends with the
            last line that fitted.
        """
        if self._out is None:
            return
        self._pending.append(encode_message(result, detail=self.params.detail, field=self.params.field))
        now = time.monotonic()
        if self.params.path == "-" or now - self._flushed >= self.params.flush:
            self._flushed = now
            self._flush(self._out)

    def close(self) -> None:
        """Write what is left and close the file.

        Raises
        ------
        StageError
            If that is not possible, or the reader of a pipe did not take all lines of a recording.
        """
        out = self._out
        if out is None:
            return
        try:
            self._flush(out, last=True)
            if out.dropped and not self._live:
                raise StageError(
                    f"{self._name}: its reader took only {out.delivered} lines before the run was stopped; "
                    f"{out.dropped} more are lost"
                )
        finally:
            self._counts = self.counters()
            self._out = None
            if self.params.path != "-":
                with suppress(OSError):
                    out.close()

    def _flush(self, out: LineFile | LineStream, *, last: bool = False) -> None:
        lines, self._pending = self._pending, []
        already = out.dropped
        try:
            out.send(lines)
            if last:
                out.finish()
        except OSError as error:
            if self.params.path == "-" and error.errno in (errno.EPIPE, errno.ECONNRESET):
                log.debug("standard output was closed by its reader")
                self._counts = self.counters()
                self._out = None
                lead_nowhere(sys.stdout)
                return
            raise StageError(
                f"{self._name}: cannot be written: {error.strerror or error}; "
                f"the {out.delivered} lines written before are complete"
            ) from error
        if out.dropped and not already:
            log.warning("%s: its reader is too slow: lines are dropped", self._name)
