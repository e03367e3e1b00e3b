"""JSON Lines: one result message per frame, one line each."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from tactflow.engine.contract import Output
from tactflow.engine.control import Control
from tactflow.message.lines import LineFile, LineStream
from tactflow.message.result import MessageParams, Result, encode_message
from tactflow.outputs import AppendParams, OutputSink
from tactflow.system.files import expanded, is_device


class Jsonl(OutputSink):
    """Writes result messages as complete lines to a file, a pipe or standard output.

    Lines reach a file at least every `flush` seconds and at the end, and standard output at once. If the
    reader of standard output closes it, the sink requests no more frames. A recording waits for a slow
    reader; in a live run, lines are dropped and counted instead.
    """

    queue_capacity = 16

    class Params(MessageParams, AppendParams):
        """Destination and content."""

        path: str = Field(
            "results.jsonl", min_length=1, description="file, relative to the current directory; - is stdout"
        )
        flush: float = Field(0.5, ge=0, description="longest time that lines are buffered, s; 0: not at all")

    def __init__(self, params: Params, control: Control | None = None) -> None:
        """Prepare; nothing is opened yet.

        control : the run, which may be live; None: a slow reader is waited for.
        """
        super().__init__(params)
        self._control = control
        self.description = "standard output" if params.path == "-" else params.path
        self._out: LineFile | LineStream | None = None
        self._closed = False

    @classmethod
    def outputs(cls, params: Jsonl.Params) -> Sequence[Output]:
        """The file, or none for standard output."""
        return () if params.path == "-" else super().outputs(params)

    def open(self) -> None:
        """Open or create the file and its folder, or wait for the reader of a pipe.

        Raises StageError if the file exists and neither `overwrite` nor `append` is set, another run is
        writing to it, or it cannot be written.
        """
        p = self.params
        if p.path == "-" or is_device(p.path):
            self._out = LineStream(p.path, self._control)
        else:
            self._out = LineFile(expanded(p.path), replaces=p.overwrite, continues=p.append, every=p.flush)

    def wants(self) -> bool:
        """False once the reader of standard output has closed it."""
        return self._out is not None and not self._closed and not self._out.ended

    def counters(self) -> dict[str, int]:
        """lines : written so far. dropped : lines not read from a pipe in time."""
        lines = 0 if self._out is None else self._out.delivered
        dropped = {"dropped": self._out.dropped} if isinstance(self._out, LineStream) else {}
        return {"lines": lines} | dropped

    def write(self, result: Result) -> None:
        """Add one line.

        Raises StageError if the file cannot be written, for instance on a full disk. The file then ends with
        its last complete line.
        """
        if self._out is not None and self.wants():
            p = self.params
            self._out.send(encode_message(result, detail=p.detail, field=p.field))

    def close(self) -> None:
        """Write buffered lines and close the file.

        Raises StageError if that fails, or the reader of a pipe did not read all lines of a recording.
        """
        if self._out is not None and not self._closed:
            self._closed = True
            self._out.close()
