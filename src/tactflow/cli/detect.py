"""`tactflow detect`: which dots of a gel are found and why, in words and in one picture."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from tactflow.cli.options import add_overwrite, add_source, refuse_output, writing
from tactflow.drawing.dots import draw_detection
from tactflow.engine.errors import ConfigError, SourceError, StageError
from tactflow.sources import open_source
from tactflow.system.files import completed
from tactflow.system.redaction import public_address
from tactflow.system.terminal import printable
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.valid_area import valid_area
from tactflow.vision.markers import Candidate, Detection, NoMarkersError, detect_markers

MIN_SHOWN_SCORE_RATIO: Final = 0.25
"""Score of the runner-up, relative to that of the marks, above which it is shown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `detect`."""
    add_source(parser, "as in 'tactflow run', of the untouched gel")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the dots, and why they were found")
    add_overwrite(parser)
    parser.add_argument(
        "--downsample", type=int, default=1, choices=(1, 2, 4, 8, 16), help="as in preprocess"
    )
    parser.add_argument("--dot", type=float, metavar="PX", help="radius of a dot, if known")
    parser.add_argument("--polarity", default="auto", choices=("auto", "dark", "bright"), help="of the dots")


def run(args: argparse.Namespace) -> int:
    """Print what was found, and draw it; returns 3 where there are no marks.

    Raises
    ------
    ConfigError, SourceError, StageError
        If the options are wrong, the frame cannot be read, or the picture cannot be written.
    """
    if args.source is None:
        args.parser.error("the following arguments are required: SRC")
    if args.picture is not None:
        refuse_output("--picture", args.picture, overwrite=args.overwrite, suffixes=(".png", ".jpg"))
    with closing(open_source(args.source)) as reader:
        frame = reader.read()
    if frame is None:
        raise SourceError(f"{args.source}: has no frame")
    image = frame[0]
    image = Preprocessor(image.shape[1::-1], downsample=args.downsample)(image)
    valid = valid_area(image)
    marks: Detection | None = None
    try:
        marks = detect_markers(image, dot_radius=args.dot, polarity=args.polarity, valid=valid)
        rival = _near_rival(marks)
        lines = list(_found(marks, rival))
    except NoMarkersError as error:
        rival, lines = error.best, [str(error), *_best(error.best)]
    except ValueError as error:
        raise ConfigError(f"--dot: {error}") from None
    title = f"{public_address(args.source)}: {image.shape[1]} x {image.shape[0]} px"
    without = 0.0 if valid is None else float(np.mean(valid == 0))
    if without > 0:
        lines.append(f"dim: {100 * without:.0f} % of the picture shows no gel")
    text = "\n".join(map(printable, [title, *lines]))
    print(text)
    if args.picture is not None:
        picture = draw_detection(image, marks, text, rival=rival, valid=valid)
        with writing(f"--picture {args.picture}"), completed(args.picture) as partial:
            partial.write_bytes(cv2.imencode(args.picture.suffix.lower(), picture)[1].tobytes())
    return 0 if marks is not None else StageError.exit_code


def _near_rival(marks: Detection) -> Candidate | None:
    """The next best spots, if they are worth showing."""
    if (
        marks.rival is None
        or marks.chosen is None
        or marks.rival.score < MIN_SHOWN_SCORE_RATIO * marks.chosen.score
    ):
        return None
    return marks.rival


def _found(marks: Detection, rival: Candidate | None) -> Iterator[str]:
    """Lines about the dots."""
    sizes = f"radius {marks.dot_radius:.1f} px"
    if marks.radii is not None:
        sizes = f"radii {marks.radii.min():.1f} to {marks.radii.max():.1f} px, most {marks.dot_radius:.1f} px"
    yield f"yellow circles: {len(marks.centers)} {marks.polarity} dots, {sizes}, {marks.pitch:.1f} px apart"
    if marks.chosen is not None:
        closed = f"{100 * marks.chosen.lattice.closed_share:.0f} % of the parallelograms of neighbours close"
        grids = "grids: 80 % and more, random: 30 % and less"
        yield f"green: {len(marks.edges)} links; {closed} ({grids}); score {marks.chosen.score:.1f}"
    yield from _best(rival, "next best")
    if rival is None:
        yield "nothing else in the picture looks like dots"


def _best(spots: Candidate | None, what: str = "best") -> Iterator[str]:
    """A line about the best spots that are not marks, if there are any."""
    if spots is not None:
        closed = f"{100 * spots.lattice.closed_share:.0f} % of their parallelograms close"
        yield f"magenta: {what}, {spots}; {closed}; score {spots.score:.1f}"
