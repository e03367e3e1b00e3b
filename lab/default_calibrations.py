"""Make the calibrations of kinds of sensors that the package ships, and judge them on other sensors.

    python -m lab.default_calibrations [--data ../shared/data] [--keep FOLDER]
    python -m lab.default_calibrations --judge [--presses N]

The Mini's is learned from all presses of `gelslam` (rpl-cmu/gelslam, MIT), whose licence allows it; three
other Minis, which nothing is learned from, show its errors on other sensors of the kind, and these are what
it states. There is none for depth of a DIGIT: one learned from FOTS (Rancho-zhao/FOTS, MIT) is worse on
another DIGIT than a fit to a single press of its own. Of FOTS the package has the untouched gel and its
scale.

With `--judge` nothing is written, and three tables are printed, each with one sensor left out: the default of
a Mini on the three others, with the error that the two others than the judged one would have it state, also
after one press of its own; two DIGITs by 0, 1, 3 and 20 presses of their own, by refining the other one's
calibration and from scratch; and what becomes of pictures that a default is not for.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from lab.depth import SETS, chosen, radii_of, scale_of, sessions_of
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration, PhotometricEntry, ScaleEntry, raw_corners, small_picture
from tactflow.calibration.photometric import Photometry, fit_photometry
from tactflow.calibration.presses import Session
from tactflow.calibration.refine import refine_photometry
from tactflow.calibration.samples import press_errors
from tactflow.engine.errors import ConfigError
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Scale

Sessions = Mapping[str, tuple[Session, list[str]]]
Presses = tuple[Session, Scale, list[float]]

LEARNED = {
    "mini": (
        "gelslam",
        "GelSight Mini",
        "github.com/rpl-cmu/gelslam (MIT): presses of balls of 6.3 and 9.5 mm",
    ),
    "digit": ("digit_fots", "DIGIT", "github.com/Rancho-zhao/FOTS (MIT): the untouched gel, and its scale"),
}
"""File -> set, kind of sensor, source and licence."""
WITH_DEPTH = ("mini",)
"""Files that have slopes."""
DOT_PITCH = {"mini": 2.03}
"""Spacing of the dots of a gel with dots, mm: of `mini_ball`, at the scale of `lab.depth`, 2.07 and 2.00
along x and y."""
GEL_THICKNESS = {"mini": 4.0}
"""File -> thickness of the gel, mm."""
OTHERS = {"mini": ("mini_ball", "mini_ball_9mm", "mini_ball_4mm")}
"""File -> sets of other sensors of the kind."""
DIGITS = ("digit_fots", "digit_ball")
"""Sets of the DIGITs that are judged by each other."""
KIND_SCALE = 0.05
"""Relative standard error of the scale on another sensor of the kind: on three DIGITs their owners measured
18.7, 19.6 and 21.1 pixels per mm."""
COUNTS = (3, 20)
"""Own presses from all over the gel that a DIGIT is calibrated by, beside single ones."""


def main() -> None:
    """Write the files and print their errors, or judge them."""
    parser = argparse.ArgumentParser(description="make or judge the default calibrations")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder with the presses of an earlier run")
    parser.add_argument("--judge", action="store_true", help="write nothing; judge on sensors left out")
    parser.add_argument("--presses", type=int, default=15, help="presses of a set that are judged")
    args = parser.parse_args()
    if args.judge:
        names = ("gelslam", *OTHERS["mini"], *DIGITS)
        sessions = sessions_of(names, args.data, args.keep)
        judge_minis(sessions, args.presses)
        judge_digits(sessions, args.presses)
        judge_misuse(args.data)
        return
    names = (*(learned for learned, _, _ in LEARNED.values()), *OTHERS["mini"])
    sessions = sessions_of(names, args.data, args.keep)
    for file in LEARNED:
        made = make(file, sessions)
        made.save(KINDS / f"{file}.yaml")
        if made.photometric is not None:
            print(f"{file}: {words(made.photometric.model_dump())} on other sensors of the kind")


def make(file: str, sessions: Sessions) -> Calibration:
    """The default of a kind, with the errors that it has on other sensors of the kind."""
    learned, kind, origin = LEARNED[file]
    session, scale, radii = presses_of(learned, sessions)
    stderr = (KIND_SCALE * scale.x, KIND_SCALE * scale.y)
    made = Calibration(
        sensor=file,
        kind=kind,
        dot_pitch=DOT_PITCH.get(file),
        gel_thickness=GEL_THICKNESS.get(file),
        made_from=origin,
        raw_size=session.mapping.raw_size,
        size=session.mapping.size,
        corners=raw_corners(session.mapping),
        scale=ScaleEntry.of(replace(scale, stderr=stderr), "the authors of the recordings"),
        look=small_picture(session.untouched),
    )
    if file not in WITH_DEPTH:
        return made
    fitted = fit_photometry(session, scale, radii)
    others = [presses_of(name, sessions) for name in OTHERS[file]]
    return made.model_copy(
        update={
            "photometric": stated(fitted, others),
            "slopes": fitted.model,
            "information": fitted.information,
        }
    )


def stated(fitted: Photometry, others: Sequence[Presses]) -> PhotometricEntry:
    """The entry of a default: its errors on other sensors of the kind, each with the same weight.

    `between`, the part of the relative error of a depth that all frames share, is the most likely one. The
    error of the depth that is stated at the start of a run is the one that a usual frame states.
    """
    alone = fitted.found.model_copy(update={"between": 0.0})
    errors = [np.array(press_errors(*other[:1], fitted.model, *other[1:])) for other in others]
    frames = [frame_errors(fitted, alone, other) for other in others]

    def surprise(between: float) -> float:
        """Negative log-likelihood of the errors of the depth."""
        return sum(
            float(np.nanmean(np.log(variance) + relative(found) ** 2 / variance))
            for found, variance in zip(errors, (own**2 + between**2 for own in frames), strict=True)
        )

    between = min(np.arange(0, 0.5, 0.002).tolist(), key=surprise)
    usual = math.sqrt(np.mean([np.median(own) ** 2 for own in frames]) + between**2)
    normal = math.sqrt(np.mean([found[:, 0].mean() ** 2 for found in errors]))
    return alone.model_copy(update={"normal_error": normal, "depth_stderr": usual, "between": between})


def relative(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,): errors of the depth, of `press_errors`, over the depth that was found."""
    return np.asarray(errors[:, 1] / (1 + errors[:, 1]))


def frame_errors(fitted: Photometry, found: PhotometricEntry, presses: Presses) -> NDArray[np.float64]:
    """(n,): the relative standard error of the depth that each frame states."""
    session, scale, _ = presses
    surface, rest = Surface(fitted.model, scale, found.errors()), Rest(session.untouched)
    depths = [surface.depth(press.image, rest, press.mask) for press in session.presses]
    return np.array([(depth.greatest_stderr or np.nan) / depth.greatest for depth in depths])


def presses_of(name: str, sessions: Sessions) -> Presses:
    """The presses of a set, their scale, and the radius of the ball of each, mm."""
    session, pictures = sessions[name]
    return session, scale_of(SETS[name], session), radii_of(SETS[name], pictures)


def some(presses: Presses, count: int, start: int = 0) -> Presses:
    """So many presses, from all over the set, beginning with one of them."""
    session, scale, radii = presses
    step = max(1, (len(radii) - start) // count)
    few, balls = chosen(session, radii, slice(start, start + step * count, step))
    return few, scale, balls


def judge_minis(sessions: Sessions, count: int) -> None:
    """Print the errors of the default of a Mini on others, and how they compare with the stated ones."""
    base = Calibration.load(KINDS / "mini.yaml")
    assert base.slopes is not None
    assert base.information is not None
    assert base.photometric is not None
    nothing = np.zeros(0)
    known = Photometry(base.slopes, base.information, base.photometric, nothing, nothing > 0, nothing)
    print("Mini            own presses  normals   cap, %   at start, %   in frames, %   within 1, 2, %")
    for name in OTHERS["mini"]:
        judged = some(presses_of(name, sessions), count, 1)
        others = [some(presses_of(other, sessions), count) for other in OTHERS["mini"] if other != name]
        found = stated(known, others)
        print(row(name, 0, known, found, judged), flush=True)
        own = some(presses_of(name, sessions), 3)
        left_out = base.model_copy(update={"photometric": found})
        for number in range(len(own[2])):
            one, radii = chosen(own[0], own[2], slice(number, number + 1))
            refined = refine_photometry(one, own[1], radii[0], left_out)
            print(row(name, 1, refined, refined.found, judged), flush=True)


def row(name: str, own: int, fitted: Photometry, found: PhotometricEntry, judged: Presses) -> str:
    """Errors of a fit on the presses of another sensor, and how many of them are within the stated ones."""
    session, scale, radii = judged
    errors = np.array(press_errors(session, fitted.model, scale, radii))
    stated_errors = frame_errors(fitted, found, judged)
    off = np.abs(relative(errors)) / stated_errors
    one, two = (100 * np.nanmean(off < k) for k in (1, 2))
    cap = 100 * math.sqrt(np.nanmean(errors[:, 1] ** 2))
    return (
        f"{name:15} {own:11d} {np.mean(errors[:, 0]):8.1f} {cap:8.1f} {100 * found.depth_stderr:13.0f} "
        f"{100 * np.median(stated_errors):14.0f} {one:9.0f}, {two:3.0f}"
    )


def judge_digits(sessions: Sessions, count: int) -> None:
    """Print the errors on each DIGIT by the other one's calibration, refined and not, and from scratch."""
    print("DIGIT           own presses  way          normals   cap, %   stated, %")
    for name, other in (DIGITS, DIGITS[::-1]):
        presses = presses_of(name, sessions)
        judged = some(presses, count, 1)
        session, scale, radii = presses_of(other, sessions)
        fitted = fit_photometry(session, scale, radii)
        base = replace_fit(make("digit", {**sessions, "digit_fots": sessions[other]}), fitted)
        print(digit_row(name, 0, "other DIGIT", fitted, judged), flush=True)
        for own, (few, few_scale, balls) in few_of(presses):
            for way in ("refined", "from scratch"):
                try:
                    if way == "refined":
                        found = refine_photometry(few, few_scale, balls[0], base)
                    else:
                        found = fit_photometry(few, few_scale, balls)
                except ConfigError as problem:
                    print(f"{name:15} {own:11d}  {way:12} refused: {problem}")
                else:
                    print(digit_row(name, own, way, found, judged), flush=True)


def few_of(presses: Presses) -> Iterator[tuple[int, Presses]]:
    """Few presses: each of the three next to the middle, where a user presses first; others from all over."""
    session, scale, radii = presses
    middle = np.divide(session.mapping.size, 2)
    far = [float(np.hypot(*(press.center - middle))) for press in session.presses]
    for number in np.argsort(far)[:3].tolist():
        one, balls = chosen(session, radii, slice(number, number + 1))
        yield 1, (one, scale, balls)
    for count in COUNTS:
        yield count, some(presses, count)


def replace_fit(known: Calibration, fitted: Photometry) -> Calibration:
    """The calibration with other slopes."""
    return known.model_copy(
        update={
            "photometric": fitted.found,
            "slopes": fitted.model,
            "information": fitted.information,
        }
    )


def digit_row(name: str, own: int, way: str, fitted: Photometry, judged: Presses) -> str:
    """Errors of a fit on presses of a DIGIT."""
    session, scale, radii = judged
    errors = np.array(press_errors(session, fitted.model, scale, radii))
    cap = 100 * math.sqrt(np.nanmean(errors[:, 1] ** 2))
    return (
        f"{name:15} {own:11d}  {way:12} {np.median(errors[:, 0]):7.1f} {cap:8.1f} "
        f"{100 * fitted.found.depth_stderr:11.0f}"
    )


def judge_misuse(data: Path) -> None:
    """Print what the default of a Mini does with pictures that it is not for."""
    print("picture                   frames with contact, with depth; first warning")
    for name, pictures, settings in misuses(data):
        warnings: list[str] = []
        catch = _Catch(warnings)
        with catch:
            results = list(tactflow.stream("mini_plain", source=pictures, settings=settings))
        touched = [result for result in results if result.contact is not None]
        deep = sum(result.depth is not None for result in touched)
        first = next((text for text in warnings if "not used" in text), "none")
        print(f"{name:25} {len(touched):3d}, {deep:3d}; {first[:150]}", flush=True)


def misuses(data: Path) -> Iterator[tuple[str, list[NDArray[np.uint8]], dict[str, Any]]]:
    """Name, pictures and settings of each case; the first is as it should be."""
    uncropped = read(data / "mini_ball_4mm")
    cropped = {"stages.preprocess.crop": [32, 24, 256, 192]}
    yield "as it should be", uncropped, cropped
    yield "mirrored", [flipped(picture, 1) for picture in uncropped], cropped
    yield "upside down", [flipped(picture, 0) for picture in uncropped], cropped
    yield "turned by 90 degrees", uncropped, {**cropped, "stages.preprocess.rotate": 90}
    yield "turned by 180 degrees", uncropped, {**cropped, "stages.preprocess.rotate": 180}
    yield "cropped twofold", read(data / "mini_ball_9mm"), {"stages.preprocess.crop": [80, 60, 160, 120]}
    yield "uncropped", uncropped, {}
    wedge = [np.ascontiguousarray(picture[40:220]) for picture in read(data / "wedge_ball")]
    yield "another kind", wedge, {}


def flipped(picture: NDArray[np.uint8], axis: int) -> NDArray[np.uint8]:
    """The mirror image."""
    return np.asarray(cv2.flip(picture, axis), np.uint8)


def read(folder: Path, count: int = 8) -> list[NDArray[np.uint8]]:
    """The untouched gel of a folder, and some of its presses."""
    rests = ("background", "000", "reference")
    paths = sorted(path for path in folder.iterdir() if path.suffix in (".png", ".jpg"))
    paths.sort(key=lambda path: path.stem not in rests)
    chosen_paths = [paths[0], *paths[1 :: max(1, len(paths) // count)]]
    return [np.asarray(cv2.imread(str(path)), np.uint8) for path in chosen_paths]


class _Catch:
    """Collects the warnings of the package.

    texts : list that they are added to.
    """

    def __init__(self, texts: list[str]) -> None:
        import logging

        class Handler(logging.Handler):
            def emit(self, record: logging.LogRecord) -> None:
                texts.append(record.getMessage())

        self._logger, self._handler = logging.getLogger("tactflow"), Handler(logging.WARNING)

    def __enter__(self) -> None:
        self._logger.addHandler(self._handler)

    def __exit__(self, *_: object) -> None:
        self._logger.removeHandler(self._handler)


def words(errors: Mapping[str, float]) -> str:
    """Errors, for people."""
    return ", ".join(f"{name} {errors[name]:.3f}" for name in ("normal_error", "depth_stderr", "between"))


if __name__ == "__main__":
    main()
