"""Dots that are found where there are none, and how much dots at rest seem to move.

    python -m lab.no_dots [--data RECORDINGS]

Simulated pictures without dots show noise, dust, bubbles, lamps and cloth. With recordings, it also prints
the spread of dots while nothing touches the gel.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from lab.judges.judge_dots import Picture, find
from tactflow.sources import open_source
from tactflow.sources.base import to_bgr
from tactflow.system.terminal import table
from tactflow.vision.arrays import Floats
from tactflow.vision.markers import MarkerTracker

REST_FRAMES: Final = {
    "gels/seu_a/video.mp4": (10, 50),
    "gels/handmade_dots/video.avi": (0, 14),
    "gels/tactip_video": (0, 29),
    "gels/franka_mini/cheese_tube-1-0.avi": (14, 24),
}
"""Recording -> its frames (first, end) in which nothing touches the gel and the exposure is steady."""


def without_dots(seed: int = 0) -> Iterator[tuple[str, Picture]]:
    """Simulated pictures without dots: noise, dust, bubbles, lamps and cloth, twelve of each."""
    generator = np.random.default_rng(seed)
    for kind, draw in {
        "noise": _noise,
        "dust": _dust,
        "bubbles": _bubbles,
        "lamps": _lamps,
        "cloth": _cloth,
    }.items():
        for height, width in ((240, 320), (320, 240)) * 6:
            y, x = np.mgrid[:height, :width] / max(height, width)
            slope = generator.uniform(-60, 60, (2, 3))
            gel = generator.uniform(80, 170, 3) + x[..., None] * slope[0] + y[..., None] * slope[1]
            drawn = draw(gel, generator) + generator.normal(0, generator.uniform(1, 4), gel.shape)
            yield kind, np.clip(drawn, 0, 255).astype(np.uint8)


def _noise(gel: Floats, generator: np.random.Generator) -> Floats:
    """Grain of a random size and strength."""
    grain = cv2.GaussianBlur(generator.normal(0, 1, gel.shape), (0, 0), generator.uniform(0.6, 6))
    return np.asarray(gel + grain / grain.std() * generator.uniform(3, 20), np.float64)


def _discs(gel: Floats, generator: np.random.Generator, count: int, radius: tuple[float, float]) -> Floats:
    """(H, W, 1) 1 in discs at random places, 0 elsewhere, with soft edges."""
    height, width = gel.shape[:2]
    cover = np.zeros((height, width))
    for x, y, size in generator.uniform((0, 0, radius[0]), (width, height, radius[1]), (count, 3)):
        shift = 16
        cv2.circle(cover, (int(x * shift), int(y * shift)), int(size * shift), 1.0, -1, cv2.LINE_8, shift=4)
    return np.asarray(cv2.GaussianBlur(cover, (0, 0), 0.8)[..., None], np.float64)


def _dust(gel: Floats, generator: np.random.Generator) -> Floats:
    """Dark specks of many sizes anywhere."""
    specks = _discs(gel, generator, int(generator.integers(5, 150)), (0.5, 5))
    return gel * (1 - specks * generator.uniform(0.2, 0.8))


def _bubbles(gel: Floats, generator: np.random.Generator) -> Floats:
    """Bright specks with a dark rim."""
    count, state = int(generator.integers(5, 120)), generator.bit_generator.state
    rims = _discs(gel, generator, count, (2, 7))
    generator.bit_generator.state = state
    cores = _discs(gel, generator, count, (1, 4.5))
    return gel * (1 - 0.4 * rims) + 80 * cores


def _lamps(gel: Floats, generator: np.random.Generator) -> Floats:
    """A row of saturated lamps along one border, and their glow."""
    height, width = gel.shape[:2]
    lamps, count = np.zeros((height, width)), int(generator.integers(3, 9))
    for x in (np.arange(count) + 0.5) * width / count:
        cv2.circle(lamps, (int(x), 8), int(generator.integers(4, 8)), 1.0, -1)
    glow = cv2.GaussianBlur(lamps, (0, 0), 15)
    return np.asarray(gel + 600 * glow[..., None] + 255 * lamps[..., None], np.float64)


def _cloth(gel: Floats, generator: np.random.Generator) -> Floats:
    """Threads in two directions, each as dark as it likes, that waver."""
    height, width = gel.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float64)
    turn, drawn = generator.uniform(0, np.pi), gel
    for angle in (turn, turn + np.pi / 2 + generator.normal(0, 0.1)):
        waver = cv2.GaussianBlur(generator.normal(0, 1, (height, width)), (0, 0), 12)
        along = x * np.cos(angle) + y * np.sin(angle) + waver / waver.std() * generator.uniform(1, 4)
        wave = np.sin(2 * np.pi * along / generator.uniform(5, 25))
        drawn = drawn * (1 + generator.uniform(0.05, 0.2) * wave[..., None])
    return np.asarray(drawn, np.float64)


def spread_at_rest(pictures: Sequence[Picture]) -> tuple[float, float]:
    """Median over the dots of their spread (standard deviation, px) over frames at rest, by coordinate; and
    the part of it that each dot has on its own: without what a motion of the whole gel, quadratic in the
    place, explains in each frame.

    Raises NoMarkersError if the first frame has no dots.
    """
    tracker = MarkerTracker(pictures[0])
    tracked = [tracker.track(picture) for picture in pictures]
    origin = tracked[0].origin
    moved = np.stack([markers.position[: len(origin)] - origin for markers in tracked])
    x, y = ((origin - origin.mean(axis=0)) / origin.std(axis=0)).T
    basis, _ = np.linalg.qr(np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y]))
    own = moved - basis @ (basis.T @ moved)
    return float(np.median(moved.std(axis=0))), float(np.median(own.std(axis=0)))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="recordings named in `REST_FRAMES`")
    data = parser.parse_args().data
    pictures, found = Counter[str](), Counter[str]()
    for kind, picture in without_dots():
        pictures[kind] += 1
        found[kind] += len(find(picture)) > 0
    rows = [(kind, str(pictures[kind]), str(found[kind])) for kind in pictures]
    print(*table([("without dots", "pictures", "with some found"), *rows]), sep="\n")
    for recording, (first, end) in REST_FRAMES.items() if data else ():
        with closing(open_source(str(data / recording))) as reader:
            frames = [to_bgr(read[0], recording) for read in islice(iter(reader.read, None), first, end)]
        spread, own = spread_at_rest(frames)
        print(f"{recording}: dots at rest spread by {spread:.3f} px (median), each alone by {own:.3f}")


if __name__ == "__main__":
    main()
