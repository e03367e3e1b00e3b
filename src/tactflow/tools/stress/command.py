"""`tactflow stress`: numerical stability, measured."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from tactflow.cli.options import refuse_output, writing
from tactflow.engine.errors import ConfigError
from tactflow.system.terminal import notes, progress_bar, say, show
from tactflow.tools.bench.command import pipeline_files
from tactflow.tools.bench.run import DEFAULT, machine
from tactflow.tools.stress.arithmetic import run_arithmetic
from tactflow.tools.stress.conditioning import run_conditioning
from tactflow.tools.stress.degenerate import run_degenerate
from tactflow.tools.stress.endurance import FRAMES, run_endurance
from tactflow.tools.stress.parts import Part
from tactflow.tools.stress.perturbation import run_perturbation
from tactflow.tools.stress.report import SCHEMA, Report, lines, save_picture, stress_page
from tactflow.tools.stress.same import Answers, load_answers, run_same
from tactflow.tools.stress.subjects import Subject, stage_components, subjects, swapped

BROKEN_EXIT_CODE: Final = 3
"""Exit code when a promise is broken."""
PARTS: Final = ("arithmetic", "perturbation", "conditioning", "swapped", "degenerate", "long", "same")
"""Names of the parts, in the order in which they run."""
FULL_PARTS: Final = frozenset({"swapped"})
"""Parts that a quick run leaves out: there are many stages to swap in."""
SWAPPED_UNDER: Final = ("noise", "displacement a frame")
"""Perturbations of the pipelines with another stage."""
PICTURE_OF: Final = "default, press"
"""Curves in the picture of the docs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `stress`."""
    add = parser.add_argument
    add(
        "pipelines",
        nargs="*",
        metavar="PIPELINE",
        help="also stress these, besides the packaged ones and ./pipeline.yaml if it exists",
    )
    add("--quick", action="store_true", help="a few cases of each part, half a minute")
    add(
        "--part",
        action="append",
        choices=PARTS,
        metavar="PART",
        help=f"only this part, repeatable: {', '.join(PARTS)}",
    )
    add(
        "--frames",
        type=int,
        metavar="N",
        help=f"length of the long run (default: {FRAMES:,}, with --quick 1,000)",
    )
    add("--seed", type=int, default=1, metavar="N", help="of everything at random (default: 1)")
    add(
        "--json",
        type=Path,
        default=Path("stress.json"),
        metavar="PATH",
        help="write every number here, as JSON (default: stress.json)",
    )
    add(
        "--page",
        type=Path,
        default=Path("stress.html"),
        metavar="PATH",
        help="write the page here (default: stress.html)",
    )
    add("--picture", type=Path, metavar="PATH", help="write the picture of the documentation here, PNG")
    add(
        "--against",
        type=Path,
        metavar="FILE",
        help="compare the answers with those of another --json: of another OpenCV, or another machine",
    )


def run(args: argparse.Namespace) -> int:
    """Measure, print the tables, write the page; returns the exit code."""
    if args.frames is not None and args.frames < 1:
        raise ConfigError(f"--frames: required a number of frames, 1 or more, got {args.frames}")
    stored = None if args.against is None else load_answers(args.against, SCHEMA)
    for option, path in (("--json", args.json), ("--page", args.page), ("--picture", args.picture)):
        if path is not None:
            refuse_output(option, path, overwrite=True)
    report = Report(quick=args.quick, machine=machine())
    began = time.perf_counter()
    with notes("CRITICAL"), progress_bar("stress", lines=True) as update:
        at = ""
        parts = _parts(args, report, stored, lambda subject: update(description=f"{at}: {subject}"))
        for number, (name, measure) in enumerate(parts.items()):
            at = name
            update(description=name, completed=number, total=len(parts))
            start = time.perf_counter()
            part = measure()
            part.seconds = time.perf_counter() - start
            report.parts.append(part)
    report.wall_s = time.perf_counter() - began
    show(lines(report))
    for path in filter(None, (args.json, args.page, args.picture)):
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path is args.json:
                report.save(path)
            elif path is args.page:
                path.write_text(stress_page(report), encoding="utf-8")
            else:
                save_picture(report, path, PICTURE_OF)
        say(f"tactflow: wrote {path}")
    say(f"tactflow: {report.summary}")
    return BROKEN_EXIT_CODE if report.broken else 0


def _parts(
    args: argparse.Namespace, report: Report, stored: Answers | None, tell: Callable[[str], None]
) -> Mapping[str, Callable[[], Part]]:
    """Name -> function that measures it, of the parts that were asked for. tell : as for `Subject`."""
    who = subjects(pipeline_files(args.pipelines), tell)
    if args.quick:
        # The script takes as long as all the others together.
        who = [subject for subject in who if not subject.reference]
    quick, seed = args.quick, args.seed

    def same() -> Part:
        part, report.answers = run_same(who, quick=quick, stored=stored)
        return part

    def others() -> Part:
        return run_swapped([other for one in who if one.name == DEFAULT for other in swapped(one)], seed)

    known: dict[str, Callable[[], Part]] = {
        "arithmetic": lambda: run_arithmetic(who, quick=quick),
        "perturbation": lambda: run_perturbation(who, quick=quick, seed=seed),
        "conditioning": lambda: run_conditioning(who, quick=quick, seed=seed),
        "swapped": others,
        "degenerate": lambda: run_degenerate(who, stage_components()[0], quick=quick, seed=seed),
        "long": lambda: run_endurance(who, quick=quick, length=args.frames),
        "same": same,
    }
    chosen = args.part or [name for name in PARTS if not (quick and name in FULL_PARTS)]
    return {name: known[name] for name in PARTS if name in chosen}


def run_swapped(others: list[Subject], seed: int) -> Part:
    """The default pipeline with another stage or method in the place of each of its own."""
    perturbed = run_perturbation(others, quick=False, seed=seed, names=SWAPPED_UNDER)
    turned = run_conditioning(others, quick=False, seed=seed, scenes=1)
    part = Part(
        "Other stages",
        "The default pipeline with another registered stage, or another method, in the place of its "
        "own. They are listed, without promises.",
    )
    part.trials = perturbed.trials + turned.trials
    part.checks = turned.checks
    part.listings = perturbed.listings + turned.listings
    part.curves = perturbed.curves
    return part
