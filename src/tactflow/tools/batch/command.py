"""`tactflow batch`: a pipeline over many recordings."""

from __future__ import annotations

import argparse
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

from tactflow.cli.options import (
    add_overrides,
    add_quiet,
    add_sensor,
    add_sources,
    listed_sources,
    writing,
)
from tactflow.cli.recordings import find_exporter, frame_rate, write_dataset
from tactflow.config.load import sensor_names
from tactflow.config.shipped import find_pipeline, packaged_pipelines
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.arguments import positive
from tactflow.system.signals import INTERRUPTED_EXIT_CODE, ending_handled
from tactflow.system.terminal import progress_bar, say
from tactflow.tools.batch.recordings import Recording, find_recordings
from tactflow.tools.batch.report import chosen_format, write_page, write_runs
from tactflow.tools.batch.run import Batch, Result, make_plan
from tactflow.tools.batch.store import Format, Outcome, Store
from tactflow.tools.batch.work import Request, resolved, results_of
from tactflow.tools.batch.workers import DaskCluster, LocalProcesses

MAX_MESSAGE_LETTERS = 200
"""Letters of a message in a list of many: two lines of a terminal."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `batch`."""
    add_sources(
        parser,
        "words",
        "[PIPELINE] SRC",
        "a pipeline (FILE.yaml, or the name of a shipped one; default: ./pipeline.yaml, else the packaged "
        "one), then recordings: files, folders, or quoted patterns",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--format",
        choices=get_args(Format),
        help="of the results and of the table of runs (default: parquet, or csv where pyarrow is missing)",
    )
    parser.add_argument(
        "--dataset",
        metavar="FORMAT",
        help="also make one dataset of all recordings that are done, in DIR/FORMAT: lerobot, replay-buffer "
        "or another format of `tactflow export`",
    )
    parser.add_argument(
        "--fps", type=frame_rate, help="frame rate of the dataset (default: that of the first recording)"
    )
    add_overrides(parser)
    add_sensor(parser)
    parser.add_argument(
        "--workers", type=positive, metavar="N", help="processes on this machine (default: one a processor)"
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="use the Dask cluster of this scheduler instead, as in tcp://host:8786",
    )
    parser.add_argument(
        "--shard",
        type=_shard,
        default=(1, 1),
        metavar="I/N",
        help="process only part I of N of the recordings, as in a job array; a final call without it writes "
        "the table and the page",
    )
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Work on the recordings; returns the exit code.

    Raises
    ------
    ConfigError : the command line or the pipeline is wrong; nothing was started.
    StageError : the table or the page cannot be written.
    """
    format_, note = chosen_format(args.format)
    if args.dataset is not None:
        find_exporter(args.dataset)
    file, words = _pipeline_and_sources(listed_sources(args, "words"))
    sensors = sensor_names(file, args.overrides)
    if len(sensors) > 1 and args.sensor is None:
        raise ConfigError(
            f"{file} has the sensors {', '.join(sensors)}; a recording is of one: give --sensor {sensors[0]}"
        )
    request = resolved(file, args.overrides, args.sensor, format_)
    recordings, store = find_recordings(words), Store(args.out.absolute())
    tell: Callable[[str], None] = (lambda _: None) if args.quiet else say
    signals: list[int] = []
    number, of = args.shard
    with (
        store.claimed(f"{number}-of-{of}") as scratch,
        ending_handled(lambda signal, _: signals.append(signal)),
    ):
        plan = make_plan(store, recordings[number - 1 :: of], request)
        for line in note:
            tell(line)
        tell(f"{request.file}: {plan}{'' if of == 1 else f' (part {number} of {of})'}")
        result = Result(dict(plan.done))
        if plan.left and not signals:
            workers = (
                DaskCluster(args.scheduler)
                if args.scheduler is not None
                else LocalProcesses(args.workers or _processors())
            )
            tell(f"on {workers.description}")
            batch = Batch(store, scratch, request, workers, lambda: len(signals))
            with _progress(len(plan.left), tell, shown=not args.quiet) as batch.on_outcome:
                result = batch.run(plan)
        # Before the table is written, which a full disk may not take.
        for line in _closing(result, len(plan.done)):
            tell(line)
        runs = [(recording, _outcome(recording, result, store, request)) for recording in recordings]
        with writing(store.path):
            write_runs(store, runs, format_)
            page = write_page(store, runs, f"{file.stem}: {len(runs)} recordings")
        tell(f"report: {page}")
        sources = [recording.source for recording, outcome in runs if outcome.status == "done"]
        if args.dataset is not None and sources and not result.undone and of == 1:
            out = store.path / args.dataset
            tell(write_dataset(args.dataset, sources, results_of(request), out, fps=args.fps))
    if signals and result.undone:
        return INTERRUPTED_EXIT_CODE
    return StageError.exit_code if result.undone or result.failed else 0


def _outcome(recording: Recording, result: Result, store: Store, request: Request) -> Outcome:
    """The outcome of a recording, also of another shard."""
    outcome = result.outcomes.get(recording.source) or store.outcome(recording)
    if outcome is None or outcome.pipeline != request.digest:
        return Outcome(recording.source, recording.name, "not done")
    return outcome


@contextmanager
def _progress(total: int, tell: Callable[[str], None], *, shown: bool) -> Iterator[Callable[[Outcome], None]]:
    """Names each recording that fails; on a terminal, shows how far the batch is."""
    with progress_bar("starting", total, shown=shown) as update:
        done = failed = frames = 0

        def on_outcome(outcome: Outcome) -> None:
            nonlocal done, failed, frames
            done += 1
            failed += outcome.status != "done"
            frames += outcome.frames
            if outcome.status != "done":
                first_line = (outcome.error or "").partition("\n")[0]
                reason = textwrap.shorten(first_line, MAX_MESSAGE_LETTERS, placeholder=" ...")
                tell(f"failed: {outcome.name}: {reason}")
            update(completed=done, description=f"{done} of {total}, {failed} failed, {frames} frames")

        yield on_outcome


def _pipeline_and_sources(words: Sequence[str]) -> tuple[Path, Sequence[str]]:
    """The pipeline file, and the words behind it."""
    first = words[0]
    named = first.endswith((".yaml", ".yml")) or (first in packaged_pipelines() and not Path(first).exists())
    file = find_pipeline(first if named else None)
    if not file.is_file():
        raise ConfigError(f"there is no file {file}")
    rest = words[1:] if named else words
    if not rest:
        raise ConfigError(f"there are no recordings: name files, folders or patterns behind {first}")
    return file, rest


def _closing(result: Result, done_before: int) -> Iterator[str]:
    """The summary at the end."""
    failed, outcomes = result.failed, result.outcomes.values()
    now = len(outcomes) - len(failed) - done_before
    undone = f", {result.undone} not done: run the command again to continue" if result.undone else ""
    yield f"{now} done now, {done_before} done before, {len(failed)} failed{undone}"
    if result.ended is not None:
        yield f"ended early: {result.ended}"
    warnings = [o.warnings.partition("\n")[0] for o in outcomes if o.warnings and o.status == "done"]
    if warnings:
        yield f"{len(warnings)} done with warnings: {warnings[0]}; the table of runs has all"


def _shard(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"required I/N with I from 1 to N, as in 2/8, got {text!r}")
    return int(found[1]), int(found[2])


def _processors() -> int:
    """Processors that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
