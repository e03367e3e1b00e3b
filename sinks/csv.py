"""CSV: a table with one row per frame, for spreadsheets and plotting programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import Any

import orjson
from pydantic import Field

from tactflow.engine.control import Control
from tactflow.message.columns import scalar_columns
from tactflow.message.lines import LineParams, LineSink
from tactflow.message.result import Result, encode_message


class Csv(LineSink):
    """Writes one row per frame to a file, a pipe or standard output.

    The columns are the numbers and words of the result message under its names, such as
    `contact.area [px^2]`; lists, such as the outline and the dots, are left out. Parts of the message that no
    stage of the pipeline computes have no columns. A value that is null is an empty cell.

    The unit stands behind the name, because a second line of units would turn each column into text for
    spreadsheets, pandas and R.

    >>> from pathlib import Path
    >>> import tactflow
    >>> settings = {"sinks": {"csv": {"path": "a.csv"}}}
    >>> result = tactflow.run("markerless", source="sim:unmarked", settings=settings, max_frames=3)
    >>> Path("a.csv").read_text().split(",")[:3]
    ['sensor', 'seq', 't [s]']
    """

    class Params(LineParams):
        """Destination and content."""

        path: str = Field(
            "results.csv", min_length=1, description="file, relative to the current directory; - is stdout"
        )
        detail: bool = Field(
            False, description="also confidence, rotation, divergence, shear, standard errors"
        )

    def __init__(self, params: Params, control: Control | None = None) -> None:
        """Prepare; nothing is opened yet.

        control : the run, which may be live, and whose stages determine the columns; None: all columns.
        """
        super().__init__(params, control)
        ports = None if control is None else control.pipeline.ports
        self._columns = scalar_columns(ports, detail=params.detail)
        self.header = _row(column.heading for column in self._columns)

    def line(self, result: Result) -> bytes:
        """The row of a frame."""
        message = orjson.loads(encode_message(result, detail=self.params.detail))
        return _row(_cell(column.value(message)) for column in self._columns)


def _row(cells: Iterable[Any]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue().encode()


def _cell(value: Any) -> Any:
    """Booleans as in JSON, and named words, such as the reasons in `skipped`, as one text."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "; ".join(f"{name}: {word}" for name, word in value)
    return value
