"""The numbers and the picture of contact-limits.md, from the recordings of five grasps.

    python docs/contact_limits.py ../shared/data/wedge_grasp

prints the tables and writes contact-limits.svg beside this file. Takes about two minutes.
"""

from __future__ import annotations

import csv
import itertools
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.recordings import CONTACT_FORCE
from tactflow.vision.contact import ContactDetector
from tactflow.vision.geometry import Preprocessor

Bools = NDArray[np.bool_]
Values = NDArray[np.float64]

NAMES = {
    "bolt_0": "bolt",
    "foam_brick_2": "foam",
    "golf_ball_1": "golf ball",
    "purple_ball_hardest_3": "soft ball",
    "rose_eraser_1": "eraser",
}


@dataclass(frozen=True)
class Grasp:
    """One recording. force : (N,) N. frames : raw, (480, 640, 3) uint8."""

    name: str
    force: Values
    frames: list[NDArray[np.uint8]]

    @property
    def contact(self) -> Bools:
        """(N,) bool: what the force says."""
        return self.force >= CONTACT_FORCE


@dataclass(frozen=True)
class Trial:
    """One set of constants, and in which frames of each grasp it says contact."""

    constants: tuple[float, ...]
    said: tuple[Bools, ...]


def load(folder: Path) -> list[Grasp]:
    """All recordings of a folder, each a film and its forces."""
    grasps = []
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            force = np.array([float(row["force_n"]) for row in csv.DictReader(file)])
        film = cv2.VideoCapture(str(path.with_suffix(".avi")))
        frames = [np.asarray(film.read()[1], np.uint8) for _ in force]
        grasps.append(Grasp(NAMES.get(path.stem, path.stem), force, frames))
    if not grasps:
        raise SystemExit(f"{folder}: required recordings, got no .csv file")
    return grasps


def change_of_the_picture(grasp: Grasp, smoothing: float) -> Values:
    """(N,): largest colour difference to the mean of the frames before contact, grey levels.

    smoothing : px of the camera. Each channel's median is taken out. Frames before contact are compared with
    the mean of the others. This knows when contact begins, and is no detector.
    """
    first = int(np.argmax(grasp.contact))
    pictures = []
    for frame in grasp.frames:
        small = cv2.resize(frame, (160, 120), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = np.asarray(cv2.GaussianBlur(small, (0, 0), smoothing / 4), np.float32)
        pictures.append(small - np.median(small.reshape(-1, 3), axis=0))
    change = []
    for index, picture in enumerate(pictures):
        rest = np.mean([pictures[other] for other in range(first) if other != index], axis=0)
        change.append(float(np.sqrt(((picture - rest) ** 2).sum(axis=2)).max()))
    return np.array(change)


def with_hysteresis(change: Values, start: float, stay: float, part: float) -> Bools:
    """Contact from a threshold on, until less than `stay` or a part of the peak is left."""
    said: list[bool] = []
    peak, touching = 0.0, False
    for value in change:
        peak = max(peak, value) if touching or not said else peak
        touching = bool(value >= max(stay if touching else start, part * peak))
        said.append(touching)
    return np.array(said)


def threshold_trials(grasps: list[Grasp], smoothing: float) -> list[Trial]:
    """All constants of the family "threshold, hysteresis, part of the peak"."""
    changes = [change_of_the_picture(grasp, smoothing) for grasp in grasps]
    return [
        Trial(
            (start, hold, part),
            tuple(with_hysteresis(change, start, hold * start, part) for change in changes),
        )
        for start in np.arange(2, 26, 0.5)
        for hold in (0.5, 0.75, 1.0)
        for part in np.arange(0, 0.4, 0.01)
    ]


def detect(grasps: list[Grasp], downsample: int, **settings: float) -> tuple[Bools, ...]:
    """What the detector says, with the first frame of each recording as reference."""
    preprocess = Preprocessor((640, 480), rotate=90, downsample=downsample)
    said = []
    for grasp in grasps:
        detector = ContactDetector(**settings)  # type: ignore[arg-type]
        found = []
        for frame in grasp.frames:
            image = preprocess(frame)
            if not detector.has_reference:
                detector.add_reference(image)
            found.append(detector.detect(image).touching)
        said.append(np.array(found))
    return tuple(said)


def detector_trials(grasps: list[Grasp]) -> list[Trial]:
    """A grid of the detector's own constants around those that it has."""
    grid = itertools.product(
        (1e-6, 1e-3), (0.005, 0.007, 0.01, 0.014), (0.12, 0.16, 0.2, 0.25), (0.05, 0.07, 0.1, 0.15)
    )
    return [
        Trial(
            (alarms, tint, part, creep),
            detect(grasps, 2, shift=0.5, false_alarms=alarms, tint=tint, relaxation=part, creep=creep),
        )
        for alarms, tint, part, creep in grid
    ]


def wrong(said: Iterable[Bools], grasps: list[Grasp], later: int = 0) -> NDArray[np.int64]:
    """(G,): frames in which each grasp disagrees with the force, which may be told so many frames later."""
    truths = [np.append(g.contact[later:], np.repeat(g.contact[-1:], later)) for g in grasps]
    return np.array([int((a != b).sum()) for a, b in zip(said, truths, strict=True)])


def judge(trials: list[Trial], grasps: list[Grasp]) -> str:
    """Best constants for all grasps, for each alone, and for those that they were not chosen on."""
    errors = np.array([wrong(trial.said, grasps) for trial in trials])
    frames = np.array([len(grasp.force) for grasp in grasps])
    every = set(range(len(grasps)))

    def unseen(chosen_on: tuple[int, ...]) -> tuple[float, int]:
        known = errors[:, chosen_on].sum(axis=1)
        rest = sorted(every - set(chosen_on))
        ties = errors[known == known.min()][:, rest]
        return float(ties.sum(axis=1).mean()), int(frames[rest].sum())

    def share(splits: Iterable[tuple[int, ...]]) -> float:
        wrongs, counts = zip(*(unseen(split) for split in splits), strict=True)
        return 100 - 100 * float(sum(wrongs)) / float(sum(counts))

    total = int(frames.sum())
    best = int(errors.sum(axis=1).argmin())
    count = len(grasps)
    halves = [c for size in (count // 2, count - count // 2) for c in itertools.combinations(every, size)]
    constants = ", ".join(f"{value:g}" for value in trials[best].constants)
    return (
        f"one set for all {_right(int(errors[best].sum()), total)} ({constants}); "
        f"a set for each {_right(int(errors.min(axis=0).sum()), total)}; "
        f"chosen on half, judged on the other {share(halves):.1f} %; "
        f"chosen on all but one {share(itertools.combinations(every, count - 1)):.1f} %"
    )


def _right(count: int, total: int) -> str:
    return f"{count} wrong, {100 - 100 * count / total:.1f} %"


LEGEND = (
    '<rect x="70" y="8" width="14" height="10" fill="#e4ecf7"/>'
    '<text x="88" y="17">force &#8805; 0.75 N</text>'
    '<path d="M180 13h22" stroke="#c0392b" stroke-width="2"/>'
    '<text x="206" y="17">grip force, 0.03 to 60 N</text>'
    '<path d="M350 13h22" stroke="#1f4e79" stroke-width="2"/>'
    '<text x="376" y="17">change of the picture, 1 to 300 grey levels</text>'
    '<rect x="622" y="9" width="14" height="7" fill="#4a7a3f"/><text x="640" y="17">called contact</text>'
    '<rect x="736" y="11" width="14" height="4" fill="#d9a300"/>'
    '<text x="754" y="17">disagrees</text>'
)
"""What the colours of the figure mean, SVG."""


def picture(grasps: list[Grasp], said: tuple[Bools, ...]) -> str:
    """The figure as SVG."""
    width, height, left, gap, most = 900, 118, 70, 26, 80
    rows = []
    top = 30.0

    def x(frame: float) -> float:
        return left + (width - left - 10) * frame / most

    def scaled(values: Values, low: float, high: float) -> Values:
        return np.asarray(np.log(np.clip(values, low, high) / low) / np.log(high / low))

    def bars(contact: Bools, y: float, tall: float, colour: str) -> None:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], contact.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            rows.append(
                f'<rect x="{x(begin - 0.5):.1f}" y="{y:.1f}" width="{x(end - 0.5) - x(begin - 0.5):.1f}" '
                f'height="{tall}" fill="{colour}"/>'
            )

    for grasp, found in zip(grasps, said, strict=True):
        bars(grasp.contact, top, height, "#e4ecf7")
        bars(found, top + height + 2, 7, "#4a7a3f")
        bars(found != grasp.contact, top + height + 11, 4, "#d9a300")
        rows.append(
            f'<rect x="{left}" y="{top}" width="{width - left - 10}" height="{height}" fill="none" '
            f'stroke="#aaa"/><text x="8" y="{top + height / 2}">{escape(grasp.name)}</text>'
        )
        for values, low, high, colour in (
            (grasp.force, 0.03, 60.0, "#c0392b"),
            (change_of_the_picture(grasp, 8), 1.0, 300.0, "#1f4e79"),
        ):
            points = " ".join(
                f"{x(index):.1f},{top + height * (1 - part):.1f}"
                for index, part in enumerate(scaled(values, low, high))
            )
            rows.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
        top += height + gap
    rows += [
        f'<text x="{x(tick):.0f}" y="{top + 6:.0f}" text-anchor="middle">{tick}</text>'
        for tick in range(0, most + 1, 10)
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {top + 28:.0f}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
        + LEGEND
        + "\n".join(rows)
        + f'<text x="{(left + width) / 2}" y="{top + 21:.0f}" text-anchor="middle">frame (30 a second)</text>'
        "</svg>\n"
    )


def main(folder: Path, say: Callable[[str], None]) -> None:
    """Print all numbers and write the picture."""
    grasps = load(folder)
    total = sum(len(grasp.force) for grasp in grasps)
    said = detect(grasps, 2, shift=0.5)
    for grasp, found in zip(grasps, said, strict=True):
        off = np.flatnonzero(found != grasp.contact)
        say(f"{grasp.name}: disagrees in {', '.join(str(frame) for frame in off)}")
    say(f"as shipped: {_right(int(wrong(said, grasps).sum()), total)}")
    say(f"full resolution: {_right(int(wrong(detect(grasps, 1), grasps).sum()), total)}")
    for later in range(5):
        say(f"force told {later} frames earlier: {_right(int(wrong(said, grasps, later).sum()), total)}")
    everything: list[Trial] = []
    for smoothing in (4.0, 8.0, 16.0, 32.0):
        trials = threshold_trials(grasps, smoothing)
        everything += trials
        say(f"threshold, {smoothing:g} px: {judge(trials, grasps)}")
    say(f"threshold, any of them: {judge(everything, grasps)}")
    say(f"detector: {judge(detector_trials(grasps), grasps)}")
    figure = Path(__file__).with_name("contact-limits.svg")
    figure.write_text(picture(grasps, said), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: contact_limits.py FOLDER")
    cv2.setNumThreads(1)
    main(Path(sys.argv[1]), print)
