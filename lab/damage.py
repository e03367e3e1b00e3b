"""Count the pictures of recordings and scenes that are taken for damaged, and the references passed over.

    python -m lab.damage --data ../shared/data        # without it, the scenes of the simulator alone

Every picture is whole. Two of each source are also damaged in several ways. Exit code 1 if a whole picture is
called damaged. A reference after the first frame is right where a camera was still setting its light.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.sim import scene_descriptions
from tactflow.sources.files import is_image
from tactflow.stages.capture import Capture
from tactflow.vision.arrays import ColorImage
from tactflow.vision.change import DamageTest

EXAMINED_FRAMES = 400
"""Frames of a source that are examined."""
VIDEOS = (".avi", ".mp4", ".m4v")


def sources(data: Path | None) -> Iterator[str]:
    """All scenes, then all videos and folders of pictures."""
    yield from (f"sim:{name}?frames=120" for name in scene_descriptions())
    for path in sorted(data.rglob("*")) if data else ():
        if path.suffix in VIDEOS or (path.is_dir() and any(map(is_image, path.iterdir()))):
            yield str(path)


def damages(picture: ColorImage) -> Iterator[tuple[str, ColorImage]]:
    """The picture, damaged in several ways."""
    noise = np.random.default_rng(0).integers(0, 256, picture.shape, np.uint8)
    half = len(picture) // 2
    lower = {"gray": np.uint8(128), "black": np.uint8(0), "noise": noise[half:]}
    lower["displaced"] = np.roll(picture[half:], 8, axis=1)
    for name, values in lower.items():
        cut = picture.copy()
        cut[half:] = values
        yield f"lower half {name}", cut
    yield "black", np.zeros_like(picture)
    yield "noise", noise
    yield "all displaced", np.roll(picture, 8, axis=1)


def judge(source: str, found: Counter[str], total: Counter[str]) -> tuple[int, int, list[int]]:
    """Number of frames, that of references, and the numbers of the frames called damaged."""
    stage = Capture(Capture.Params(source=source))
    stage.open()
    frames, bad, reference = 0, [], -1
    with closing(stage):
        for frame in islice(stage.frames(), EXAMINED_FRAMES):
            if frame.reference:
                reference, first = frame.seq, frame.image
                continue
            frames += 1
            if frame.damaged:
                bad.append(frame.seq)
            elif frame.seq in (1, 60):
                for name, picture in damages(np.asarray(frame.image)):
                    total[name] += 1
                    found[name] += DamageTest(first).is_damaged(picture)
    return frames, reference, bad


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the counts; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="recordings; left out without it")
    args = parser.parse_args(arguments)
    logging.getLogger("tactflow").setLevel(logging.ERROR)
    found, total = Counter[str](), Counter[str]()
    frames = false = others = 0
    for source in sources(args.data):
        try:
            number, reference, bad = judge(source, found, total)
        except SourceError as error:
            print(f"{source}: {error}", file=sys.stderr)
            continue
        frames, false, others = frames + number, false + len(bad), others + (reference != 0)
        if bad or reference != 0:
            early = "" if reference == 0 else "; the reference is a later frame"
            print(f"{source}: {len(bad)} of {number} damaged {bad[:8]}{early}")
    print(f"{frames} whole pictures, {false} called damaged; {others} references after the first frame")
    for name, number in total.items():
        print(f"{name}: {found[name]} of {number} noticed")
    return int(false > 0)


if __name__ == "__main__":
    sys.exit(main())
