"""How well the dots of a gel are found, and where none are.

    python -m tactflow.bench.judge_dots --data RECORDINGS [--fit]

Dots were marked by eye in frames of recordings of real sensors (as with `python -m tactflow.bench.label
--dots`); `dots.json` beside this file has them, and frames of gels without dots. A dot that was marked in
only one of two rounds is uncertain: it need not be found, and is not false where it is. So is what the border
may cut. Positions were refined by the detector of the package: this judges which dots are found, not where.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from tactflow.bench.label_file import FrameLabel, load_labels
from tactflow.bench.probability import fitted
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.sources import open_source
from tactflow.system.terminal import say, table
from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.markers import MarkerTracker, NoMarkersError, detect_markers
from tactflow.vision.markers.lattice import nearest

DOTS: Final = Path(__file__).with_name("dots.json")
TOLERANCE: Final = 0.3
"""Distance of a dot from its mark, as a fraction of the distance between neighbours: a person's click and a
centroid differ by so much where a glint covers half a dot, and no other dot is as near."""
BORDER: Final = 0.12
"""Distance from the border of the picture, as a fraction of the distance between neighbours, within which a
dot is uncertain: most dots have a radius of 0.12 to 0.3 of it, so the border cuts off half of such a dot."""
REST: Final = {
    "gels/seu_a/video.mp4": (10, 50),
    "gels/handmade_dots/video.avi": (0, 14),
    "gels/tactip_video": (0, 29),
    "gels/franka_mini/cheese_tube-1-0.avi": (14, 24),
}
"""Recording -> its frames (first, end) in which nothing touches the gel and the exposure is steady."""
Picture = NDArray[np.uint8]
Finder = Callable[[Picture], Floats]
"""(H, W, 3) BGR -> centres (N, 2), px."""


@dataclass(frozen=True, slots=True)
class FoundDots:
    """lab : of the label. dots : that have to be found. found : of these. false : found where there is none.

    kind : empty for the picture as it is; else how it was changed, or what it shows in place of dots.
    """

    lab: str
    dots: int
    found: int
    false: int
    kind: str = ""


def find(picture: Picture) -> Floats:
    """The centres (N, 2) that the package finds; none where it says that there are none."""
    try:
        return detect_markers(picture).centers
    except NoMarkersError:
        return np.zeros((0, 2))


def compare(lab: str, found: Floats, dots: Floats, uncertain: Floats, size: tuple[int, int]) -> FoundDots:
    """Assign what was found, (N, 2), to what a person marked, so that the sum of distances is least.

    dots, uncertain : (M, 2), (K, 2), px. size : of the picture (width, height): what is nearer to its border
    than `BORDER` is uncertain, too.
    """
    if not len(dots):
        return FoundDots(lab, 0, 0, len(found))
    which, inner = assign(found, dots, uncertain, size)
    required = _from_border(dots, size) > BORDER * _pitch(dots)
    seen = np.isin(np.arange(len(dots)), which)
    false = np.count_nonzero((which < 0) & inner)
    return FoundDots(lab, int(required.sum()), int((required & seen).sum()), int(false))


def assign(found: Floats, dots: Floats, uncertain: Floats, size: tuple[int, int]) -> tuple[Indices, Flags]:
    """For each one found, (N,): the number of the marked dot that it is, uncertain ones last, or -1; and
    whether it is far enough from the border to be judged. Arguments as of `compare`."""
    marked, pitch = np.concatenate([dots, uncertain]), _pitch(dots)
    apart = nearest(dots, 1)[0][:, 0] if len(dots) > 1 else np.full(1, pitch)
    reach = TOLERANCE * np.concatenate([apart, np.full(len(uncertain), pitch)])
    away = np.linalg.norm(found[:, None] - marked, axis=2)
    # A pair beyond reach costs as much as no pair.
    rows, columns = linear_sum_assignment(np.minimum(away / reach, 1.0))
    paired = away[rows, columns] < reach[columns]
    which = np.full(len(found), -1, np.int64)
    which[rows[paired]] = columns[paired]
    return which, np.asarray(_from_border(found, size) > BORDER * pitch)


def _pitch(dots: Floats) -> float:
    """Median distance of dots, (M, 2), to their nearest neighbours, px; 1000 for a single one."""
    return float(np.median(nearest(dots, 1)[0])) if len(dots) > 1 else 1000.0


def _from_border(points: Floats, size: tuple[int, int]) -> Floats:
    """Distances of points (N, 2) from the border of a picture (width, height): (N,), px."""
    return np.asarray(np.minimum(points, np.array(size) - 1 - points).min(axis=1), np.float64)


def judge(
    labels: Sequence[FrameLabel],
    data: Path,
    finder: Finder = find,
    report: Callable[[str], None] = say,
    kinds: Iterable[str] | None = None,
) -> Iterator[FoundDots]:
    """Look for dots in each labelled frame, as it is and changed; in frames without dots only as they are.

    report : called with the recordings that are not there. kinds : keys of `CHANGES`; None for all.

    Raises
    ------
    SourceError : a recording cannot be read. ConfigError : it has no such frame.
    """
    for lab, kind, picture, dots, uncertain in labelled(labels, data, report, kinds):
        size = (picture.shape[1], picture.shape[0])
        if len(dots):
            yield replace(compare(lab, finder(picture), dots, uncertain, size), kind=kind)
        else:
            yield FoundDots(lab, 0, 0, len(finder(picture)), "real")


def labelled(
    labels: Sequence[FrameLabel],
    data: Path,
    report: Callable[[str], None] = say,
    kinds: Iterable[str] | None = None,
) -> Iterator[tuple[str, str, Picture, Floats, Floats]]:
    """Lab, kind, picture, dots (M, 2) and uncertain dots (K, 2), px, of each labelled frame, as it is and
    changed; of frames without dots only as they are. Arguments and errors as of `judge`."""
    second = {(label.recording, label.frame): label.dots for label in labels if label.round == 2}
    kinds = list(CHANGES if kinds is None else kinds)
    for label in labels:
        if label.round != 1 or label.dots is None:
            continue
        if not (data / label.recording).exists():
            report(f"{label.recording}: not in {data}, left out")
            continue
        picture = frames(data, label.recording, _index(label), _index(label) + 1)[0]
        dots = _points(label.dots)
        again = second.get((label.recording, label.frame))
        sure, uncertain = (dots, dots[:0]) if again is None else _agreed(dots, _points(again))
        for kind in kinds if len(dots) else [""]:
            changed, matrix = CHANGES[kind](picture)
            required, possible = (points @ matrix[:, :2].T + matrix[:, 2] for points in (sure, uncertain))
            yield label.lab, kind, changed, required, possible


def fit(labels: Sequence[FrameLabel], data: Path) -> Iterator[str]:
    """The weights of a dot's probability, and how true it is."""
    labs, evidences, are_dots = [], [], []
    for name, _, picture, dots, uncertain in labelled(labels, data, kinds=("", "half size", "JPEG 30")):
        try:
            found = detect_markers(picture, least_probability=0.0)
        except NoMarkersError:
            continue
        if len(dots) and found.evidence is not None:
            which, inner = assign(found.centers, dots, uncertain, (picture.shape[1], picture.shape[0]))
            judged = inner & (which < len(dots))
            evidences.append(found.evidence[judged])
            are_dots.append(which[judged] >= 0)
            labs.append(np.full(judged.sum(), name))
    if not evidences:
        raise ConfigError(f"--data {data}: has none of the labelled recordings")
    yield from fitted(*map(np.concatenate, (labs, evidences, are_dots)))


def _index(label: FrameLabel) -> int:
    if not isinstance(label.frame, int):
        raise ConfigError(f"{label.recording}: frame {label.frame!r}; required an index")
    return label.frame


def _points(points: Iterable[tuple[float, float]]) -> Floats:
    return np.array(list(points), np.float64).reshape(-1, 2)


def _agreed(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """The dots of both rounds, and those of only one: within a pixel they are the same."""
    both = np.asarray(KDTree(second).query(first)[0]) < 1
    rest = np.asarray(KDTree(first).query(second)[0]) >= 1
    return first[both], np.concatenate([first[~both], second[rest]])


def frames(data: Path, recording: str, first: int, end: int) -> list[Picture]:
    """Frames `first` to `end` - 1 of a recording; raises ConfigError if it is shorter."""
    with closing(open_source(str(data / recording))) as reader:
        kept = []
        for index in range(end):
            if (read := reader.read()) is None:
                raise ConfigError(f"{recording}: has no frame {index}")
            if index >= first:
                color = read[0] if read[0].ndim == 3 else cv2.cvtColor(read[0], cv2.COLOR_GRAY2BGR)
                kept.append(np.asarray(color, np.uint8))
    return kept


def _resized(picture: Picture, scale: float) -> tuple[Picture, Floats]:
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2]])


def _jpeg(picture: Picture, quality: int) -> Picture:
    packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)


def _gray(picture: Picture) -> Picture:
    return np.asarray(cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR), np.uint8)


_SAME: Final = np.eye(2, 3)
CHANGES: Final[Mapping[str, Callable[[Picture], tuple[Picture, Floats]]]] = {
    "": lambda picture: (picture, _SAME),
    "half size": lambda picture: _resized(picture, 0.5),
    "turned": lambda picture: (
        np.ascontiguousarray(np.rot90(picture)),
        np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, picture.shape[1] - 1.0]]),
    ),
    "mirrored": lambda picture: (
        np.ascontiguousarray(picture[:, ::-1]),
        np.array([[-1.0, 0.0, picture.shape[1] - 1.0], [0.0, 1.0, 0.0]]),
    ),
    "gray": lambda picture: (_gray(picture), _SAME),
    "dark": lambda picture: (np.asarray(picture * 0.5, np.uint8), _SAME),
    "JPEG 30": lambda picture: (_jpeg(picture, 30), _SAME),
}
"""What changes nothing about where dots are: name -> the changed picture, and the matrix (2, 3) that maps
points to it."""


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


def summary(judged: Sequence[FoundDots]) -> Iterator[str]:
    """Lines of two tables: labelled frames by lab, and pictures without dots by kind."""
    dotted, plain = [one for one in judged if one.dots], [one for one in judged if not one.dots]
    heading = ("lab", "dots", "found", "false", *(kind for kind in CHANGES if kind))
    labs = {lab: [one for one in dotted if one.lab == lab] for lab in sorted({one.lab for one in dotted})}
    yield from table(
        [heading, *(_row(lab or "-", group) for lab, group in labs.items()), _row("all", dotted)]
    )
    yield ""
    rows = [("without dots", "pictures", "with some found")]
    for kind in [*sorted({one.kind for one in plain}), "all"]:
        group = [one for one in plain if kind in (one.kind, "all")]
        rows.append((kind, str(len(group)), str(sum(one.false > 0 for one in group))))
    yield from table(rows)


def _row(name: str, group: Sequence[FoundDots]) -> tuple[str, ...]:
    """Dots found and false of the pictures as they are, in percent of those marked; then of each change."""
    cells = []
    for kind in CHANGES:
        ones = [one for one in group if one.kind == kind]
        dots = max(sum(one.dots for one in ones), 1)
        found, false = (100 * sum(getattr(one, key) for one in ones) / dots for key in ("found", "false"))
        cells += [f"{found:.1f} + {false:.1f}"] if kind else [str(dots), f"{found:.1f} %", f"{false:.1f} %"]
    return name, *cells


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tactflow.bench.judge_dots", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="recordings that the labels name")
    add("--labels", type=Path, default=DOTS, metavar="FILE", help="default: those of the package")
    add(
        "--fit",
        action="store_true",
        help="fit the probability of a dot, and tell how true it is",
    )
    options = parser.parse_args(arguments)
    try:
        if options.fit:
            print(*fit(load_labels(options.labels), options.data), sep="\n")
            return 0
        judged = list(judge(load_labels(options.labels), options.data))
        if not judged:
            raise ConfigError(f"--data {options.data}: has none of the recordings of {options.labels}")
        judged += [FoundDots("", 0, 0, len(find(picture)), kind) for kind, picture in without_dots()]
        print(*summary(judged), sep="\n")
        print("\nFound + false of each change in percent of the dots marked.")
        for recording, (first, end) in REST.items():
            if (options.data / recording).exists():
                spread, own = spread_at_rest(frames(options.data, recording, first, end))
                print(
                    f"{recording}: dots at rest spread by {spread:.3f} px (median), each alone by {own:.3f}"
                )
    except TactflowError as error:
        say(f"tactflow: {error}")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
