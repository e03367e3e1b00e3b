"""Perturbation: error against what is wrong with the pictures, and where each pipeline breaks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import TactflowError
from tactflow.tools.bench.scenes import Case
from tactflow.tools.stress.clips import SEEN_RMS, SILENT_PERCENT, Clip, Image, Matrix, cases_for, clean, clip
from tactflow.tools.stress.parts import Curve, Listing, Part
from tactflow.tools.stress.subjects import Subject

Random = np.random.Generator
Perturb = Callable[[Clip, float, Random], Clip]

CURVE_QUANTITIES: Final = (SEEN_RMS, "center_error", "flow_error", "hull_iou")
"""Quantities with a curve."""
BREAKING_PERCENTS: Final = {
    "false_contacts": ("false contact", 0.0),
    "missed_half_depth": ("missed contact", 0.0),
    "lost_percent": ("lost dots", 5.0),
    "wrong_percent": ("exchanged dots", 0.0),
    SILENT_PERCENT: ("nothing said", 1.0),
}
"""Quantity -> how it is called, and the percentage above which a pipeline is broken."""


def each(change: Callable[[NDArray[np.float32], float, Random], NDArray[Any]]) -> Perturb:
    """A perturbation of each picture, given in grey levels."""

    def perturb(plain: Clip, level: float, random: Random) -> Clip:
        changed = (change(frame.astype(np.float32), level, random) for frame in plain.frames)
        return plain.changed([np.clip(np.rint(frame), 0, 255).astype(np.uint8) for frame in changed])

    return perturb


def _jpeg(frame: NDArray[np.float32], level: float, _: Random) -> NDArray[Any]:
    data = cv2.imencode(".jpg", frame.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, int(100 - level)])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


def _gamma(frame: NDArray[np.float32], level: float, _: Random) -> NDArray[Any]:
    return np.asarray(255 * (frame / 255) ** (1 + level))


def _blur(frame: NDArray[np.float32], level: float, _: Random) -> NDArray[Any]:
    return np.asarray(cv2.GaussianBlur(frame, (0, 0), level) if level else frame)


def _contrast(frame: NDArray[np.float32], level: float, _: Random) -> NDArray[Any]:
    return np.asarray(128 + (frame - 128) * (1 - level))


def _faded(frame: NDArray[np.float32], level: float, _: Random) -> NDArray[Any]:
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)[..., None]
    return np.asarray(frame + level * (gray - frame))


def _moved(plain: Clip, matrices: list[Matrix], size: tuple[int, int] | None = None) -> Clip:
    """The clip with pictures moved by (3, 3) matrices; what comes into the picture repeats its border."""
    height, width = plain.frames[0].shape[:2]
    frames = [
        cv2.warpPerspective(
            frame, matrix, size or (width, height), flags=cv2.INTER_AREA if size else cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.uint8)
        for frame, matrix in zip(plain.frames, matrices, strict=True)
    ]  # fmt: skip
    return plain.changed(frames, matrices)


def _rotated(plain: Clip, level: float, _: Random) -> Clip:
    height, width = plain.frames[0].shape[:2]
    matrix = np.eye(3)
    matrix[:2] = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), level, 1.0)
    return _moved(plain, [matrix] * len(plain.frames)) if level else plain


def _scaled(plain: Clip, level: float, _: Random) -> Clip:
    if not level:
        return plain
    height, width = plain.frames[0].shape[:2]
    size = (round(width * (1 - level)), round(height * (1 - level)))
    x, y = size[0] / width, size[1] / height
    # Centres of pixels: the corner of the picture stays, not the centre of its first pixel.
    matrix = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
    frames = [
        cv2.resize(frame, size, interpolation=cv2.INTER_AREA).astype(np.uint8) for frame in plain.frames
    ]
    return plain.changed(frames, [matrix] * len(frames))


def _shifted(plain: Clip, level: float, _: Random) -> Clip:
    """Every other frame after the first two by so many pixels, obliquely."""
    matrices = []
    for number in range(len(plain.frames)):
        matrix = np.eye(3)
        if number > 1 and number % 2:
            matrix[:2, 2] = level * 0.8, level * 0.6
        matrices.append(matrix)
    return _moved(plain, matrices) if level else plain


def _occluded(plain: Clip, level: float, random: Random) -> Clip:
    """A share of the dots is covered with the colour of the gel around them, after the first two frames."""
    frames = [frame.copy() for frame in plain.frames]
    covered = random.random(len(plain.truth(0)[0].origin)) < level
    for number, frame in enumerate(frames):
        if number < 2:
            continue
        smooth = cv2.medianBlur(frame, 41)
        disc = np.zeros(frame.shape[:2], np.uint8)
        for x, y in np.rint(plain.truth(number)[0].position[covered]).astype(int):
            cv2.circle(disc, (int(x), int(y)), COVER_RADIUS_PX, 255, -1)
        frame[disc > 0] = smooth[disc > 0]
    return plain.changed(frames)


COVER_RADIUS_PX: Final = 13
"""Radius of what covers a dot, px: twice that of the dot."""


DIRT_SIGMA_SHARE: Final = 0.01
DIRT_DARKNESS: Final = 0.8
"""Standard deviation of a speck before the lens, which is out of focus, relative to the longer side of the
picture; and share of the light that it takes in its middle. Specks are of the size of dots."""


def specks(shape: tuple[int, ...], count: int, random: Random) -> NDArray[np.float32]:
    """Share of the light, (H, W) in 0..1, that specks on the lens let pass; shape : of the picture, px."""
    height, width = shape[:2]
    sigma = DIRT_SIGMA_SHARE * max(height, width)
    points = np.zeros((height, width), np.float32)
    for x, y in random.uniform(0, 1, (count, 2)) * (width - 1, height - 1):
        points[round(y), round(x)] = 1
    blurred = cv2.GaussianBlur(points, (0, 0), sigma) * (2 * np.pi * sigma**2)
    return np.asarray(1 - DIRT_DARKNESS * np.minimum(blurred, 1), np.float32)


def _dirty(plain: Clip, level: float, random: Random) -> Clip:
    """So many specks lie on the lens after the first two frames."""
    passes = specks(plain.frames[0].shape, int(level), random)[..., None]
    dirty = [np.rint(frame * passes).astype(np.uint8) for frame in plain.frames[2:]]
    return plain.changed([*plain.frames[:2], *dirty])


def _dropped(plain: Clip, level: float, random: Random) -> Clip:
    kept = random.random(len(plain.frames)) >= level
    kept[:2] = True
    return plain.kept(np.flatnonzero(kept).tolist())


@dataclass(frozen=True, slots=True)
class Perturbation:
    """A change of pictures, at several levels.

    Attributes
    ----------
    perturb : the pictures of a clip at a level.
    unit : of the levels.
    levels : increasing; the first is 0, without perturbation.
    """

    perturb: Perturb
    unit: str
    levels: Sequence[float]


PERTURBATIONS: Final[Mapping[str, Perturbation]] = {
    "noise": Perturbation(
        each(lambda f, level, random: f + random.normal(0, level, f.shape)),
        "grey levels",
        (0, 1, 2, 4, 8, 16, 32),
    ),
    "less contrast": Perturbation(each(_contrast), "share lost", (0, 0.3, 0.5, 0.7, 0.85, 0.95)),
    "less exposure": Perturbation(
        each(lambda f, level, _: f * (1 - level)), "share lost", (0, 0.3, 0.5, 0.7, 0.85, 0.95)
    ),
    "more exposure": Perturbation(
        each(lambda f, level, _: f * (1 + level)), "share more", (0, 0.25, 0.5, 1, 2)
    ),
    "blur": Perturbation(each(_blur), "px, sigma", (0, 0.7, 1.5, 3, 5, 8)),
    "JPEG": Perturbation(each(_jpeg), "100 - quality", (0, 10, 30, 60, 80, 95)),
    "gamma": Perturbation(each(_gamma), "exponent - 1", (0, 0.3, 0.7, 1.2, 2)),
    "less colour": Perturbation(each(_faded), "share lost", (0, 0.3, 0.6, 0.9, 1)),
    "rotation": Perturbation(_rotated, "degrees", (0, 2, 7, 20, 45)),
    "smaller scale": Perturbation(_scaled, "share lost", (0, 0.2, 0.4, 0.6, 0.75, 0.85)),
    "occluded dots": Perturbation(_occluded, "share", (0, 0.05, 0.1, 0.2, 0.4, 0.6)),
    "dirt on the lens": Perturbation(_dirty, "specks", (0, 1, 3, 10, 30)),
    "displacement a frame": Perturbation(_shifted, "px", (0, 2, 5, 10, 20, 30)),
    "dropped frames": Perturbation(_dropped, "share", (0, 0.2, 0.4, 0.6, 0.8)),
}
"""Name -> perturbation."""

DOT_PERTURBATION: Final = "occluded dots"
"""The perturbation that needs dots."""
QUICK_PERTURBATIONS: Final = ("noise", "occluded dots")
SCENE_COUNT: Final = 2
"""Scenes that each pipeline is run on."""


def noise_bound(case: Case, sigma: float, quantity: str) -> float | None:
    """Smallest standard error of any unbiased method under white noise (Cramér-Rao), px.

    A method that knows the noise-free pictures of the gel, of the dot and of the contact, and not where they
    are. The reference has noise as well. sigma : of the noise, grey levels; rounding adds 1/12. Computed from
    the gradients of the noise-free frame with the deepest contact. None where the quantity has no bound.
    """
    variance = sigma**2 + 1 / 12
    frames = clip(case)
    number = frames.deepest
    truth = frames.truth(number)[0]
    if quantity == SEEN_RMS:
        picture = clean(case, number, dots=True)
        squares = []
        for x, y in truth.position[truth.visible]:
            region = (
                np.hypot(*(np.indices(picture.shape[:2])[::-1] - np.array([x, y])[:, None, None]))
                < COVER_RADIUS_PX
            )
            squares.append(2 * _bound(picture, region, variance))
        return float(np.sqrt(np.mean(squares)))
    if quantity == "center_error":
        change = clean(case, number, dots=False) - clean(case, 0, dots=False)
        # The mean length of an error with two normal components, of the same variance each.
        return float(np.sqrt(np.pi / 4 * 2 * _bound(change, np.ones(change.shape[:2], bool), variance)))
    return None


def _bound(picture: NDArray[np.float64], region: NDArray[np.bool_], variance: float) -> float:
    """Least variance of the position of a known pattern, the sum over both coordinates, px^2."""
    across, down = np.gradient(picture, axis=1), np.gradient(picture, axis=0)
    gradients = np.stack([across[region].ravel(), down[region].ravel()])
    information = gradients @ gradients.T / variance
    return float(np.trace(np.linalg.inv(information)))


def own_noise(case: Case) -> float:
    """Standard deviation of the noise of a clip, grey levels: of 2 x 2 pixels together."""
    return float(clip(case).scene.settings.noise) / 2


def run_perturbation(
    subjects: Sequence[Subject], *, quick: bool, seed: int = 1, names: Sequence[str] = ()
) -> Part:
    """Every pipeline on its scenes under every perturbation. names : only these, on the first scene."""
    part = Part(
        "Perturbation",
        "Error against the strength of what is wrong with the pictures, at 400 x 300 px. It "
        "disturbs the whole recording with its reference, but for occlusion, displacement, dropped frames.",
    )
    rows = []
    for name in names or (QUICK_PERTURBATIONS if quick else PERTURBATIONS):
        perturbation = PERTURBATIONS[name]
        levels = perturbation.levels[:: 3 if quick else 1]
        for case, who in _pairs(subjects, short=quick or bool(names)):
            if name == DOT_PERTURBATION and not who[0].dots:
                continue
            plain = clip(case)
            found: dict[str, list[dict[str, float] | str]] = {subject.name: [] for subject in who}
            for level in levels:
                changed = perturbation.perturb(plain, level, np.random.default_rng(seed)) if level else plain
                for subject in who:
                    found[subject.name].append(_errors(subject, changed))
                    part.trials += len(changed.frames)
            for subject in who:
                rows.append(_row(name, perturbation, levels, case, subject, found[subject.name]))
                part.curves += _curves(name, perturbation, levels, case, subject, found[subject.name])
    heads = ["perturbation", "scene", "pipeline", "seen dots double", "centre doubles", "flow doubles"]
    heads += [what for what, _ in BREAKING_PERCENTS.values()] + ["refused"]
    text = (
        "The level where an error is twice that of the unperturbed scene, and the first level with a false "
        "or missed contact, with more than 5 % of the dots lost, with exchanged dots, and with more than 1 % "
        "of them wrong by more than a pixel and four stated standard errors: nothing says so."
    )
    part.listings.append(Listing("Where errors double, and where it breaks", heads, rows, text))
    return part


def _pairs(subjects: Sequence[Subject], *, short: bool) -> Iterator[tuple[Case, list[Subject]]]:
    """Scene and pipelines that suit it. short : the first scene only."""
    for dots in (True, False):
        who = [subject for subject in subjects if subject.dots == dots]
        for case in cases_for(dots=dots, count=1 if short else SCENE_COUNT) if who else ():
            yield case, who


def _errors(subject: Subject, changed: Clip) -> dict[str, float] | str:
    """Errors of a pipeline on a clip, or why it refused it."""
    try:
        return changed.score(subject.run(changed.frames))
    except TactflowError as error:
        return str(error).splitlines()[0]


def doubling(levels: Sequence[float], errors: Sequence[float | None], perfect: float = 0.0) -> float | None:
    """The level where an error is twice that at the first level, by linear interpolation; None: nowhere.

    >>> doubling([0, 1, 2], [0.1, 0.15, 0.25])
    1.5
    """
    if errors[0] is None:
        return None
    limit = 2 * abs(errors[0] - perfect)
    before = (levels[0], limit / 2)
    for level, error in zip(levels[1:], errors[1:], strict=True):
        if error is None:
            return level
        distance = abs(error - perfect)
        if distance >= limit:
            return float(before[0] + (level - before[0]) * (limit - before[1]) / (distance - before[1]))
        before = (level, distance)
    return None


def _series(found: Sequence[dict[str, float] | str], quantity: str) -> list[float | None]:
    return [None if isinstance(errors, str) else errors.get(quantity) for errors in found]


def _row(
    name: str,
    perturbation: Perturbation,
    levels: Sequence[float],
    case: Case,
    subject: Subject,
    found: Sequence[dict[str, float] | str],
) -> list[str]:
    cells = [f"{name}, {perturbation.unit}", case.label, subject.name]
    for quantity in CURVE_QUANTITIES[:3]:
        errors = _series(found, quantity)
        at = None if errors[0] is None else doubling(levels, errors)
        cells.append("-" if errors[0] is None else f"> {levels[-1]:g}" if at is None else f"{at:.2g}")
    for quantity, (_, limit) in BREAKING_PERCENTS.items():
        errors = _series(found, quantity)
        at = next((lv for lv, e in zip(levels, errors, strict=True) if e is not None and e > limit), None)
        known = any(error is not None for error in errors)
        cells.append("-" if not known else f"> {levels[-1]:g}" if at is None else f"{at:g}")
    refusal = next(((lv, e) for lv, e in zip(levels, found, strict=True) if isinstance(e, str)), None)
    return [*cells, "-" if refusal is None else f"{refusal[0]:g}: {refusal[1][:60]}"]


def _curves(
    name: str,
    perturbation: Perturbation,
    levels: Sequence[float],
    case: Case,
    subject: Subject,
    found: Sequence[dict[str, float] | str],
) -> Iterator[Curve]:
    for quantity in CURVE_QUANTITIES:
        errors = _series(found, quantity)
        if all(error is None for error in errors):
            continue
        bound = None
        if name == "noise" and not subject.reference:
            sigmas = [float(np.hypot(own_noise(case), level)) for level in levels]
            bounds = [noise_bound(case, sigma, quantity) for sigma in sigmas]
            bound = [value for value in bounds if value is not None] or None
        yield Curve(name, perturbation.unit, quantity, f"{subject.name}, {case.label}", levels, errors, bound)


__all__ = ["PERTURBATIONS", "Image", "Perturbation", "doubling", "noise_bound", "run_perturbation"]
