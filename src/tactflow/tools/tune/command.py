"""`tactflow tune`: the cheapest pipeline within an error budget, or the most exact one within a time."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tactflow.cli.options import add_overwrite, add_sensor, refuse_output, writing
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import StageError
from tactflow.system.arguments import number
from tactflow.system.files import completed
from tactflow.system.terminal import notes, say, show, typed

_above_0 = number(float, sys.float_info.min, sys.float_info.max, "a number above 0")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `tune`."""
    parser.add_argument(
        "pipeline",
        nargs="?",
        metavar="PIPELINE",
        help="the pipeline to vary; default: ./pipeline.yaml, else the packaged one that fits the gel",
    )
    parser.add_argument(
        "--source",
        required=True,
        metavar="SRC",
        help="recording of the sensor, first untouched, then with some presses; as 'tactflow run --source'",
    )
    parser.add_argument(
        "--max-error",
        type=_above_0,
        metavar="PX",
        help="limit for the largest error, pixels of the camera image",
    )
    parser.add_argument(
        "--max-ms", type=_above_0, metavar="MS", help="limit for the CPU time of a frame with contact"
    )
    add_sensor(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("tuned.yaml"), metavar="FILE", help="default: tuned.yaml"
    )
    parser.add_argument(
        "--page", type=Path, metavar="FILE.html", help="also draw time against error of all candidates here"
    )
    add_overwrite(parser)


def run(args: argparse.Namespace) -> int:
    """Search, print and write; returns 0, or 3 if no pipeline keeps the budgets.

    Raises
    ------
    ConfigError, SourceError
        If the options are wrong, or the recording cannot be used.
    """
    refuse_output("--out", args.out, overwrite=args.overwrite, suffixes=(".yaml", ".yml"))
    if args.page is not None:
        refuse_output("--page", args.page, overwrite=args.overwrite, suffixes=(".html",))
    # Imported here: the simulator and the bench take their time.
    from tactflow.tools.tune import report
    from tactflow.tools.tune.recording import take
    from tactflow.tools.tune.search import Goal, search
    from tactflow.tools.tune.space import candidates, swaps

    with notes("ERROR"), tempfile.TemporaryDirectory(prefix="tactflow-tune-") as name:
        folder = Path(name)
        file = find_pipeline(args.pipeline)
        recording = take(args.source, load_pipeline(file, sensor=args.sensor), folder)
        dots = recording.observation.dots
        if args.pipeline is None and dots is None:
            file = find_pipeline("markerless")
            say(f"no dots are found: starting from {file.name}")
        trials = candidates(file, recording.size, None if dots is None else dots.pitch, args.sensor)
        goal = Goal(args.max_error, args.max_ms)
        tuned = search(trials, recording, folder, goal, say, swaps(file, args.sensor))
    show(report.lines(tuned))
    if args.page is not None:
        with writing(args.page), completed(args.page) as unfinished:
            unfinished.write_text(report.front_page(tuned, goal), encoding="utf-8")
        say(f"{args.page} is written")
    if tuned.chosen is None:
        say(tuned.impossible())
        return StageError.exit_code
    text = report.pipeline_text(tuned, args.out)
    with writing(args.out), completed(args.out) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    say(f"{args.out} is written; try: {typed('tactflow', 'run', str(args.out), '--source', args.source)}")
    return 0
