"""Signals that end a program."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Ctrl-C, a service manager, a terminal that is closed."""

INTERRUPTED_EXIT_CODE = 130
"""Exit code of a program that was interrupted before it had finished pending work."""

Handler = Callable[[int, FrameType | None], object]


class Interrupted(KeyboardInterrupt):
    """Raised by a handler in the main thread to end pending work.

    After a KeyboardInterrupt within `exec` of a text, as in dataclasses, `python -m` would end by SIGINT,
    whatever the exit code, even if the exception was caught.
    """


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """Handler that ends pending work; a second signal does not prevent the clean-up, a third kills."""
    on_ending(lambda _number, _frame: on_ending(signal.SIG_DFL))
    raise Interrupted


def on_ending(handler: Handler | signal.Handlers) -> dict[int, object]:
    """Install a handler for each signal; returns the earlier ones.

    Ignored signals remain ignored, as nohup requires. So do signals handled by a host program in C, whose
    handler Python could not restore.
    """
    handled = [number for number in ENDING_SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    return {number: signal.signal(number, handler) for number in handled}


@contextmanager
def ending_handled(handler: Handler) -> Iterator[None]:
    """Install a handler for each signal within a block."""
    before = on_ending(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)  # type: ignore[arg-type]
