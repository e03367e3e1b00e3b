"""Propose a pipeline for an unknown sensor, from frames at rest and frames with presses.

No truth is needed: the shipped pipelines process the same frames, and are compared by their false contacts at
rest and their missed contacts while the gel is pressed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import takewhile
from textwrap import shorten
from typing import Any, Final

import cv2
import numpy as np

from tactflow.calibration.file import Calibration
from tactflow.calibration.likeness import match_light
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline, packaged_pipelines
from tactflow.engine.errors import StageError
from tactflow.message.result import Result
from tactflow.streaming import stream
from tactflow.tools.tune.recording import CONTACT_CHANGE, change_between
from tactflow.tools.tune.space import DOWNSAMPLE, MIN_PITCH_PX, MIN_SIDE_PX
from tactflow.vision.arrays import ColorImage
from tactflow.vision.change import Settling
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import MarkerStatus

MAX_WHOLE_SIDE_PX: Final = 500
"""px: pictures with a longer side are shrunk; the shipped pipelines are measured on 160 to 480 px."""
MIN_PRESS_RATIO: Final = 0.5
"""Change of light, relative to the largest, from which a frame counts as pressed. Those between are left out,
because whether they show a contact is a matter of definition."""
MIN_FOUND_SHARE: Final = 0.5
"""Share of presses below which a pipeline does not find the contacts of a gel: no better than a coin."""
SCORE_TOLERANCE: Final = 0.1
"""Difference of two scores up to which they count as equal: the standard error of a share of 25 frames."""
MAX_REST_DISPLACEMENT_PX: Final = 0.35
"""95th percentile of the dots' displacement at rest, px, above which they are not tracked: the bound used to
label the recordings of franka_mini."""
TRIED_PIPELINES: Final = ("default", "markerless", "tactip")
"""Shipped pipelines that are tried for every sensor. The others differ from one of them in geometry and
calibration alone, except for `SPECIAL_PIPELINES`."""
SPECIAL_PIPELINES: Final = frozenset({"classic", "wedge"})
"""Shipped pipelines for no kind of sensor: the original script, and one that rectifies the picture of one
camera."""


@dataclass(frozen=True)
class Sample:
    """Frames of a sensor, divided into those at rest and those with a press.

    Attributes
    ----------
    frames : (H, W, 3) uint8 each.
    reference : index of the frame of the untouched gel.
    rest, pressed : indices of frames.
    changes : largest relative change of light of each frame from the reference.
    """

    frames: list[ColorImage]
    reference: int
    rest: list[int]
    pressed: list[int]
    changes: list[float]

    @property
    def strongest(self) -> int:
        """Index of the frame behind the reference that differs most from it."""
        return self.reference + int(np.argmax(self.changes[self.reference :]))


@dataclass
class Attempt:
    """What a pipeline reports on the frames.

    Attributes
    ----------
    pipeline : its name.
    settings : values that differ from its file.
    found : share of pressed frames with a contact.
    false : share of frames at rest with a contact.
    dots : median number of dots at rest.
    steady : 95th percentile of their displacement at rest, px.
    picture : result of the strongest press, with its image.
    failure : error message if it does not run.
    """

    pipeline: str
    settings: dict[str, Any]
    found: float = math.nan
    false: float = math.nan
    dots: int = 0
    steady: float = math.inf
    picture: Result | None = field(default=None, repr=False)
    failure: str = ""

    @property
    def score(self) -> float:
        """Found minus false: W. J. Youden, "Index for rating diagnostic tests", Cancer 3, 1950."""
        return -math.inf if self.failure else (0.0 if math.isnan(self.found) else self.found) - self.false

    @property
    def has_dots(self) -> bool:
        """Whether it tracks dots that keep still on the untouched gel."""
        return self.dots > 0 and self.steady < MAX_REST_DISPLACEMENT_PX

    def __str__(self) -> str:
        if self.failure:
            return f"{self.pipeline}: {self.failure}"
        found = (
            "no press seen" if math.isnan(self.found) else f"finds {100 * self.found:.0f} % of the presses"
        )
        dots = f"{self.dots} dots, steady to {self.steady:.2f} px" if self.dots else "no dots"
        return f"{self.pipeline}: {found}, {100 * self.false:.0f} % false contacts at rest, {dots}"


def divide(frames: Sequence[ColorImage], at_rest: int | None = None) -> Sample:
    """Divide frames into those of the untouched gel and those with a press, by the change of light alone.

    at_rest : number of first frames known to show the untouched gel; None: as many as look like the
        reference.
    """
    settling = Settling()
    for index, image in enumerate(frames[:at_rest]):
        settling.add(image, index / 30)
        if settling.touched or settling.unrelated or settling.steady:
            break
    reference = settling.best()
    changes = [change_between(frames[reference], image) for image in frames]
    same = takewhile(lambda index: changes[index] < CONTACT_CHANGE, range(reference, len(frames)))
    rest = list(same) if at_rest is None else list(range(reference, at_rest))
    # Frames before the reference may show another state of the gel.
    limit = max(CONTACT_CHANGE, MIN_PRESS_RATIO * max(changes[reference:]))
    pressed = [index for index in range(rest[-1] + 1, len(frames)) if changes[index] >= limit]
    return Sample(list(frames), reference, rest, pressed, changes)


def shrinking(size: tuple[int, int], pitch: float | None) -> int:
    """Factor of `downsample` for frames of a size (width, height), px. pitch : of the dots, px.

    >>> shrinking((320, 240), None), shrinking((1280, 720), 60.0), shrinking((1280, 720), 13.0)
    (1, 4, 2)
    """
    factor = 1
    while (
        max(size) / factor > MAX_WHOLE_SIDE_PX
        and min(size) / (2 * factor) >= MIN_SIDE_PX
        and (pitch is None or pitch / (2 * factor) >= MIN_PITCH_PX)
    ):
        factor *= 2
    return factor


def propose(
    sample: Sample,
    pitch: float | None,
    rotate: int = 0,
    kind: str | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> list[Attempt]:
    """Try the shipped pipelines of `TRIED_PIPELINES` and those that fit the sensor, best first.

    Of pipelines whose scores are near the best, one that also tracks steady dots is preferred, then one for
    this kind of sensor, then the first.

    pitch : of the dots, px, None without dots. rotate : degrees clockwise. kind : shipped pipeline for the
    sensor as named by the user, None to recognise it. report : called with the result of each.
    """
    untouched = sample.frames[sample.reference]
    height, width = untouched.shape[:2]
    settings = {"stages.preprocess.rotate": rotate, DOWNSAMPLE: shrinking((width, height), pitch)}
    fitting = [kind] if kind is not None else _recognised(untouched) if rotate == 0 else []
    attempts = []
    for name in dict.fromkeys([*TRIED_PIPELINES, *fitting]):
        attempts.append(_attempt(name, settings, sample))
        report(str(attempts[-1]))
    best = max(attempt.score for attempt in attempts)

    def rank(attempt: Attempt) -> tuple[float, bool, bool]:
        with_dots = pitch is not None and attempt.has_dots
        worse = 0.0 if attempt.score >= best - SCORE_TOLERANCE else 1.0 - attempt.score
        return worse, not with_dots, attempt.pipeline not in fitting

    return sorted(attempts, key=rank)


def _recognised(untouched: ColorImage) -> list[str]:
    """Shipped pipelines with the calibration of a kind of sensor that looks like this one at rest."""
    # The median removes the dots.
    factor = 240 / min(untouched.shape[:2])
    small = cv2.resize(untouched, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    plain = np.asarray(cv2.medianBlur(small, 25), np.uint8)
    mapping = PixelMapping.identity((plain.shape[1], plain.shape[0]))
    names = []
    for name in packaged_pipelines():
        path = load_pipeline(find_pipeline(name)).calibration
        if path is not None:
            calibration = Calibration.load(path)
            if calibration.misfit(mapping) is None and match_light(calibration.look, plain).fits:
                names.append(name)
    return names


def _attempt(name: str, settings: dict[str, Any], sample: Sample) -> Attempt:
    attempt = Attempt(name, settings)
    frames = [sample.frames[sample.reference], *sample.frames]
    # The reference is chosen already.
    running = stream(name, source=frames, settings={**settings, "stages.capture.settle": 0}, images=True)
    touching, dots, moved = [], [], []
    try:
        with closing(running) as results:
            for index, result in enumerate(results, -1):
                if index < 0:
                    continue
                touching.append(result.contact is not None)
                if index == sample.strongest:
                    attempt.picture = result
                if index in sample.rest and result.markers is not None:
                    tracked = result.markers.status == MarkerStatus.TRACKED
                    dots.append(int(tracked.sum()))
                    moved.append(np.hypot(*(result.markers.position - result.markers.origin)[tracked].T))
    except StageError as error:
        # The remedy behind the colon does not apply here.
        reason = str(error.__cause__ or error).partition(": ")[0]
        attempt.failure = shorten(reason, 70, placeholder=" ...")
        return attempt
    contact = np.array(touching)
    attempt.false = float(contact[sample.rest].mean())
    if sample.pressed:
        attempt.found = float(contact[sample.pressed].mean())
    if dots and any(map(len, moved)):
        attempt.dots = int(np.median(dots))
        attempt.steady = float(np.percentile(np.concatenate(moved), 95))
    return attempt
