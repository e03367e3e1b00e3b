"""`tactflow batch`: a pipeline over many recordings."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from rich.console import Console

from tactflow.batch.cluster import DaskCluster
from tactflow.batch.compare import compare
from tactflow.batch.compare_page import described, text_table, write_comparison
from tactflow.batch.executor import Executor
from tactflow.batch.folder import Folder, Ledger
from tactflow.batch.local import LocalProcesses
from tactflow.batch.page import write_page
from tactflow.batch.recordings import Recording, find_recordings
from tactflow.batch.run import Result, Stopping, make_plan, resolved, run_batch
from tactflow.batch.runs_table import Row, require_pyarrow, write_runs
from tactflow.batch.split import Splitting
from tactflow.batch.task import Format, PipelineRequest, Task
from tactflow.batch.work import kept_pipeline_for, reading
from tactflow.cli.batch_progress import batch_display, in_short
from tactflow.cli.options import add_overrides, positive, seconds
from tactflow.cli.printable import printable
from tactflow.config.load import sensor_names
from tactflow.config.shipped import find_pipeline, packaged_pipelines
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.graph import Pipeline
from tactflow.system.signals import INTERRUPTED, ending_handled
from tactflow.vision.compiled import processors

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
    add_overrides(parser)
    parser.add_argument("--sensor", metavar="NAME", help="which one of a pipeline with several sensors")
    _add_division(parser)
    parser.add_argument(
        "--verify",
        action="store_true",
        help="read all recordings and results instead of trusting that what has the same size and time of "
        "change is the same",
    )
    parser.add_argument(
        "--compare",
        metavar="OTHER",
        help="run this pipeline over the same recordings too, and tell how the numbers differ and in which "
        "frames most; --set changes the first pipeline alone",
    )
    parser.add_argument("--fail-fast", action="store_true", help="begin nothing more once a recording fails")
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def _add_division(parser: argparse.ArgumentParser) -> None:
    """Declare on what the work is done, and in which parts."""
    parser.add_argument(
        "--workers", type=positive, metavar="N", help="processes on this machine (default: one a processor)"
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
        "--split",
        type=seconds,
        default=0.0,
        metavar="TIME",
        help="cut recordings into parts of 60s, 5min, ... that are worked on side by side; their numbers "
        "differ a little, and --compare tells by how much: with it, only the first pipeline is cut",
    )


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
    requests = [resolved(file, _overrides(args, file), args.sensor, args.format, args.split)]
    if args.compare is not None:
        requests.append(resolved(find_pipeline(args.compare), [], args.sensor, args.format))
        _refuse_the_same(requests)
    recordings = find_recordings(words)
    folder = Folder(args.out.absolute())
    shard = "{}-of-{}".format(*args.shard)
    with ExitStack() as stack:
        scratch = stack.enter_context(folder.claimed(shard))
        ledger = stack.enter_context(Ledger(folder, shard))
        call = _Call(args, folder, scratch, ledger, recordings)
        stack.enter_context(ending_handled(call.stopping.count))
        results = [call.run(request) for request in requests]
        # Before the table is written, which a full disk may not take.
        call.say("\n".join(_closing(results)))
        page = call.write_reports(requests[0], results[0])
        if len(requests) > 1:
            page = call.compare(requests, results)
        call.say(f"look at {page}")
    return _code(results, call.stopping)


class _Call:
    """One call of the command, which may be about two pipelines."""

    def __init__(
        self,
        args: argparse.Namespace,
        folder: Folder,
        scratch: Path,
        ledger: Ledger,
        recordings: Sequence[Recording],
    ) -> None:
        self.stopping = Stopping()
        self._args = args
        self._folder = folder
        self._scratch = scratch
        self._ledger = ledger
        self._recordings = recordings
        self._console = Console(stderr=True, highlight=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """Tell people, unless they want quiet."""
        if not self._args.quiet:
            self._console.print(printable(text), markup=False)

    def run(self, request: PipelineRequest) -> Result:
        """Do what is missing of one pipeline."""
        args = self._args
        number, of = args.shard
        plan = make_plan(self._folder, self._recordings[number - 1 :: of], request, verify=args.verify)
        part = "" if of == 1 else f" (part {number} of {of})"
        self.say(f"{request.file}: {plan.words}{part}")
        if not plan.left:
            return Result(dict(plan.done))

        def make_task(recording: Recording) -> Task:
            out, scratch = str(self._folder.path), str(self._scratch)
            return Task(recording, request, args.format, out, scratch, args.verify)

        executor = _executor(args)
        if request.split:
            executor = Splitting(executor)
        with batch_display(self._console, plan, executor, shown=not args.quiet) as display:
            return run_batch(
                *(plan, make_task, executor, self._ledger),
                stopping=self.stopping,
                fail_fast=args.fail_fast,
                told=display.told,
                shown=display.shown,
            )

    def write_reports(self, request: PipelineRequest, result: Result) -> Path:
        """The table and the page, of all parts; returns the path of the page."""
        outcomes = result.outcomes
        if self._args.shard != (1, 1):
            known = self._folder.known(request.digest)
            others = {source: o for source, o in known.items() if o.pipeline == request.digest}
            outcomes = others | outcomes
        rows = [Row(recording, outcomes.get(recording.source)) for recording in self._recordings]
        write_runs(self._folder.path, rows, self._args.format)
        title = f"{Path(request.file).stem}: {len(rows)} recordings"
        return write_page(self._folder, rows, title, _facts(rows))

    def compare(self, requests: Sequence[PipelineRequest], results: Sequence[Result]) -> Path:
        """Say and write how the results of two pipelines differ; returns the path of the page."""
        first, second = (result.outcomes for result in results)
        comparison = compare(self._folder, self._recordings, first, second)
        names = _two_names(requests)
        self.say("\n".join([*described(comparison, names), *text_table(comparison)]))
        openers = [partial(_opened, request, self._args.format) for request in requests]
        return write_comparison(self._folder, comparison, names, (openers[0], openers[1]))


def _opened(request: PipelineRequest, format_: Format, recording: Recording) -> Pipeline:
    """A pipeline that reads a recording."""
    pipeline, _ = kept_pipeline_for(request, format_)
    return reading(pipeline, recording)


def _two_names(requests: Sequence[PipelineRequest]) -> tuple[str, str]:
    """What two pipelines are called side by side."""
    first, second = (Path(request.file).stem for request in requests)
    if first == second:
        cut = ["in parts"] if requests[0].split else []
        first = " ".join([first, *requests[0].overrides, *cut])
    return (first, second) if first != second else (requests[0].file, requests[1].file)


def _refuse_the_same(requests: Sequence[PipelineRequest]) -> None:
    if requests[0].digest == requests[1].digest:
        raise ConfigError(
            f"--compare {requests[1].file}: computes just what {requests[0].file} does; name another one, or "
            "change the first with --set or --split"
        )


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


def _executor(args: argparse.Namespace) -> Executor:
    workers = args.workers or processors()
    address = args.scheduler or args.dask
    return LocalProcesses(workers) if address is None else DaskCluster(address, workers)


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


def _closing(results: Sequence[Result]) -> list[str]:
    """The summary at the end."""
    outcomes = [outcome for result in results for outcome in result.outcomes.values()]
    failed = [outcome for result in results for outcome in result.failed]
    undone = sum(len(result.undone) for result in results)
    again = sum(outcome.reused for outcome in outcomes)
    lines = [f"{len(outcomes) - len(failed) - again} done now, {again} done before, {len(failed)} failed"]
    if undone:
        lines[0] += f", {undone} not done: call again to do the rest"
    lines += [f"ended early: {result.ended}" for result in results if result.ended is not None]
    lines += [f"  {o.status}: {o.name}: {in_short(o)}" for o in failed[:_FAILED_SHOWN]]
    if len(failed) > _FAILED_SHOWN:
        lines.append(f"  and {len(failed) - _FAILED_SHOWN} more; the table of runs has all")
    notes = [outcome.notes[0] for outcome in outcomes if outcome.notes and outcome.status == "done"]
    if notes:
        lines.append(f"{len(notes)} done with warnings: {notes[0]}; the table of runs has all")
    return lines


def _code(results: Sequence[Result], stopping: Stopping) -> int:
    undone = any(result.undone for result in results)
    if stopping.signals and undone:
        return INTERRUPTED
    return StageError.exit_code if undone or any(result.failed for result in results) else 0


def _shard(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"required I/N with I from 1 to N, as in 2/8, got {text!r}")
    return int(found[1]), int(found[2])
