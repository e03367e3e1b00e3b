"""Watches a parser: it may refuse its input, but neither fail, hang nor take memory beyond measure."""

from __future__ import annotations

import faulthandler
import hashlib
import logging
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HANGS_AFTER = 60.0
"""Time after which one input counts as one that hangs, s: a thousand times what they take. Chosen by hand."""
ALLOWANCE = 48 << 20
"""Memory that an input may take whatever its size, bytes: what is imported and cached on the way, and a
picture as large as `tests.fuzz.__main__` allows, a few times. Chosen by hand."""
FACTOR = 64
"""And so many times its size: a value of a YAML list is an object with its place, of a byte or two."""


@dataclass
class Findings:
    """What went wrong, once for each place in the code, with the first input that shows it.

    folder : where the inputs are kept.
    """

    folder: Path
    inputs: int = 0
    refused: int = 0
    found: dict[tuple[str, str, str], Path] = field(default_factory=dict[tuple[str, str, str], Path])

    def add(self, target: str, kind: str, place: str, data: bytes) -> None:
        """Keep a finding, unless its like is known."""
        key = (target, kind, place)
        if key in self.found:
            return
        path = self.folder / f"{target}-{hashlib.sha256(data).hexdigest()[:12]}"
        path.write_bytes(data)
        self.found[key] = path
        print(f"FOUND {target}: {kind}\n      {place}\n      {path}", file=sys.stderr, flush=True)


def try_input(
    findings: Findings,
    target: str,
    feed: Callable[[bytes], object],
    data: bytes,
    refusals: tuple[type[Exception], ...],
) -> None:
    """Give a parser one input. A crash or a hang ends the process; the input is then in `current-TARGET`."""
    current = findings.folder / f"current-{target}"
    current.write_bytes(data)
    findings.inputs += 1
    faulthandler.dump_traceback_later(HANGS_AFTER, exit=True)
    before = _forget_peak()
    try:
        with _complaints() as complaints:
            feed(data)
    except refusals:
        findings.refused += 1
    except Exception as error:
        findings.add(target, f"{type(error).__name__}: {str(error)[:200]}", _place(error), data)
    finally:
        faulthandler.cancel_dump_traceback_later()
    for complaint in complaints:
        findings.add(target, "failed in the background", complaint, data)
    taken = _peak() - before
    if taken > ALLOWANCE + FACTOR * len(data):
        findings.add(target, "memory", f"{taken >> 20} MB for {len(data)} bytes", data)
    current.unlink()


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """What fails in other threads and in event loops, where nobody would see it."""
    found: list[str] = []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            error = record.exc_info[1] if record.exc_info else None
            found.append(_place(error) if error else record.getMessage())

    def failed(arguments: Any) -> None:
        found.append(_place(arguments.exc_value))

    handler = Collect(logging.ERROR)
    loggers = [logging.getLogger(name) for name in ("asyncio", "uvicorn.error", "websockets")]
    before, threading.excepthook = threading.excepthook, failed
    for logger in loggers:
        logger.addHandler(handler)
        logger.propagate = False
    try:
        yield found
    finally:
        threading.excepthook = before
        for logger in loggers:
            logger.removeHandler(handler)


def _place(error: BaseException) -> str:
    last = traceback.extract_tb(error.__traceback__)[-3:]
    return f"{type(error).__name__} at " + " > ".join(f"{Path(f.filename).name}:{f.lineno}" for f in last)


def _forget_peak() -> int:
    """Begin to measure the peak of this process' memory anew; what it has now, bytes (0 but on Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return 0
    return _memory("VmRSS")


def _peak() -> int:
    return _memory("VmHWM")


def _memory(key: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(key))
