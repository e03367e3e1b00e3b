"""The signals that ask a program to end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Ctrl-C, a service manager, a terminal that is closed."""

INTERRUPTED = 130
"""Exit code of a program that was not allowed to finish what was under way."""

Handler = Callable[[int, FrameType | None], object]


class Interrupted(KeyboardInterrupt):
    """Raised by a handler in the main thread to end what is under way.

    Not KeyboardInterrupt itself: where that is raised within `exec` of a text, as numba uses it, `python -m`
    ends by SIGINT whatever the exit code is, even if the exception was caught.
    """


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """Handler that ends what is under way; a second signal does not prevent the clean-up, a third kills."""
    on_ending(lambda _number, _frame: on_ending(signal.SIG_DFL))
    raise Interrupted


def on_ending(handler: Handler | signal.Handlers) -> dict[int, object]:
    """Install a handler for each signal; returns the earlier ones.

    A signal that is ignored stays so: nohup asks a program to go on. So does one handled by a host written in
    C, whose handler Python could not restore.
    """
    handled = [number for number in ENDING if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    return {number: signal.signal(number, handler) for number in handled}


@contextmanager
def ending_handled(handler: Handler) -> Iterator[None]:
    """Have a handler called for each signal while a block lasts."""
    before = on_ending(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)  # type: ignore[arg-type]


@contextmanager
def ending_held_back() -> Iterator[None]:
    """Let signals that come during a block be handled after it: what the block does is complete then."""
    if threading.current_thread() is not threading.main_thread():
        # Signals are handled in the main thread.
        yield
        return
    pending: list[int] = []
    try:
        with ending_handled(lambda number, _: pending.append(number)):
            yield
    finally:
        for number in pending:
            signal.raise_signal(number)
