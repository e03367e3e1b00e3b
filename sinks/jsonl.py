"""JSON Lines: one result message per frame, one line each."""

from __future__ import annotations

from pydantic import Field

from tactflow.message.lines import LineParams, LineSink
from tactflow.message.result import MessageParams, Result, encode_message


class Jsonl(LineSink):
    """Writes result messages as complete lines to a file, a pipe or standard output.

    Lines reach a file at least every `flush` seconds and at the end, and standard output at once. If the
    reader of standard output closes it, the sink requests no more frames. A recording waits for a slow
    reader; in a live run, lines are dropped and counted instead.

    >>> from pathlib import Path
    >>> import tactflow
    >>> settings = {"sinks": {"jsonl": {"path": "a.jsonl"}}}
    >>> result = tactflow.run("markerless", source="sim:unmarked", settings=settings, max_frames=3)
    >>> len(Path("a.jsonl").read_text().splitlines())
    3
    """

    class Params(MessageParams, LineParams):
        """Destination and content."""

        path: str = Field(
            "results.jsonl", min_length=1, description="file, relative to the current directory; - is stdout"
        )

    def line(self, result: Result) -> bytes:
        """The result message."""
        return encode_message(result, detail=self.params.detail, field=self.params.field)
