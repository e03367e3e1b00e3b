"""`tactflow batch`: a pipeline over many recordings."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from tactflow.batch.cluster import DaskCluster
from tactflow.batch.engine import Engine
from tactflow.batch.folder import Folder, Ledger
from tactflow.batch.local import LocalProcesses
from tactflow.batch.page import write_page
from tactflow.batch.recordings import Recording, find_recordings
from tactflow.batch.run import Plan, Result, Stopping, make_plan, resolved, run_batch
from tactflow.batch.runs import Row, require_pyarrow, write_runs
from tactflow.batch.task import Task
from tactflow.cli.batch_progress import batch_display, in_short
from tactflow.cli.printable import printable
from tactflow.config.load import sensor_names
from tactflow.config.shipped import find_pipeline, packaged_pipelines
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.run import INTERRUPTED
from tactflow.signals import ending_handled

_FAILED_SHOWN = 20
"""Recordings that failed, told at the end by name. Chosen by hand: they fit on a screen."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `batch`."""
    parser.add_argument(
        "words",
        nargs="+",
        metavar="[PIPELINE] SRC",
        help="a pipeline (FILE.yaml, or the name of a shipped one; default: ./pipeline.yaml, else the "
        "packaged one), then recordings: files, folders, quoted patterns, text files of such words",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--format",
        choices=("parquet", "jsonl"),
        default="parquet",
        help="of the results and of the table of runs (default: %(default)s)",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="a.b.c=VALUE",
        help="override one value of the pipeline file; repeatable",
    )
    parser.add_argument("--sensor", metavar="NAME", help="which one of a pipeline with several sensors")
    parser.add_argument(
        "--workers", type=_positive, metavar="N", help="processes on this machine (default: one a processor)"
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the Dask cluster of this scheduler, as in tcp://host:8786, instead",
    )
    parser.add_argument(
        "--dask", choices=("local",), help="start a Dask cluster on this machine, and work on that instead"
    )
    parser.add_argument(
        "--shard",
        type=_shard,
        default=(1, 1),
        metavar="I/N",
        help="do only the I-th of N parts of the recordings, as in a job array; one more call without it "
        "gathers the table and the page",
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="read all recordings and results instead of trusting that what has the same size and time of "
        "change is the same",
    )
    parser.add_argument("--fail-fast", action="store_true", help="begin nothing more once a recording fails")
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def run(args: argparse.Namespace) -> int:
    """Work on the recordings; returns the exit code.

    Raises
    ------
    ConfigError : the command line or the pipeline is wrong; nothing was started.
    StageError : the table or the page cannot be written.
    """
    if args.format == "parquet":
        require_pyarrow()
    file, words = _pipeline_and_sources(args.words)
    request = resolved(file, _overrides(args, file), args.sensor, args.format)
    recordings = find_recordings(words)
    number, of = args.shard
    shard = f"{number}-of-{of}"
    folder = Folder(args.out.absolute())
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    stopping = Stopping()
    with ExitStack() as stack:
        scratch = stack.enter_context(folder.claimed(shard))
        plan = make_plan(folder, recordings[number - 1 :: of], request, verify=args.verify)
        if not args.quiet:
            console.print(printable(_opening(plan, file, args.shard)), markup=False)
        ledger = stack.enter_context(Ledger(folder, shard))

        def make_task(recording: Recording) -> Task:
            return Task(recording, request, args.format, str(folder.path), str(scratch), args.verify)

        stack.enter_context(ending_handled(stopping.count))
        engine = _engine(args)
        with batch_display(console, plan, engine, shown=not args.quiet) as display:
            result = run_batch(
                *(plan, make_task, engine, ledger),
                stopping=stopping,
                fail_fast=args.fail_fast,
                told=display.told,
                shown=display.shown,
            )
        paths = _write_reports(args, folder, recordings, result, file)
        if not args.quiet:
            console.print(printable("\n".join(_closing(result, paths))), markup=False)
    return _code(result, stopping)


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


def _overrides(args: argparse.Namespace, file: Path) -> list[str]:
    several = sensor_names(file, args.overrides)
    if len(several) > 1 and args.sensor is None:
        raise ConfigError(
            f"{file} has the sensors {', '.join(several)}; a recording is of one: give --sensor {several[0]}"
        )
    return list(args.overrides)


def _engine(args: argparse.Namespace) -> Engine:
    workers = args.workers or _processors()
    address = args.scheduler or args.dask
    return LocalProcesses(workers) if address is None else DaskCluster(address, workers)


def _processors() -> int:
    """Processors that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _opening(plan: Plan, file: Path, shard: tuple[int, int]) -> str:
    part = "" if shard == (1, 1) else f" (part {shard[0]} of {shard[1]})"
    return f"{file}: {plan.words}{part}"


def _write_reports(
    args: argparse.Namespace,
    folder: Folder,
    recordings: Sequence[Recording],
    result: Result,
    file: Path,
) -> list[Path]:
    """The table and the page, of all parts; returns their paths."""
    outcomes = result.outcomes
    if args.shard != (1, 1):
        outcomes = folder.known() | outcomes
    rows = [Row(recording, outcomes.get(recording.source)) for recording in recordings]
    runs = write_runs(folder.path, rows, args.format)
    return [runs, write_page(folder, rows, f"{file.stem}: {len(rows)} recordings", _facts(rows))]


def _facts(rows: Sequence[Row]) -> list[str]:
    """What a batch comes to, for the top of its page."""
    outcomes = [row.outcome for row in rows if row.outcome is not None]
    done = [outcome for outcome in outcomes if outcome.status == "done"]
    frames, seconds = sum(o.frames for o in done), sum(o.seconds for o in done)
    versions = done[0].versions if done else {}
    return [
        f"{len(done)} done, {len(outcomes) - len(done)} failed, {len(rows) - len(outcomes)} not done; "
        f"{frames} frames, {sum(o.contacts for o in done)} contacts; {seconds:.0f} s of work",
        ", ".join(f"{name} {number}" for name, number in versions.items()),
    ]


def _closing(result: Result, paths: Sequence[Path]) -> list[str]:
    """The summary at the end."""
    fresh = [o for o in result.outcomes.values() if o.status == "done" and not o.reused]
    again = sum(o.reused for o in result.outcomes.values())
    lines = [f"{len(fresh)} done now, {again} were done before, {len(result.failed)} failed"]
    if result.undone:
        lines[0] += f", {len(result.undone)} not done: call again to do the rest"
    if result.ended is not None:
        lines.append(f"ended early: {result.ended}")
    lines += [f"  {o.status}: {o.name}: {in_short(o)}" for o in result.failed[:_FAILED_SHOWN]]
    if len(result.failed) > _FAILED_SHOWN:
        lines.append(f"  and {len(result.failed) - _FAILED_SHOWN} more, see {paths[0]}")
    return [*lines, f"look at {paths[1]}"]


def _code(result: Result, stopping: Stopping) -> int:
    if stopping.signals and result.undone:
        return INTERRUPTED
    return StageError.exit_code if result.failed or result.undone else 0


def _positive(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"required a whole number from 1, got {text!r}")
    return value


def _shard(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"required I/N with I from 1 to N, as in 2/8, got {text!r}")
    return int(found[1]), int(found[2])
