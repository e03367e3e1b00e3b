"""`tactflow warmup`: compile what `run` would compile on its first use."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tactflow.cli.options import add_pipeline
from tactflow.config.load import load_pipeline, sensor_names
from tactflow.config.shipped import find_pipeline
from tactflow.vision import compiled


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `warmup`."""
    add_pipeline(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def run(args: argparse.Namespace) -> int:
    """Compile the kernels of a pipeline; returns the exit code. Raises ConfigError if it is wrong."""
    file = find_pipeline(args.pipeline)
    # To load a pipeline imports its stages, and with them their kernels.
    sensors: list[str | None] = [*sensor_names(file, args.overrides)]
    for sensor in sensors or [None]:
        load_pipeline(file, args.overrides, sensor=sensor)
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    begin = time.perf_counter()
    with _progress_display(console, shown=not args.quiet):
        count = compiled.warm_up()
    if not args.quiet:
        seconds = time.perf_counter() - begin
        total = len(compiled.known())
        console.print(f"{total} loops are ready; {count} of them were compiled, in {seconds:.1f} s")
    return 0


@contextmanager
def _progress_display(console: Console, *, shown: bool) -> Iterator[None]:
    """How many loops are compiled, on a terminal only."""
    if not shown or not console.is_terminal:
        yield
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as display:
        task = display.add_task("compiling loops for this processor, once", total=None)
        with compiled.reporting(lambda ready, total: display.update(task, completed=ready, total=total)):
            yield
