"""Output on a terminal: text, notes and warnings, tables, progress."""

from __future__ import annotations

import logging
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Final

import orjson


def printable(line: str) -> str:
    """One line from files, cameras and the network, without characters that control a terminal.

    Line breaks and changes of the writing direction are among them: no name can forge a second line.

    >>> printable("left\\x1b[2J, no\\ttab, \\u202etxt\\nOK")
    'left?[2J, no\\ttab, ?txt?OK'
    """
    return "".join(letter if letter.isprintable() or letter == "\t" else "?" for letter in line)


def typed(*words: str) -> str:
    """Words of a command line as a user types them, with quotes where they are needed.

    >>> typed("tactflow", "run", "left.yaml")
    'tactflow run left.yaml'
    """
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)


def show(lines: Iterable[str]) -> None:
    """Print results, one line each, on standard output."""
    print("\n".join(map(printable, lines)))


def show_json(value: object) -> None:
    """Print a result as JSON on standard output: dicts, lists, dataclasses, arrays."""
    options = orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS
    print(orjson.dumps(value, option=options).decode())


def say(text: str) -> None:
    """Print a message on standard error. All lines but the first are indented.

    So a name with line breaks cannot imitate a message of the program.
    """
    print("\n  ".join(map(printable, text.split("\n"))), file=sys.stderr)


def table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of a table with aligned columns.

    >>> list(table([("hull", "stage"), ("zmq", "sink")]))
    ['hull  stage', 'zmq   sink']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def markdown(
    title: str, text: str = "", columns: Sequence[str] = (), rows: Sequence[Sequence[object]] = ()
) -> Iterator[str]:
    """Lines of a section in Markdown: a heading, a text and a table with aligned columns.

    >>> print(*markdown("Times", "CPU", ["method", "ms"], [["fast", 1.25], ["exact", 31]]), sep="\\n")
    ### Times
    <BLANKLINE>
    CPU
    <BLANKLINE>
    | method | ms   |
    | ------ | ---- |
    | fast   | 1.25 |
    | exact  | 31   |
    <BLANKLINE>
    """
    yield from (f"### {title}", "", *([*text.splitlines(), ""] if text else []))
    if columns:
        cells = [
            [str(cell).replace("|", "\\|").replace("\n", " ") for cell in row] for row in (columns, *rows)
        ]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        cells.insert(1, ["-" * width for width in widths])
        yield from (f"| {' | '.join(map(str.ljust, row, widths))} |" for row in cells)
        yield ""


@contextmanager
def notes(level: str = "INFO") -> Iterator[None]:
    """Show the notes of tactflow from this level on, on standard error, while the block lasts."""
    logger, handler = logging.getLogger("tactflow"), _Notes()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


class _Notes(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        say(f"tactflow: {record.levelname}: {record.getMessage()}")


LINE_PERIOD_S: Final = 10.0
"""Least time between two lines of progress, s: a log of an hour stays short, and nobody thinks it hangs."""


@contextmanager
def progress_bar(
    description: str, total: float | None = None, *, shown: bool = True, lines: bool = False
) -> Iterator[Callable[..., None]]:
    """A progress bar on standard error, on a terminal only, removed when the block ends.

    Gives a function that updates it: `update(completed=3, total=10, description="rendering")`. lines : print
    the description every ten seconds where there is no terminal.
    """
    if not shown or not sys.stderr.isatty():
        yield _lines_of_progress() if shown and lines else lambda **_: None
        return
    # Imported here because rich takes a while, and many commands run without a terminal.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn())
    times = (TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, *times, console=Console(stderr=True), transient=True) as display:
        yield partial(display.update, display.add_task(printable(description), total=total))


def _lines_of_progress() -> Callable[..., None]:
    """A function that takes what updates a bar, and prints a line now and then."""
    began = last = time.monotonic()
    share = ""

    def update(description: str = "", completed: float = 0.0, total: float | None = None) -> None:
        nonlocal last, share
        if total:
            share = f", {completed:g} of {total:g} done"
        now = time.monotonic()
        if now - last >= LINE_PERIOD_S:
            last = now
            say(f"tactflow: {now - began:.0f} s{share}: {description}")

    return update
