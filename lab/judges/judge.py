"""Compare the contacts that pipelines find in recordings of real sensors with outlines, lab by lab.

    python -m lab.judges.judge --data RECORDINGS
    python -m lab.judges.judge --data RECORDINGS --labels mine.json default mine.yaml
    python -m lab.judges.judge --data RECORDINGS --set stages.difference.use=otsu --set stages.fusion=null
    python -m lab.judges.judge --data RECORDINGS --fit stages.difference.border=0.55,0.7,0.85
    python -m lab.judges.judge --data RECORDINGS --gray --every 2
    python -m lab.judges.judge --data RECORDINGS --dirt 3

A person outlined the contacts (`python -m lab.judges.label`); `outlines.json` beside this file has
outlines of recordings of fifteen labs. A recording runs as a whole, as a user would run it; pictures of
separate presses run one after the other, after their reference. `--gray` judges as if all cameras recorded no
colours; `--dirt` as if specks had landed on the lens before the first labelled frame of each recording.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.judges.label_file import FrameLabel, load_labels
from tactflow.config.document import parse_value
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.message.result import Result
from tactflow.sources import open_source
from tactflow.sources.files import load_image
from tactflow.stages.capture import Capture
from tactflow.streaming import stream
from tactflow.system.terminal import say, table
from tactflow.tools.bench import metrics
from tactflow.tools.bench.score import MIN_DIRECTED_AXIS_RATIO
from tactflow.tools.stress.perturbation import specks
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers.detection import to_gray

OUTLINES: Final = Path(__file__).with_name("outlines.json")
"""Outlines drawn for the package, and frames at rest, see `label_file`."""
PLAIN: Final = (
    "gels/9dtact_1",
    "gels/digit_fots",
    "gels/jar_7_31_2",
    "gels/jar_8_06_1",
    "gels/mini_box",
    "gels/thu_real",
    "mini_ball_gelslam",
    "wedge_grasp",
    "wedge_grip",
)
"""Recordings in `OUTLINES` of gels without dots: `default` is replaced by `markerless` there."""
WORST_COUNT, COLUMN_COUNT, TILE_SIDE_PX = 20, 5, 240
"""The picture of the worst frames: their number, its columns, and the side of a frame, px."""
GREEN, RED, WHITE, GRAY = (0, 255, 0), (0, 0, 255), (255, 255, 255), 64
MAX_WHOLE_SIDE_PX: Final = 500
"""Pictures with a longer side, px, are halved, as the documentation advises."""
Pictures = list[NDArray[np.uint8]]
"""(H, W, 3) BGR each."""


class Camera(NamedTuple):
    """What is wrong with the camera.

    gray : it records no colours. specks : number of specks on its lens; its reference is clean.
    """

    gray: bool = False
    specks: int = 0


AS_RECORDED: Final = Camera()

RESAMPLE_COUNT: Final = 1000
"""Bootstrap samples: enough for two digits of the bounds."""


@dataclass(frozen=True, slots=True)
class Judged:
    """What a pipeline found in a frame, compared with its label.

    lab, recording : of the label. touched, found : whether something touches, by label and by pipeline.
    hull, region : overlap (IoU) of the convex hulls and of the regions, 0..1; 0 for a missed contact. These
    and all that follow are NaN where the label has no outline.
    center : distance of the regions' centroids, px of the processed frame. angle : between their axes,
    degrees; NaN where the outline is less than twice as long as wide. area : of the region found over that of
    the outline. These three are NaN for a missed contact.
    """

    lab: str
    recording: str
    touched: bool
    found: bool
    hull: float = np.nan
    region: float = np.nan
    center: float = np.nan
    angle: float = np.nan
    area: float = np.nan


def compare(label: FrameLabel, result: Result) -> Judged:
    """Compare the result of a frame with its label, which says whether something touches."""
    contact, mapping = result.contact, result["mapping"]
    assert isinstance(mapping, PixelMapping)
    judged = Judged(label.lab, label.recording, bool(label.contact), contact is not None)
    if not label.outlines:
        return judged
    shape, truth = mapping.size[::-1], outlined(label, mapping)
    if contact is None or result.contact_mask is None:
        return replace(judged, hull=0.0, region=0.0)
    drawn = contact_geometry(truth)
    assert drawn is not None
    angle = np.nan
    if metrics.aspect_ratio(truth) >= MIN_DIRECTED_AXIS_RATIO and drawn.angle is not None:
        angle = 90.0 if contact.angle is None else metrics.angle_error(contact.angle, drawn.angle)
    return replace(
        judged,
        hull=metrics.polygon_iou(drawn.hull, contact.hull, shape),
        region=metrics.mask_iou(truth, result.contact_mask),
        center=float(metrics.distance(contact.center, drawn.center)),
        angle=angle,
        area=contact.region_area / drawn.region_area,
    )


def judge(
    pipeline: str,
    labels: Iterable[FrameLabel],
    data: Path,
    report: Callable[[str], None] = say,
    settings: Mapping[str, Any] = MappingProxyType({}),
    camera: Camera = AS_RECORDED,
) -> Iterator[Judged]:
    """Run each recording, and compare its labelled frames; arguments and errors as for `labelled`.

    Frames that a failing pipeline did not reach count as missed contacts.
    """
    for label, result in labelled(pipeline, labels, data, report, settings=settings, camera=camera):
        if result is None:
            yield Judged(label.lab, label.recording, bool(label.contact), False, hull=0.0, region=0.0)
        else:
            yield compare(label, result)


def labelled(
    pipeline: str,
    labels: Iterable[FrameLabel],
    data: Path,
    report: Callable[[str], None] = say,
    images: bool = False,
    settings: Mapping[str, Any] = MappingProxyType({}),
    camera: Camera = AS_RECORDED,
) -> Iterator[tuple[FrameLabel, Result | None]]:
    """Run each recording that exists, and return its labels and the results of these frames.

    pipeline : a file or the name of a shipped pipeline; see `PLAIN` for "default". labels : those with
    `contact` None are left out. data : folder that holds the recordings. report : called with what could not
    be judged, and why; frames that a failing pipeline did not reach have no result. images : whether the
    results hold the pictures. settings : of the pipeline, as for `tactflow.stream`. camera : what is wrong
    with it.

    Raises
    ------
    ConfigError : the pipeline is wrong, or a label names a frame that its recording cannot have.
    SourceError : a labelled picture cannot be read.
    """
    known = sorted((label for label in labels if label.contact is not None), key=_run)
    for (recording, reference), group in groupby(known, key=_run):
        path, wanted = data / recording, list(group)
        if not path.exists():
            report(f"{recording}: not in {data}, left out")
            continue
        chosen = "markerless" if pipeline == "default" and recording.startswith(PLAIN) else pipeline
        source: Path | Pictures = path
        if path.is_dir():
            source = [_picture(path, name) for name in (reference, *(str(label.frame) for label in wanted))]
            missing = dict(enumerate(wanted, 1))
        else:
            missing = {label.index: label for label in wanted}
        try:
            for result in _results(chosen, source, max(missing), images, settings, camera):
                if result.seq in missing and not result.frame.reference:
                    yield missing.pop(result.seq), result
        except ConfigError:
            raise
        except TactflowError as error:
            report(f"{recording}: {str(error).splitlines()[0]}")
        for label in missing.values():
            yield label, None


def draw_worst(
    pipeline: str,
    labels: Sequence[FrameLabel],
    data: Path,
    path: Path,
    blank: bool = False,
    camera: Camera = AS_RECORDED,
) -> None:
    """Draw the frames whose hulls (red) overlap least with the outlines (green).

    blank : leave the frames themselves out. camera : as for `labelled`.
    Raises ConfigError if there are no outlined frames, or the file cannot be written.
    """
    worst: list[tuple[float, int, NDArray[np.uint8]]] = []
    outlined = [label for label in labels if label.outlines]
    for number, (label, result) in enumerate(labelled(pipeline, outlined, data, images=True, camera=camera)):
        if result is not None and result.image is not None:
            overlap = compare(label, result).hull
            worst.append((overlap, number, _tile(label, result, f"{label.lab} {overlap:.2f}", blank)))
            worst = sorted(worst, key=lambda one: one[:2])[:WORST_COUNT]
    if not worst:
        raise ConfigError(f"--picture: {data} has no recording with an outlined frame")
    tiles = [tile for *_, tile in worst]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMN_COUNT)
    rows = [np.hstack(tiles[first : first + COLUMN_COUNT]) for first in range(0, len(tiles), COLUMN_COUNT)]
    try:
        written = cv2.imwrite(str(path), np.vstack(rows))
    except cv2.error:
        written = False
    if not written:
        raise ConfigError(f"--picture {path}: cannot be written; required a .png or .jpg in a folder")


def _tile(label: FrameLabel, result: Result, text: str, blank: bool) -> NDArray[np.uint8]:
    """(TILE_SIDE_PX, TILE_SIDE_PX, 3) uint8: a frame, or gray instead, with its outlines and its hull."""
    image, mapping = result.image, result["mapping"]
    assert image is not None
    image = np.full_like(image, GRAY) if blank else image
    factor = TILE_SIDE_PX / max(image.shape[:2])
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    found = [] if result.contact is None else [result.contact.hull]
    for polygons, colour in ((found, RED), (_outlines(label, mapping), GREEN)):
        corners = [np.rint(np.asarray(polygon) * factor).astype(np.int32) for polygon in polygons]
        cv2.polylines(small, corners, True, colour)
    cv2.putText(small, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, WHITE, 1, cv2.LINE_AA)
    tile = np.zeros((TILE_SIDE_PX, TILE_SIDE_PX, 3), np.uint8)
    tile[: small.shape[0], : small.shape[1]] = small
    return tile


def _outlines(label: FrameLabel, mapping: PixelMapping) -> list[NDArray[np.float64]]:
    """The outlines of a label, processed px, (n, 2) each."""
    return [mapping.to_processed(outline) for outline in label.outlines or ()]


def outlined(label: FrameLabel, mapping: PixelMapping) -> NDArray[np.uint8]:
    """(H, W): the outlined region of a processed frame, not 0 inside."""
    return metrics.filled_polygons(_outlines(label, mapping), mapping.size[::-1])


def _run(label: FrameLabel) -> tuple[str, str]:
    """Labels with an equal key are run together: a video, or pictures with the same reference."""
    return label.recording, label.reference if isinstance(label.reference, str) else ""


def _picture(folder: Path, name: str) -> NDArray[np.uint8]:
    """A picture by its name without the suffix, which may include a path relative to the folder."""
    path = folder / name
    files = sorted(path.parent.glob("*")) if path.parent.is_dir() else []
    found = next((file for file in files if file.stem == path.name), None)
    if found is None:
        raise ConfigError(f"{path}: there is no picture of that name")
    return load_image(str(found))


def _results(
    pipeline: str,
    source: Path | Pictures,
    last: int,
    images: bool,
    changed: Mapping[str, Any],
    camera: Camera,
) -> Iterator[Result]:
    still = {}
    if isinstance(source, Path):
        with closing(open_source(str(source))) as reader:
            first = reader.peek()
        size = max(first[0].shape) if first is not None else 0
    else:
        size = max(source[0].shape)
        # The label says which picture is the reference.
        still = {"stages.capture.settle": 0}
    geometry = {
        "stages.preprocess.rotate": 0,
        "stages.preprocess.downsample": 2 if size > MAX_WHOLE_SIDE_PX else 1,
    }
    settings = geometry | still | dict(changed)
    with ExitStack() as stack:
        pictures: Path | Iterator[NDArray[np.uint8]] | Pictures = source
        if camera != AS_RECORDED:
            if camera.specks and isinstance(source, Path):
                settings["stages.capture.reference"] = _saved_reference(source, camera, stack)
            pictures = _pictures_of(source, camera, stack)
        running = stream(pipeline, source=pictures, settings=settings, max_frames=last + 1, images=images)
        yield from stack.enter_context(closing(running))


def _saved_reference(source: Path, camera: Camera, stack: ExitStack) -> str:
    """File of the untouched gel of a video under a clean lens; the stack removes it."""
    capture = Capture(Capture.Params(source=str(source)))
    capture.open()
    with closing(capture):
        reference = next(frame.image for frame in capture.frames() if frame.reference)
    path = str(Path(stack.enter_context(TemporaryDirectory())) / "reference.png")
    cv2.imwrite(path, to_gray(reference) if camera.gray and reference.ndim == 3 else reference)
    return path


def _pictures_of(source: Path | Pictures, camera: Camera, stack: ExitStack) -> Iterator[NDArray[np.uint8]]:
    """(H, W) or (H, W, 3) uint8 each: the pictures as such a camera shows them, the first of a list clean."""
    pictures: Iterable[NDArray[np.uint8]] = source if isinstance(source, list) else ()
    if isinstance(source, Path):
        reader = stack.enter_context(closing(open_source(str(source))))
        pictures = (frame for frame, *_ in iter(reader.read, None))
    passes: NDArray[np.float32] | None = None
    for number, picture in enumerate(pictures):
        if passes is None:
            passes = specks(
                picture.shape, camera.specks, np.random.default_rng(zlib.crc32(picture.tobytes()))
            )
        shown = to_gray(picture) if camera.gray and picture.ndim == 3 else picture
        if number or isinstance(source, Path):
            shown = np.rint(shown * (passes if shown.ndim == 2 else passes[..., None])).astype(np.uint8)
        yield shown


def summary(judged: Sequence[Judged]) -> Iterator[str]:
    """Lines of a table: a row for each lab, and one for all."""
    heading = (
        "lab",
        "frames",
        "hull IoU",
        "10 %",
        "region IoU",
        "center px",
        "angle deg",
        "area",
        "x2",
        "missed",
    )
    labs = [_row(lab or "-", group) for lab, group in _by_lab(judged)]
    yield from table([(*heading, "rest", "false"), *labs, _row("all", judged)])


def _row(name: str, judged: Sequence[Judged]) -> tuple[str, ...]:
    touched, rest = [one for one in judged if one.touched], [one for one in judged if not one.touched]
    hull, region, center, angle, area = (
        np.array([value for one in touched if not np.isnan(value := getattr(one, key))])
        for key in ("hull", "region", "center", "angle", "area")
    )
    outside = np.mean((area < 0.5) | (area > 2)) if len(area) else np.nan
    low, high = interval(touched)
    return (
        name,
        str(len(touched)),
        f"{_median(hull):.2f} ({low:.2f}-{high:.2f})" if len(hull) else "-",
        f"{np.quantile(hull, 0.1):.2f}" if len(hull) else "-",
        f"{_median(region):.2f}" if len(region) else "-",
        f"{_median(center):.1f}" if len(center) else "-",
        f"{_median(angle):.1f} / {angle.max():.0f}" if len(angle) else "-",
        f"{_median(area):.2f}" if len(area) else "-",
        f"{outside:.0%}" if len(area) else "-",
        f"{np.mean([not one.found for one in touched]):.1%}" if touched else "-",
        str(len(rest)),
        f"{np.mean([one.found for one in rest]):.1%}" if rest else "-",
    )


def _median(values: Sequence[float] | NDArray[np.float64]) -> float:
    return float(np.median(values)) if len(values) else np.nan


def interval(judged: Sequence[Judged], confidence: float = 0.95) -> tuple[float, float]:
    """Confidence interval of the median overlap of hulls; NaN without outlines.

    Bootstrap (Efron 1979) over whole recordings, because frames of one recording are not independent.
    """
    groups: dict[str, list[float]] = {}
    for one in judged:
        if not np.isnan(one.hull):
            groups.setdefault(one.recording, []).append(one.hull)
    if not groups:
        return np.nan, np.nan
    overlaps, generator = list(groups.values()), np.random.default_rng(0)
    drawn = generator.integers(len(overlaps), size=(RESAMPLE_COUNT, len(overlaps)))
    medians = [np.median(np.concatenate([overlaps[index] for index in chosen])) for chosen in drawn]
    low, high = np.quantile(medians, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def _by_lab(judged: Sequence[Judged]) -> Iterator[tuple[str, list[Judged]]]:
    for lab, group in groupby(sorted(judged, key=lambda one: one.lab), key=lambda one: one.lab):
        yield lab, list(group)


def fitted(runs: Mapping[str, Sequence[Judged]]) -> Iterator[str]:
    """Lines of a table: for each lab the setting that is best on every second outlined frame, and the overlap
    of hulls on the others with it and with the first setting.

    runs : setting -> results of the same frames in the same order, as from `judge`.
    """
    usual = next(iter(runs))
    rows, kept, chosen = [], {name: [] for name in ("usual", "fit")}, {}
    overlaps: dict[str, dict[str, list[float]]] = {}
    for name, judged in runs.items():
        for lab, group in _by_lab([one for one in judged if not np.isnan(one.hull)]):
            overlaps.setdefault(lab, {})[name] = [one.hull for one in group]
    for lab, by_setting in overlaps.items():
        if len(by_setting[usual]) < 2:
            continue
        chosen[lab] = max(by_setting, key=lambda name: _median(by_setting[name][::2]))
        for into, name in (("usual", usual), ("fit", chosen[lab])):
            kept[into] += by_setting[name][1::2]
        halves = [by_setting[name][1::2] for name in (usual, chosen[lab])]
        rows.append((lab, str(len(halves[0])), chosen[lab], *(f"{_median(half):.2f}" for half in halves)))
    rows.append(("all", str(len(kept["fit"])), "", *(f"{_median(kept[n]):.2f}" for n in ("usual", "fit"))))
    worst = [f"{np.quantile(kept[name], 0.1):.2f}" for name in ("usual", "fit")]
    yield from table([("lab", "frames", "best", usual, "fit"), *rows, ("10 %", "", "", *worst)])


def every(labels: Iterable[FrameLabel], count: int) -> list[FrameLabel]:
    """Every `count`-th label of each lab."""
    by_lab = groupby(sorted(labels, key=lambda label: label.lab), key=lambda label: label.lab)
    return [label for _, group in by_lab for label in list(group)[::count]]


def scatter(labels: Iterable[FrameLabel]) -> list[float]:
    """Overlap, 0..1, of the outlines of rounds 1 and 2 of each frame that has both."""
    rounds = {(label.recording, label.frame, label.round): label for label in labels if label.outlines}
    overlaps = []
    for (recording, frame, number), label in rounds.items():
        first = rounds.get((recording, frame, 1))
        if number != 2 or first is None:
            continue
        corners = np.concatenate([np.asarray(outline) for outline in (*label.outlines, *first.outlines)])
        width, height = np.ceil(corners.max(axis=0)).astype(int) + 1
        masks = [
            metrics.filled_polygons([np.asarray(outline) for outline in one.outlines], (height, width))
            for one in (label, first)
        ]
        overlaps.append(metrics.mask_iou(*masks))
    return overlaps


def add_set(parser: argparse.ArgumentParser) -> None:
    """Declare `--set`."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="A.B=VALUE", help="as for tactflow run; repeatable"
    )


def settings_of(texts: Sequence[str]) -> dict[str, Any]:
    """Settings from arguments of `--set`; raises ConfigError for one that is not A.B=VALUE.

    >>> settings_of(["stages.difference.use=otsu", "stages.fusion=null"])
    {'stages.difference.use': 'otsu', 'stages.fusion': None}
    """
    settings = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: required A.B=VALUE, as in stages.hull.min_area=50")
        settings[key] = parse_value(value)
    return settings


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m lab.judges.judge", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("pipelines", nargs="*", default=["default"], metavar="PIPELINE", help="file or name")
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="recordings that the labels name"
    )
    parser.add_argument(
        "--labels", type=Path, default=OUTLINES, metavar="FILE", help="default: those of the package"
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help=f"draw the {WORST_COUNT} worst frames of the first pipeline",
    )
    parser.add_argument(
        "--blank", action="store_true", help="leave the frames out of --picture, as their licence may ask for"
    )
    parser.add_argument(
        "--fit",
        metavar="A.B=V,W,...",
        help="take the best value for each lab by every second outline, and judge it on the others",
    )
    parser.add_argument("--gray", action="store_true", help="remove the colours of all pictures first")
    parser.add_argument("--dirt", type=int, default=0, metavar="N", help="so many specks land on the lens")
    parser.add_argument(
        "--every",
        type=int,
        default=1,
        metavar="N",
        help="judge every N-th label of each recording, for a quick look",
    )
    add_set(parser)
    options = parser.parse_args(arguments)
    try:
        settings = settings_of(options.set)
        camera = Camera(options.gray, options.dirt)
        labels = load_labels(options.labels)
        first = every([label for label in labels if label.round == 1], options.every)
        if options.picture is not None:
            draw_worst(options.pipelines[0], first, options.data, options.picture, options.blank, camera)
            return 0
        if options.fit is not None:
            key, _, values = options.fit.partition("=")
            choices = {f"{key.rpartition('.')[2]}={v}": {key: parse_value(v)} for v in values.split(",")}
            runs = {
                name: list(
                    judge(
                        options.pipelines[0],
                        first,
                        options.data,
                        settings=settings | choice,
                        camera=camera,
                    )
                )
                for name, choice in choices.items()
            }
            print(*fitted(runs), sep="\n")
            return 0
        results = {
            name: list(judge(name, first, options.data, settings=settings, camera=camera))
            for name in options.pipelines
        }
        if not any(results.values()):
            raise ConfigError(f"--data {options.data}: has none of the recordings of {options.labels}")
    except TactflowError as error:
        say(f"tactflow: {error}")
        return error.exit_code
    for name, judged in results.items():
        print(name, *summary(judged), sep="\n", end="\n\n")
    if again := scatter(labels):
        print(
            f"Labels: {len(again)} frames that were outlined twice overlap by {_median(again):.2f} (median)"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
