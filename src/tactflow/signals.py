"""The signals that ask a program to end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Ctrl-C, a service manager, a terminal that is closed."""

Handler = Callable[[int, FrameType | None], None]


def on_ending(handler: Handler) -> dict[int, object]:
    """Have a handler called for each of them; returns what was called before.

    One that is ignored stays so: who started the program with nohup wants it to go on.
    """
    listened = [number for number in ENDING if signal.getsignal(number) != signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in listened}


@contextmanager
def ending_handled(handler: Handler) -> Iterator[None]:
    """Have a handler called for each of them while a block lasts."""
    before = on_ending(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)  # type: ignore[arg-type]
