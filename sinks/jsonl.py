"""JSON Lines: one result message per frame, one line each."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Sink, StageParams
from tactflow.engine.control import Control
from tactflow.message.result import Result, encode_message
from tactflow.system.files import expanded, is_device
from tactflow.system.lines import LineFile, LineStream
from tactflow.system.outputs import refuse_existing


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
        self.description = "standard output" if params.path == "-" else params.path
        self._out: LineFile | LineStream | None = None
        self._closed = False

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

        Raises StageError if the file exists and neither `overwrite` nor `append` is set, or it cannot be
        written.
        """
        path, p = expanded(self.params.path), self.params
        if p.path == "-" or is_device(p.path):
            self._out = LineStream(p.path, self._control)
            return
        empty = path.is_file() and path.stat().st_size == 0
        changes = p.overwrite or p.append or empty
        refuse_existing(path, overwrite=changes, advice="append: true to continue it, ")
        self._out = LineFile(path, replaces=p.overwrite, every=p.flush)

    def wants(self) -> bool:
        """False once the reader of standard output has gone away."""
        return self._out is not None and not self._closed and not self._out.ended

    def counters(self) -> dict[str, int]:
        """lines : written so far. dropped : lines that the reader of a pipe did not take."""
        lines = 0 if self._out is None else self._out.delivered
        dropped = {"dropped": self._out.dropped} if isinstance(self._out, LineStream) else {}
        return {"lines": lines} | dropped

    def write(self, result: Result) -> None:
        """Add one line.

        Raises StageError if the file cannot be written, for instance because the disk is full. The file then
        ends with the last line that fitted.
        """
        if self._out is not None and self.wants():
            p = self.params
            self._out.send(encode_message(result, detail=p.detail, field=p.field))

    def close(self) -> None:
        """Write what is left and close the file.

        Raises StageError if that is not possible, or the reader of a pipe did not take all lines of a
        recording.
        """
        if self._out is not None and not self._closed:
            self._closed = True
            self._out.close()
