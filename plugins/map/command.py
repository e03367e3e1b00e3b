"""`tactflow map`: the surface of an object from a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from tactflow.cli.options import add_overrides, add_overwrite, add_sensor, refuse_output, writing
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.arguments import positive
from tactflow.system.files import completed
from tactflow.system.terminal import progress_bar, say

if TYPE_CHECKING:
    from tactflow.engine.graph import Pipeline
    from tactflow.message.result import Result

    from .keyframes import Contact, Touch


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `map`."""
    parser.add_argument(
        "recording",
        metavar="RECORDING",
        help="of one object that is rolled, turned or slid over the gel: whatever `tactflow run --source` "
        "takes, except live sources",
    )
    parser.add_argument(
        "--pipeline",
        metavar="PIPELINE",
        help="pipeline with the stage depth and a calibration (default: as `tactflow run`)",
    )
    add_overrides(parser)
    add_sensor(parser)
    parser.add_argument(
        "--contact",
        type=positive,
        metavar="N",
        help="only this contact of the recording, from 1; default: the one that shows most, and those that "
        "show parts of the same surface again",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE.ply",
        help="the points; the page is beside it (.html). Default: map.ply",
        default=Path("map.ply"),
    )
    add_overwrite(parser, "either file")


def run(args: argparse.Namespace) -> int:
    """Write the points and the page; returns the exit code.

    Raises
    ------
    ConfigError : the command line or the pipeline is wrong, or there is no calibration of depth. StageError :
        the recording shows no contact, or a file cannot be written.
    """
    from .closure import mapped
    from .page import map_page, summary, unseen
    from .ply import error_colours, write_ply
    from .surface import merged

    page_file = args.out.with_suffix(".html")
    refuse_output("--out", args.out, overwrite=args.overwrite, suffixes=(".ply",))
    refuse_output("--out", page_file, overwrite=args.overwrite)
    contacts = _contacts(args)
    with progress_bar(f"mapping {len(contacts)} contacts"):
        contact, count = chosen(contacts, args.contact, args.recording)
        graph = mapped(contact.keyframes, contact.edges)
        points = merged(contact.keyframes, graph)
    cell = float(contact.keyframes[0].imprint.cell.mean())
    written = map_page(args.recording, points, contact, graph, cell)
    with writing(args.out), completed(args.out) as partial:
        write_ply(partial, points, error_colours(points))
    with writing(page_file), completed(page_file) as partial:
        partial.write_text(written, encoding="utf-8")
    if len(contacts) > 1:
        others = "" if count == len(contacts) else "; the others do not show where they belong"
        say(f"{count} of {len(contacts)} contacts{others}.")
    for line in (summary(points, contact), *unseen(contact, graph)):
        say(line)
    say(f"tactflow: wrote {args.out} and {page_file}")
    return 0


def chosen(contacts: list[Contact], number: int | None, recording: str) -> tuple[Contact, int]:
    """A contact, by default that with most keyframes and all that show the same object, and their number.

    number : from 1. Raises StageError if there is none, ConfigError for a number that does not exist.
    """
    from .joining import joined

    if not contacts:
        raise StageError(
            f"{recording}: no contact is large enough to be mapped; `tactflow report` shows what was found. "
            "Begin with the untouched gel, then press the object on it and roll it on"
        )
    if number is None:
        return joined(contacts)
    if number > len(contacts):
        raise ConfigError(f"--contact: required 1 to {len(contacts)}, got {number}")
    return contacts[number - 1], 1


def _contacts(args: argparse.Namespace) -> list[Contact]:
    """The contacts of the recording."""
    from tactflow.streaming import stream

    from .keyframes import contacts_of

    with progress_bar("0 frames") as update:

        def counted(results: Iterable[Result]) -> Iterator[Result]:
            for count, result in enumerate(results, 1):
                update(description=f"{count} frames")
                yield result

        return contacts_of(touches(counted(stream(_pipeline(args))), args.recording))


def touches(results: Iterable[Result], recording: str) -> Iterator[Touch | None]:
    """What the tracker needs of each frame; None without contact.

    Raises ConfigError at the first contact without depth.
    """
    from .keyframes import Touch

    for result in results:
        depth, mask, scale = result.depth, result.contact_mask, result.scale
        if result.contact is None or mask is None or not mask.any():
            yield None
        elif depth is None or scale is None:
            reason = result.skipped.get("depth", "no stage depth")
            if reason not in ("no_calibration", "no stage depth"):
                yield None
                continue
            raise ConfigError(
                f"{recording}: a map in mm needs the depth of contacts ({reason}). Calibrate the sensor "
                "(`tactflow calibrate --help`), and give --set calibration=FILE"
            )
        else:
            slipping = result.value("slipping") is True
            yield Touch(result.seq, scale, depth, mask, result.field, slipping)


def _pipeline(args: argparse.Namespace) -> Pipeline:
    """The pipeline, with `slip` where dots show it."""
    from tactflow.config.load import load_pipeline
    from tactflow.config.overrides import Override
    from tactflow.config.shipped import find_pipeline
    from tactflow.sources import open_source

    file = find_pipeline(args.pipeline)
    source = [Override("source", args.recording, f"RECORDING {args.recording}")]

    def load(overrides: list[str]) -> Pipeline:
        return load_pipeline(file, overrides, source_values=source, sensor=args.sensor)

    with closing(open_source(args.recording)) as opened:
        if opened.live:
            raise ConfigError(f"{args.recording}: required a recording, not a camera or a stream")
    own = [text for text in args.overrides if text.partition("=")[0].startswith("stages.slip")]
    pipeline = load([text for text in args.overrides if text not in own])
    if "depth" not in pipeline.nodes:
        raise ConfigError(f"{file}: a map in mm needs the stages scale and depth, and a calibration")
    if "slip" in pipeline.nodes:
        return load(args.overrides)
    return load(["stages.slip={}", *args.overrides]) if "field" in pipeline.nodes else pipeline
