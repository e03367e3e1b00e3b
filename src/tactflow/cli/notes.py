"""The program's notes and warnings on standard error."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.logging import RichHandler

from tactflow.cli.printable import printable


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
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _without_control_characters(record: logging.LogRecord) -> bool:
    """Lets every note pass, made safe for a terminal."""
    record.msg, record.args = printable(record.getMessage()), ()
    return True
