"""The signals that ask a program to end."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Ctrl-C, a service manager, a terminal that is closed."""

INTERRUPTED = 130
"""Exit code of a program that was not allowed to finish what was under way."""

Handler = Callable[[int, FrameType | None], object]


class Interrupted(KeyboardInterrupt):
    """What a handler raises in the main thread to end what is under way.

    After a KeyboardInterrupt itself, raised within `exec` of a text, as numba does it, `python -m` ends by
    SIGINT whatever the exit code is, even if it was caught.
    """


def leave(_number: int, _frame: FrameType | None) -> None:
    """Handler while a run starts: nothing is under way that could be finished, so it ends well, at once.

    Nothing is raised: what is being imported might swallow it, or show it.
    """
    os._exit(0)


def give_up(_number: int, _frame: FrameType | None) -> None:
    """Handler while any other command starts, which has given nothing yet: it ends at once, too."""
    os._exit(INTERRUPTED)


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """Handler that ends what is under way; a second signal does not keep it from tidying up.

    A third is not caught.
    """
    on_ending(lambda _number, _frame: on_ending(signal.SIG_DFL))
    raise Interrupted


def interrupt_from_now_on() -> None:
    """Have each of them interrupt, if so far it would have made the program give up."""
    for number in ENDING:
        if signal.getsignal(number) is give_up:
            signal.signal(number, interrupt)


def on_ending(handler: Handler | signal.Handlers) -> dict[int, object]:
    """Have a handler called for each of them; returns what was called before.

    One that is ignored stays so: who started the program with nohup wants it to go on. So does
    one that a host written in C handles, which Python could not give back.
    """
    listened = [number for number in ENDING if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    return {number: signal.signal(number, handler) for number in listened}


@contextmanager
def ending_handled(handler: Handler) -> Iterator[None]:
    """Have a handler called for each of them while a block lasts.

    After a start that `leave` could have ended, the block was the run, whose end no signal changes any more.
    """
    before = on_ending(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, signal.SIG_IGN if earlier is leave else earlier)  # type: ignore[arg-type]


@contextmanager
def ending_held_back() -> Iterator[None]:
    """Handle those that come in a block after it: what the block does is whole, and its result is known."""
    if threading.current_thread() is not threading.main_thread():
        # Handlers are called in the main thread.
        yield
        return
    came: list[int] = []
    handled = [number for number in ENDING if callable(signal.getsignal(number))]
    before = [signal.signal(number, lambda number, _: came.append(number)) for number in handled]
    # Each of them, whatever the block raised, and whatever the handler raises for the first.
    with ExitStack() as afterwards:
        try:
            yield
        finally:
            for number, earlier in zip(handled, before, strict=True):
                signal.signal(number, earlier)
            for number in reversed(came):
                afterwards.callback(signal.raise_signal, number)
