"""Judge heights and normals on real presses of balls, and on the edge of a cube.

    python lab/depth.py [--data ../shared/data] [--keep FOLDER] [SET ...]

Every set is judged with a calibration of its own (learned from one half of its presses, tried on the other),
with the one of another sensor of its kind, and with that after 1, 3 and 9 presses of its own. Columns:
normals, mean angle within 0.85 of the contact's radius, median of the presses, degrees; cap, RMS error of how
far the ball falls from its middle to the rim, %; total, greatest depth over the cap, and over the depth of a
half-space that is pressed over the same circle (Sneddon): an elastic layer lies between the two; step,
greatest height along a border of the height map that lies inside the picture, % of the depth; cover, share
of cap errors within one and within two stated standard errors, %.
"""

from __future__ import annotations

import argparse
import json
import pickle
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration, PhotometricEntry
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Press, Session
from tactflow.calibration.refine import refine_photometry
from tactflow.calibration.samples import press_errors
from tactflow.calibration.scale import centre
from tactflow.vision.depth.slopes import SlopeModel
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Scale

MINI = 0.0634
"""Millimetres per pixel of a Mini at 320 x 240, as the makers of gs_sdk and gelslam measured it."""


@dataclass(frozen=True, slots=True)
class Balls:
    """A set.

    radii : start of a file's name -> radius of the ball, mm. kind : the default calibration of its kind,
    made from another sensor. crop : [x, y, width, height], px, of a picture that shows more than the gel.
    """

    folder: str
    untouched: str
    pipeline: str
    mm: float
    radii: dict[str, float]
    kind: str | None = None
    crop: tuple[int, int, int, int] | None = None


SETS = {
    "gelslam": Balls("mini_ball_gelslam", "background.png", "mini_plain", MINI, {"6": 3.155, "9": 4.75}),
    "mini_ball": Balls("gels/mini_ball", "000.png", "mini", MINI, {"": 2.5}, "mini"),
    "mini_ball_9mm": Balls("mini_ball_9mm", "background.png", "mini_plain", MINI, {"": 4.735}, "mini"),
    "mini_ball_4mm": Balls(
        "mini_ball_4mm", "000.png", "mini_plain", 0.08, {"": 2.0}, "mini", (32, 24, 256, 192)
    ),
    "digit_fots": Balls("gels/digit_fots", "000.png", "digit", 1 / 19.58, {"": 2.35}),
    "digit_ball": Balls("digit_ball", "000.png", "digit", 1 / 18.68, {"": 4.4}),
    "wedge_ball": Balls("wedge_ball", "reference.jpg", "wedge", 0.1, {"": 1.98}),
}
EDGE = Balls("gels/mini_box", "000.png", "mini_plain", MINI, {}, "mini")


def read(
    balls: Balls, data: Path, settings: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Session, list[str]]:
    """Every picture of a set in which a contact is found, as a press, and the names of these.

    settings : of the pipeline, as for `tactflow.stream`.
    """
    folder = data / balls.folder
    pictures = sorted(path for path in folder.iterdir() if path.suffix in (".png", ".jpg"))
    pictures.sort(key=lambda path: path.name != balls.untouched)
    with TemporaryDirectory() as links:
        for number, path in enumerate(pictures):
            (Path(links) / f"{number:04d}{path.suffix}").symlink_to(path.resolve())
        pictures_only = {"calibration": None, "stages.preprocess.crop": balls.crop and [*balls.crop]}
        changed = pictures_only | dict(settings)
        results = tactflow.stream(balls.pipeline, source=links, settings=changed, images=True)
        first, *others = [r for r in results if r.image is not None]
    untouched = first.get("unmarked", first.image)
    presses, names = [], []
    for result in others:
        mask, contact = result.contact_mask, result.contact
        if contact is None or mask is None:
            continue
        hidden = result.get("marker_mask", np.zeros_like(mask)) > 0
        radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
        image = result.get("unmarked", result.image)
        core_radius = float(np.sqrt((contact.core_area or np.nan) / np.pi))
        presses.append(Press(result.seq, image, mask, hidden, contact.center, radius, core_radius))
        names.append(pictures[result.seq].name)
    mapping = first["mapping"]
    return Session(untouched, mapping, presses, np.zeros((0, 2)), len(pictures)), names


def scale_of(balls: Balls, session: Session) -> Scale:
    """The scale of a set."""
    return Scale(balls.mm, balls.mm, (0.0, 0.0), centre(session.mapping.size))


def radii_of(balls: Balls, names: list[str]) -> list[float]:
    """The radius of each press's ball, mm."""
    return [next(r for start, r in balls.radii.items() if name.startswith(start)) for name in names]


def chosen(session: Session, radii: list[float], which: slice) -> tuple[Session, list[float]]:
    """Some presses of a session."""
    return replace(session, presses=session.presses[which]), radii[which]


def judge(
    model: SlopeModel, found: PhotometricEntry, session: Session, scale: Scale, radii: list[float]
) -> str:
    """The columns of a row."""
    errors = np.array(press_errors(session, model, scale, radii))
    surface, rest = Surface(model, scale, found.errors()), Rest(session.untouched)
    rows = []
    for press, ball_radius, cap_error in zip(session.presses, radii, errors[:, 1], strict=True):
        depth = surface.depth(press.image, rest, press.mask)
        contact = min(press.radius * (scale.x * scale.y) ** 0.5, 0.98 * ball_radius)
        cap = ball_radius - np.sqrt(ball_radius**2 - contact**2)
        sneddon = contact / 2 * np.log((ball_radius + contact) / (ball_radius - contact))
        stated = (depth.greatest_stderr or np.nan) / depth.greatest
        step = border(depth.heights) / depth.greatest
        # Stated errors are relative to what was found.
        off = abs(cap_error) / (1 + cap_error)
        rows.append([depth.greatest / cap, depth.greatest / sneddon, step, off / stated])
    over_cap, over_sneddon, step = np.median(rows, axis=0)[:3]
    cap_rms = 100 * np.sqrt(np.nanmean(errors[:, 1] ** 2))
    one, two = (100 * np.nanmean(np.array(rows)[:, 3] < k) for k in (1, 2))
    return (
        f"{np.median(errors[:, 0]):7.1f} {cap_rms:6.1f} {over_cap:8.2f} {over_sneddon:8.2f} "
        f"{100 * step:6.1f} {one:6.0f} {two:4.0f} {len(rows):6d}"
    )


def border(heights: NDArray[np.float32]) -> float:
    """Greatest height along the border of what is not 0, inside the picture, mm."""
    rows, columns = (np.flatnonzero(heights.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return 0.0
    height, width = heights.shape
    top, bottom, left, right = rows[0], rows[-1], columns[0], columns[-1]
    # A border that the picture cuts off is no step, and a map at half resolution was interpolated.
    lines = [
        (top > 1, heights[top]),
        (bottom < height - 2, heights[bottom]),
        (left > 1, heights[:, left]),
        (right < width - 2, heights[:, right]),
    ]
    return max((float(line.max()) for inside, line in lines if inside), default=0.0)


def judge_edge(base: Calibration, data: Path, session: Session, names: list[str]) -> str:
    """Median angle between the faces of the cube, and how its depth and the stated error of that fit.

    A right angle over a base of two parts is as high as the geometric mean of these.
    """
    assert base.slopes is not None
    assert base.photometric is not None
    labels = json.loads((data / EDGE.folder / "labels.json").read_text())
    scale = scale_of(EDGE, session)
    surface = Surface(base.slopes, scale, base.photometric.errors())
    rest, angles, ratios, off = Rest(session.untouched), [], [], []
    y, x = np.mgrid[: session.untouched.shape[0], : session.untouched.shape[1]]
    for press, name in zip(session.presses, names, strict=True):
        label = labels.get(Path(name).stem)
        if label is None:
            continue
        depth = surface.depth(press.image, rest, press.mask)
        heights, true = depth.heights, scale.x * np.sqrt(label["width1"] * label["width2"])
        ratios.append(depth.greatest / true)
        off.append(abs(depth.greatest - true) / (depth.greatest_stderr or np.nan))
        slant = np.radians(label["line_angle"])
        dx, dy = x - label["line_center"][0], y - label["line_center"][1]
        across, along = dy * np.cos(slant) - dx * np.sin(slant), dx * np.cos(slant) + dy * np.sin(slant)
        slopes = []
        for side, width in ((-1, label["width1"]), (1, label["width2"])):
            face = (abs(along) < 0.35 * label["line_length"]) & (side * across > 0.2 * width)
            face &= side * across < 0.8 * width
            slopes.append(np.polyfit(across[face] * scale.y, heights[face], 1)[0])
        angles.append(180 - np.degrees(np.arctan(slopes[0]) - np.arctan(slopes[1])))
    one, two = (100 * np.mean(np.array(off) < k) for k in (1, 2))
    return (
        f"{np.median(angles):.0f} degrees of 90, depth over the true one {np.median(ratios):.2f}, within one "
        f"and two stated errors {one:.0f} and {two:.0f} % of {len(off)}"
    )


def calibrations(name: str, sessions: dict[str, tuple[Session, list[str]]]) -> Iterator[tuple[str, str]]:
    """Label and columns of every calibration that a set is judged with."""
    balls = SETS[name]
    session, names = sessions[name]
    scale, radii = scale_of(balls, session), radii_of(balls, names)
    first, second = (chosen(session, radii, slice(start, None, 2)) for start in (0, 1))
    own = fit_photometry(first[0], scale, first[1])
    yield "own", judge(own.model, own.found, second[0], scale, second[1])
    if balls.kind is None:
        return
    base = Calibration.load(KINDS / f"{balls.kind}.yaml")
    assert base.slopes is not None
    assert base.photometric is not None
    yield "default", judge(base.slopes, base.photometric, second[0], scale, second[1])
    for count in (1, 3, 9):
        # The same presses of every run, from all over the gel.
        few, ball = chosen(*first, slice(0, None, len(first[1]) // count))
        few = replace(few, presses=few.presses[:count])
        refined = refine_photometry(few, scale, ball[0], base)
        yield f"{count} presses", judge(refined.model, refined.found, second[0], scale, second[1])


def sessions_of(names: Iterable[str], data: Path, keep: Path | None) -> dict[str, tuple[Session, list[str]]]:
    """The presses of sets. keep : folder with those of an earlier run, or where they are put."""
    sessions = {}
    for name in dict.fromkeys(names):
        kept = keep / f"{name}.pickle" if keep else None
        if kept and kept.exists():
            sessions[name] = pickle.loads(kept.read_bytes())
            continue
        sessions[name] = read(EDGE if name == "edge" else SETS[name], data)
        if kept:
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(pickle.dumps(sessions[name]))
    return sessions


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="judge heights on real balls")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder with the presses of an earlier run")
    parser.add_argument("sets", nargs="*", default=[*SETS])
    args = parser.parse_args()
    sessions = sessions_of([*args.sets, "edge"], args.data, args.keep)
    print(f"{'set':14} {'calibration':12} normals    cap  /cap /sneddon   step  cover    presses")
    for name in args.sets:
        for label, columns in calibrations(name, sessions):
            print(f"{name:14} {label:12}{columns}", flush=True)
    base = Calibration.load(KINDS / f"{EDGE.kind}.yaml")
    print(f"edge of a cube, default: {judge_edge(base, args.data, *sessions['edge'])}")


if __name__ == "__main__":
    main()
