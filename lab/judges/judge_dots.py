"""Compare detected dots with those that a person marked on gels, and count false ones on gels without.

    python -m lab.judges.judge_dots --data RECORDINGS
    python -m lab.judges.judge_dots --data RECORDINGS default --set stages.marker_mask.use=top_hat --mask

Dots were marked by eye in recordings of real sensors (as with `python -m lab.judges.label --dots`);
`dots.json` beside this file has them, and frames of gels without dots. A dot marked in only one of two rounds
is uncertain, and so is one that the border may cut: finding it is neither required nor wrong. Positions were
refined by the package's detector, so this judges which dots are found, not where.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import groupby, islice
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from lab.judges.judge import add_set, settings_of
from lab.judges.label_file import FrameLabel, load_labels
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.sources import open_source
from tactflow.sources.base import to_bgr
from tactflow.streaming import stream
from tactflow.system.terminal import say, table
from tactflow.tools.bench.metrics import mask_centroids
from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.markers import NoMarkersError, detect_markers
from tactflow.vision.markers.lattice import nearest
from tactflow.vision.types import MarkerStatus

DOTS: Final = Path(__file__).with_name("dots.json")
TOLERANCE_SPACINGS: Final = 0.3
"""Distance of a dot from its mark, as a fraction of the distance between neighbours: a person's click and a
centroid differ by so much where a glint covers half a dot, and no other dot is as near."""
BORDER_SPACINGS: Final = 0.12
"""Distance from the border of the picture, as a fraction of the distance between neighbours, within which a
dot is uncertain: most dots have a radius of 0.12 to 0.3 of it, so the border cuts off half of such a dot."""
Picture = NDArray[np.uint8]
Finder = Callable[[Picture], Floats]
"""(H, W, 3) BGR -> centres (N, 2), px."""


@dataclass(frozen=True, slots=True)
class FoundDots:
    """lab : of the label. dots : required ones. found : of these. false : detections that are not dots.

    kind : how the picture was changed; empty if it was not.
    """

    lab: str
    dots: int
    found: int
    false: int
    kind: str = ""


def find(picture: Picture) -> Floats:
    """The centres (N, 2) that the package finds."""
    try:
        return detect_markers(picture).centers
    except NoMarkersError:
        return np.zeros((0, 2))


def pipeline_finder(pipeline: str, settings: Mapping[str, Any], mask: bool = False) -> Finder:
    """Finds what a pipeline finds in a picture, taken as the reference: markers, or spots of its marker mask.

    pipeline, settings : as for `tactflow.stream`. mask : whether to take the mask.
    """
    as_it_is = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 1, "stages.capture.settle": 0}

    def find_in(picture: Picture) -> Floats:
        try:
            (result,) = stream(pipeline, source=[picture], settings={**as_it_is, **settings})
        except ConfigError:
            raise
        except TactflowError:  # no dots, says the tracker
            return np.zeros((0, 2))
        if mask:
            return mask_centroids(result["marker_mask"])
        markers = result.markers
        seen = markers is not None and markers.status == MarkerStatus.TRACKED
        return np.zeros((0, 2)) if markers is None else markers.position[seen]

    return find_in


def compare(lab: str, found: Floats, dots: Floats, uncertain: Floats, size: tuple[int, int]) -> FoundDots:
    """Compare detections (N, 2) with the marked dots, by the assignment with the least sum of distances.

    dots, uncertain : (M, 2), (K, 2), px. size : of the picture (width, height); dots nearer to its border
    than `BORDER_SPACINGS` are uncertain, too.
    """
    if not len(dots):
        return FoundDots(lab, 0, 0, len(found))
    which, inner = assign(found, dots, uncertain, size)
    required = _from_border(dots, size) > BORDER_SPACINGS * _pitch(dots)
    seen = np.isin(np.arange(len(dots)), which)
    false = np.count_nonzero((which < 0) & inner)
    return FoundDots(lab, int(required.sum()), int((required & seen).sum()), int(false))


def assign(found: Floats, dots: Floats, uncertain: Floats, size: tuple[int, int]) -> tuple[Indices, Flags]:
    """For each detection, (N,): index of its marked dot, uncertain ones last, or -1; and whether it is far
    enough from the border to be judged. Arguments as of `compare`."""
    marked, pitch = np.concatenate([dots, uncertain]), _pitch(dots)
    apart = nearest(dots, 1)[0][:, 0] if len(dots) > 1 else np.full(1, pitch)
    reach = TOLERANCE_SPACINGS * np.concatenate([apart, np.full(len(uncertain), pitch)])
    away = np.linalg.norm(found[:, None] - marked, axis=2)
    # A pair beyond reach costs as much as no pair.
    rows, columns = linear_sum_assignment(np.minimum(away / reach, 1.0))
    paired = away[rows, columns] < reach[columns]
    which = np.full(len(found), -1, np.int64)
    which[rows[paired]] = columns[paired]
    return which, np.asarray(_from_border(found, size) > BORDER_SPACINGS * pitch)


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
    """Detect dots in each labelled frame, as it is and changed; in frames without dots only as they are.

    report : called with missing recordings. kinds : keys of `CHANGES`; None for all.

    Raises
    ------
    SourceError : a recording cannot be read. ConfigError : it has no such frame.
    """
    for lab, kind, picture, dots, uncertain in labelled(labels, data, report, kinds):
        size = (picture.shape[1], picture.shape[0])
        if len(dots):
            yield replace(compare(lab, finder(picture), dots, uncertain, size), kind=kind)
        else:
            yield FoundDots(lab, 0, 0, len(finder(picture)))


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
        picture = _frame(data, label)
        dots = _points(label.dots)
        again = second.get((label.recording, label.frame))
        sure, uncertain = (dots, dots[:0]) if again is None else _agreed(dots, _points(again))
        for kind in kinds if len(dots) else [""]:
            changed, matrix = CHANGES[kind](picture)
            required, possible = (points @ matrix[:, :2].T + matrix[:, 2] for points in (sure, uncertain))
            yield label.lab, kind, changed, required, possible


def _points(points: Iterable[tuple[float, float]]) -> Floats:
    return np.array(list(points), np.float64).reshape(-1, 2)


def _agreed(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """The dots of both rounds, and those of only one; two marks within a pixel are the same dot."""
    both = np.asarray(KDTree(second).query(first)[0]) < 1
    rest = np.asarray(KDTree(first).query(second)[0]) >= 1
    return first[both], np.concatenate([first[~both], second[rest]])


def _frame(data: Path, label: FrameLabel) -> Picture:
    """A labelled frame; raises ConfigError if the recording is shorter."""
    with closing(open_source(str(data / label.recording))) as reader:
        frames = list(islice(iter(reader.read, None), label.index, label.index + 1))
    if not frames:
        raise ConfigError(f"{label.recording}: has no frame {label.index}")
    return to_bgr(frames[0][0], label.recording)


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
"""Name of a change -> function that returns the changed picture and the matrix (2, 3) that maps points to
it."""


def summary(judged: Sequence[FoundDots]) -> Iterator[str]:
    """Lines of a table by lab, and how many pictures without dots have some found."""
    dotted = sorted((one for one in judged if one.dots), key=lambda one: one.lab)
    plain = [one for one in judged if not one.dots]
    heading = ("lab", "dots", "found", "false", *(kind for kind in CHANGES if kind))
    labs = [_row(lab or "-", list(group)) for lab, group in groupby(dotted, key=lambda one: one.lab)]
    yield from table([heading, *labs, _row("all", dotted)])
    yield "Found + false of each change in percent of the dots marked."
    yield f"Pictures without dots: {len(plain)}, with some found: {sum(one.false > 0 for one in plain)}"


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
    parser = argparse.ArgumentParser(prog="python -m lab.judges.judge_dots", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("--data", type=Path, required=True, metavar="DIR", help="recordings that the labels name")
    add("--labels", type=Path, default=DOTS, metavar="FILE", help="default: those of the package")
    add("pipeline", nargs="?", metavar="PIPELINE", help="judge its markers instead of the package's detector")
    add("--mask", action="store_true", help="judge the spots of its marker mask instead of its markers")
    add_set(parser)
    options = parser.parse_args(arguments)
    try:
        finder = find
        if options.pipeline is not None or options.set or options.mask:
            finder = pipeline_finder(options.pipeline or "default", settings_of(options.set), options.mask)
        judged = list(judge(load_labels(options.labels), options.data, finder))
        if not judged:
            raise ConfigError(f"--data {options.data}: has none of the recordings of {options.labels}")
        print(*summary(judged), sep="\n")
    except TactflowError as error:
        say(f"tactflow: {error}")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
