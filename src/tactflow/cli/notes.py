"""The program's notes and warnings on standard error."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from rich.console import Console
from rich.logging import RichHandler

from tactflow.cli.printable import printable


def say(words: str) -> None:
    """Tell the user something that is no result: on standard error, safe for a terminal."""
    print(printable(words), file=sys.stderr)


@contextmanager
def notes_on(console: Console) -> Iterator[None]:
    """Show notes and warnings while the context lasts. console : of standard error."""
    logger = logging.getLogger("tactflow")
    handler: logging.Handler
    if console.is_terminal:
        handler = RichHandler(console=console, show_time=False, show_path=False, markup=False)
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("tactflow: %(levelname)s: %(message)s"))
    handler.addFilter(_without_control_characters)
    logger.addHandler(handler)
    try:
        with _from_level(logging.INFO):
            yield
    finally:
        logger.removeHandler(handler)


def without_notes() -> AbstractContextManager[None]:
    """Keep notes and warnings of pipelines that run many times off the screen; errors still show."""
    return _from_level(logging.ERROR)


@contextmanager
def _from_level(level: int) -> Iterator[None]:
    logger = logging.getLogger("tactflow")
    before = logger.level
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)


def _without_control_characters(record: logging.LogRecord) -> bool:
    """Lets every note pass, made safe for a terminal."""
    record.msg, record.args = printable(record.getMessage()), ()
    return True
