"""Where the program begins: `tactflow`, and `python -m tactflow`, which is the same."""

from __future__ import annotations

import gc
import sys
from collections.abc import Sequence

from tactflow.system.signals import give_up, leave, on_ending

ENDLESS = ("run", "record", "listen")
"""Commands that one signal ends well."""


def entry() -> None:
    """Entry point of the console script."""
    # Before all else is imported, which takes a while. To be ended by a service, by a terminal that is closed
    # or by Ctrl-C is the same.
    on_ending(leave if wanted(sys.argv[1:]) in ENDLESS else give_up)
    # Nothing that is imported becomes garbage: to look for it there takes a twelfth of the start.
    gc.disable()
    from tactflow.cli import main

    main.entry()


def wanted(argv: Sequence[str]) -> str | None:
    """The word of a command line that stands for the command."""
    return next((word for word in argv if not word.startswith("-")), None)


if __name__ == "__main__":
    entry()
