"""`tactflow bench`: run time against error, per method and for whole pipelines."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from tactflow.bench.compare import Regression, against, load_comparable
from tactflow.bench.gels import left_out
from tactflow.bench.markdown import write_markdown
from tactflow.bench.methods import CLASSIC
from tactflow.bench.report import html
from tactflow.bench.results import Result
from tactflow.bench.run import DEFAULT, MARKERLESS, WEDGE, Plan, run_bench
from tactflow.bench.skipping import Pipelines, compare_all
from tactflow.bench.skipping_table import print_comparisons
from tactflow.bench.stress import measure_drift
from tactflow.bench.table import print_result, terminal
from tactflow.bench.timing import CopyUnit
from tactflow.cli.options import positive, refuse_output
from tactflow.cli.terminal import notes
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError

WORSE = 3
"""Exit code when `--against` finds something worse."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `bench`."""
    parser.add_argument(
        "pipelines",
        nargs="*",
        metavar="PIPELINE",
        help="measure these as well, beside the packaged ones; ./pipeline.yaml is measured if it is there",
    )
    parser.add_argument("--quick", action="store_true", help="three short scenes, below a minute")
    parser.add_argument(
        "--scene",
        action="append",
        metavar="NAME",
        help="only this scene of the simulated sensor; repeatable",
    )
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="also measure on the real recordings in DIR (wedge_ball, wedge_roll, wedge_grasp, gels)",
    )
    _add_outputs(parser)
    _add_other_measurements(parser)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    """Declare where the results are written, and what they are compared with."""
    parser.add_argument(
        "--json",
        type=Path,
        default=Path("bench.json"),
        metavar="PATH",
        help="write every number here, as JSON (default: bench.json)",
    )
    parser.add_argument("--html", type=Path, metavar="PATH", help="write the report here, as one HTML file")
    parser.add_argument(
        "--markdown",
        type=Path,
        metavar="PATH",
        help="write tables for a page of documentation; an existing page keeps the rest of its text",
    )
    parser.add_argument(
        "--pictures",
        type=Path,
        metavar="DIR",
        help="write a picture of every pipeline's worst frame in every scene, and of the worst frame with an "
        "outline in each recording of a gel in --data, the truth beside the answer",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="compare the errors with a stored result; exit code 3 if one got worse than its tolerance",
    )
    parser.add_argument(
        "--write-baseline", type=Path, metavar="FILE", help="write the errors alone, for --against"
    )


def _add_other_measurements(parser: argparse.ArgumentParser) -> None:
    """Declare what can be measured instead of run time against error."""
    parser.add_argument(
        "--stress",
        nargs="?",
        type=positive,
        const=100_000,
        metavar="FRAMES",
        help="instead: press and release, 100000 frames unless told otherwise, through the first PIPELINE; "
        "exit code 3 if error, memory or time creep",
    )
    parser.add_argument(
        "--skipping",
        nargs="?",
        type=positive,
        const=200,
        metavar="FRAMES",
        help="instead: compare the first PIPELINE with and without skipping, on 200 frames of each scene "
        "unless told otherwise, and on the recordings of --data; exit code 3 if a number changes beyond its "
        "noise",
    )


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, write what was asked for; returns the exit code."""
    if args.stress is not None:
        return _stress(args.pipelines, args.stress)
    if args.skipping is not None:
        return _skipping(args.pipelines, args.skipping, args.data)
    if args.against is not None:
        load_comparable(args.against, args.quick)
    for name in ("json", "html", "write_baseline", "markdown"):
        if getattr(args, name) is not None:
            refuse_output(f"--{name.replace('_', '-')}", getattr(args, name), overwrite=True)
    plan = Plan(
        files=_files(args.pipelines),
        quick=args.quick,
        data=args.data,
        scenes=frozenset(args.scene) if args.scene else None,
        pictures=args.pictures,
    )
    with notes("ERROR"), _progress_bar() as progress:
        result = run_bench(plan, progress)
    print_result(result, terminal(sys.stdout))
    _write(args, result)
    for word in left_out(args.data) if args.data is not None else ():
        print(f"tactflow: --data: {word}", file=sys.stderr)
    worse = against(result, args.against, plan.scenes) if args.against is not None else []
    _report(worse, args.against)
    return WORSE if worse else 0


def _skipping(given: list[str], frames: int, data: Path | None) -> int:
    """Compare with and without skipping, print both tables and what changed beyond noise."""
    pipelines = Pipelines(
        load_pipeline(find_pipeline(given[0] if given else f"pipelines/{DEFAULT}.yaml")),
        load_pipeline(find_pipeline("pipelines/markerless.yaml")),
        load_pipeline(find_pipeline("pipelines/wedge.yaml")),
    )
    copies = CopyUnit()
    with notes("ERROR"), _progress_bar() as progress:
        found = list(compare_all(pipelines, frames, data, copies, progress))
    print_comparisons(found, copies, terminal(sys.stdout))
    for one in found:
        for fault in one.faults:
            print(f"tactflow: {one.scene}: {fault}", file=sys.stderr)
    return WORSE if any(one.faults for one in found) else 0


def _stress(given: list[str], frames: int) -> int:
    """Run the long stress, print its blocks and what crept."""
    pipeline = load_pipeline(find_pipeline(given[0] if given else f"pipelines/{DEFAULT}.yaml"))
    with notes("ERROR"), _progress_bar() as progress:
        drift = measure_drift(pipeline, frames, progress)
    table = Table("frames", "marker error", "lost", "CPU a frame", "memory", box=None)
    for row in drift.rows():
        table.add_row(*row)
    terminal(sys.stdout).print(table)
    complaints = drift.complaints()
    for complaint in complaints:
        print(f"tactflow: {complaint}", file=sys.stderr)
    if not complaints:
        print("tactflow: nothing crept", file=sys.stderr)
    return WORSE if complaints else 0


def packaged_files() -> dict[str, Path]:
    """Name -> file of the packaged pipelines that differ in more than settings, the default one first."""
    return {name: find_pipeline(f"pipelines/{name}.yaml") for name in (DEFAULT, CLASSIC, MARKERLESS, WEDGE)}


def _files(given: list[str]) -> dict[str, Path]:
    """The packaged pipelines, `./pipeline.yaml` where it differs, and those that were given."""
    files = packaged_files()
    local = Path("pipeline.yaml")
    if local.exists() and local.read_bytes() != files[DEFAULT].read_bytes():
        files["./pipeline"] = local
    for word in given:
        path = find_pipeline(word)
        if not path.exists():
            raise ConfigError(f"{word}: there is no such pipeline file")
        if path not in files.values():
            files[path.stem if path.stem not in files else str(path)] = path
    return files


def _write(args: argparse.Namespace, result: Result) -> None:
    writers: list[tuple[Path | None, Callable[[Path], object]]] = [
        (args.json, result.save),
        (args.write_baseline, result.save_errors),
        (args.html, lambda path: path.write_text(html(result), encoding="utf-8")),
        (args.markdown, lambda path: write_markdown(result, path, DEFAULT)),
    ]
    for path, write in writers:
        if path is None:
            continue
        try:
            write(path)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
        print(f"tactflow: wrote {path}", file=sys.stderr)


def _report(worse: list[Regression], path: Path | None) -> None:
    if path is None:
        return
    if not worse:
        print(f"tactflow: nothing got worse than in {path}", file=sys.stderr)
        return
    print(f"tactflow: {len(worse)} results got worse than in {path}:", file=sys.stderr)
    for regression in worse:
        print(f"  {regression}", file=sys.stderr)


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on standard error, on a terminal only."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _what, _done, _total: None
        return
    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as display:
        task = display.add_task("rendering", total=None)

        def update(what: str, done: int, total: int) -> None:
            display.update(task, description=what, completed=done, total=total)

        yield update
