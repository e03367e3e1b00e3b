"""`tactflow report`: a page for any run."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli.options import add_overwrite, refuse_output, writing
from tactflow.engine.stats import read_statistics
from tactflow.system.files import completed
from tactflow.system.terminal import say
from tactflow.tools.report.page import collect, report_page
from tactflow.tools.report.results import read_results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `report`."""
    parser.add_argument(
        "results", type=Path, metavar="RESULTS", help="JSON Lines, a recording (.mcap), or Parquet tables"
    )
    parser.add_argument(
        "--stats",
        type=Path,
        metavar="FILE",
        help="statistics of the run (tactflow run --stats): where time went",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE.html", help="the page; default: RESULTS with the suffix .html"
    )
    add_overwrite(parser)


def run(args: argparse.Namespace) -> int:
    """Read the results and write the page; returns the exit code.

    Raises ConfigError if the results or the statistics cannot be read, or the page exists.
    """
    out = args.results.with_suffix(".html") if args.out is None else args.out
    refuse_output("--out", out, overwrite=args.overwrite, suffixes=(".html",))
    statistics = None if args.stats is None else read_statistics(args.stats)
    reports = collect(read_results(args.results))
    written = report_page(args.results.name, reports, statistics)
    with writing(out), completed(out) as partial:
        partial.write_text(written, encoding="utf-8")
    say(f"tactflow: wrote {out}")
    return 0
