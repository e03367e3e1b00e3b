"""The process of the program: `tactflow`, and `python -m tactflow`, which is the same.

It handles signals from the first moment on, and ends with the right exit code whatever happens to its output.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading

from tactflow.system.signals import ENDING_SIGNALS, INTERRUPTED_EXIT_CODE, interrupt, on_ending

ENDLESS = ("run", "record", "listen")
"""Commands that run until they are stopped: one signal ends them with exit code 0."""


def entry() -> None:
    """Run the program with the arguments of this process, and end the process with its exit code."""
    # Before anything else is imported, which takes a while.
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), None)
    is_endless = command in ENDLESS
    # Exit rather than raise: an import might swallow or print an exception.
    on_ending(lambda _number, _frame: os._exit(0 if is_endless else INTERRUPTED_EXIT_CODE))
    from tactflow.cli.main import main
    from tactflow.system.files import LossyStream, discard_output

    # A service may be started without standard streams.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (until the end)
    sys.stderr = LossyStream(sys.stderr)
    # File names may contain characters that the terminal or UTF-8 cannot represent.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        # A run handles them itself when it has started.
        code = main(sys.argv[1:], lambda: is_endless or on_ending(interrupt))
        sys.stdout.flush()
    except OSError as error:
        # The reader of our output has left, or the disk is full.
        discard_output(sys.stdout)
        code = 0
        if not isinstance(error, BrokenPipeError):
            # An error without a file name comes from asking for the current folder.
            unnamed = "the current folder" if isinstance(error, FileNotFoundError) else "standard output"
            print(f"tactflow: {error.filename or unnamed}: {error.strerror or error}", file=sys.stderr)
            code = 3
    except KeyboardInterrupt:
        # The reader of our output does not read.
        discard_output(sys.stdout)
        code = INTERRUPTED_EXIT_CODE
    # From here on nothing changes the exit code.
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if code != 0 and threading.active_count() > 1:
        # Threads of an aborted run may be in OpenCV, which would abort the process while Python ends.
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    entry()
