"""What `tactflow batch` tells people while it goes on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from tactflow.batch.executor import Executor
from tactflow.batch.run import Plan
from tactflow.batch.task import Outcome
from tactflow.cli.printable import printable

DRAW_EVERY = 0.5
"""Time between two pictures of the progress, s. Chosen by hand."""


_MOST_WORKERS = 16
"""Workers that are shown. Chosen by hand: they fit on a terminal."""
_LONGEST = 200
"""Letters of a message in a list of many. Chosen by hand."""


class BatchDisplay:
    """Counts, and shows on a terminal how far each worker is and when all will be done."""

    def __init__(self, console: Console, plan: Plan, live: Live | None, *, talks: bool) -> None:
        self._console = console
        self._live = live
        self._talks = talks
        self._total = len(plan.left)
        self._began = time.monotonic()
        self._drawn = 0.0
        self._count = self._failed = self._frames = 0
        self._rates: dict[str, float] = {}

    def told(self, outcome: Outcome) -> None:
        """Count an outcome; one that failed is named at once."""
        self._count += 1
        self._frames += outcome.frames
        if outcome.seconds > 0:
            self._rates[outcome.worker] = outcome.frames / outcome.seconds
        if outcome.status != "done":
            self._failed += 1
            if self._talks:
                text = f"{outcome.status}: {outcome.name}: {in_short(outcome)}"
                self._console.print(printable(text), markup=False)

    def shown(self, executor: Executor, left: int) -> None:
        """Draw, if it is time to."""
        now = time.monotonic()
        if self._live is None or now - self._drawn < DRAW_EVERY:
            return
        self._drawn = now
        self._live.update(self.picture(executor, left, now - self._began))

    def picture(self, executor: Executor, left: int, elapsed: float) -> Table:
        """What is shown.

        left : recordings. elapsed : s.
        """
        table = Table.grid(padding=(0, 2))
        rate = self._frames / elapsed if elapsed > 0 else 0.0
        table.add_row(
            f"{self._count} of {self._total}, {self._failed} failed",
            f"{rate:.0f} frames/s",
            f"{_time(elapsed)} so far, {_estimate(self._count, left, elapsed)}",
        )
        at_work = executor.headway()
        if not at_work:
            for name in sorted(self._rates)[:_MOST_WORKERS]:
                table.add_row(f"  worker {name}", self._pace(name))
        for worker in at_work[:_MOST_WORKERS]:
            what = "waits" if worker.task is None else worker.task.recording.name
            frames = f"{worker.frames} of {worker.total or '?'} frames" if worker.task else ""
            table.add_row(
                f"  worker {worker.worker}", self._pace(worker.worker), escape(printable(what)), frames
            )
        return table

    def _pace(self, worker: str) -> str:
        """How fast a worker was in its last recording."""
        return f"{self._rates[worker]:.0f} frames/s" if worker in self._rates else ""


def in_short(outcome: Outcome) -> str:
    """Why a recording failed, in a line; the table and the page have all of it."""
    text = (outcome.error or "").partition("\n")[0]
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def _estimate(count: int, left: int, elapsed: float) -> str:
    """When it will be done, as the recordings so far tell."""
    if count == 0:
        return "the end is not known yet"
    return f"about {_time(elapsed * left / count)} to go"


def _time(seconds: float) -> str:
    """For people.

    >>> _time(59), _time(3600), _time(200000)
    ('59 s', '60 min', '55.6 h')
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


@contextmanager
def batch_display(console: Console, plan: Plan, executor: Executor, *, shown: bool) -> Iterator[BatchDisplay]:
    """A display that is drawn on a terminal only; elsewhere it says what failed."""
    if shown:
        console.print(f"on {executor.description}", markup=False)
    if not shown or not console.is_terminal or not plan.left:
        yield BatchDisplay(console, plan, None, talks=shown)
        return
    with Live(console=console, transient=True, auto_refresh=False) as live:
        yield BatchDisplay(console, plan, live, talks=True)
