"""`tactflow bench`: run time against error, per method and for whole pipelines."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli.options import refuse_output, writing
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.system.extras import missing
from tactflow.system.terminal import notes, progress_bar, say, show
from tactflow.tools.bench.page import bench_page, save_pictures
from tactflow.tools.bench.results import CLASSIC, load_errors, regressions
from tactflow.tools.bench.run import DEFAULT, MARKERLESS, run_bench
from tactflow.tools.bench.tables import lines

WORSE_EXIT_CODE = 3
"""Exit code when an error has increased since the run of `--against`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `bench`."""
    add = parser.add_argument
    add(
        "pipelines",
        nargs="*",
        metavar="PIPELINE",
        help="also measure these, besides the packaged ones and ./pipeline.yaml if it exists",
    )
    add("--quick", action="store_true", help="three short scenes, half a minute")
    add(
        "--scene",
        action="append",
        metavar="NAME",
        help="only this scene of the simulated sensor; repeatable",
    )
    add(
        "--json",
        type=Path,
        default=Path("bench.json"),
        metavar="PATH",
        help="write every number here, as JSON (default: bench.json)",
    )
    add(
        "--page",
        type=Path,
        default=Path("bench.html"),
        metavar="PATH",
        help="write the page with plots here (default: bench.html)",
    )
    add(
        "--pictures",
        type=Path,
        metavar="FOLDER",
        help="write the pictures of the documentation there: front.png, skipping.png",
    )
    add(
        "--recording",
        type=Path,
        metavar="FILE",
        help="show what each frame of this recording costs, instead of a simulated press",
    )
    add(
        "--against",
        type=Path,
        metavar="FILE",
        help="compare the errors with those of an earlier --json; exit code 3 if one exceeds its tolerance",
    )


def run(args: argparse.Namespace) -> int:
    """Measure, print the tables, write what was asked for; returns the exit code."""
    stored = None if args.against is None else load_errors(args.against, quick=args.quick)
    refuse_output("--json", args.json, overwrite=True)
    refuse_output("--page", args.page, overwrite=True)
    if args.pictures is not None and (remedy := missing("pictures", "plot", ["matplotlib"])):
        raise ConfigError(f"--pictures: {remedy}")
    if args.recording is not None and not args.recording.exists():
        raise ConfigError(f"--recording {args.recording}: there is no such file")
    scenes = frozenset(args.scene) if args.scene else None
    files = pipeline_files(args.pipelines)
    with notes("ERROR"), progress_bar("rendering", lines=True) as update:
        result = run_bench(
            files,
            quick=args.quick,
            scenes=scenes,
            recording=args.recording,
            progress=lambda what, n, total: update(description=what, completed=n, total=total),
        )
    show(lines(result))
    with writing(args.json):
        args.json.parent.mkdir(parents=True, exist_ok=True)
        result.save(args.json)
    own = [name for name in files if name not in packaged_files()]
    with writing(args.page):
        args.page.parent.mkdir(parents=True, exist_ok=True)
        args.page.write_text(bench_page(result, own), encoding="utf-8")
    say(f"tactflow: wrote {args.json} and {args.page}")
    if args.pictures is not None:
        with writing(args.pictures):
            args.pictures.mkdir(parents=True, exist_ok=True)
            for path in save_pictures(result, args.pictures):
                say(f"tactflow: wrote {path}")
    if stored is None:
        return 0
    worse = regressions(result, stored, scenes)
    verdict = f"{len(worse)} errors have" if worse else "no error has"
    say("\n".join([f"tactflow: {verdict} increased since {args.against}", *worse]))
    return WORSE_EXIT_CODE if worse else 0


def packaged_files() -> dict[str, Path]:
    """Name -> file of the packaged pipelines that differ in more than settings, the default one first."""
    return {name: find_pipeline(f"pipelines/{name}.yaml") for name in (DEFAULT, CLASSIC, MARKERLESS)}


def pipeline_files(words: list[str]) -> dict[str, Path]:
    """The packaged pipelines, `./pipeline.yaml` where it differs, and those on the command line."""
    files = packaged_files()
    local = Path("pipeline.yaml")
    if local.exists() and local.read_bytes() != files[DEFAULT].read_bytes():
        files["./pipeline"] = local
    for word in words:
        path = find_pipeline(word)
        if not path.exists():
            raise ConfigError(f"{word}: there is no such pipeline file")
        if path not in files.values():
            files[path.stem if path.stem not in files else str(path)] = path
    return files
