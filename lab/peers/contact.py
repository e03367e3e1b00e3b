"""Contact: whether something touches, and its outline."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path
from statistics import median
from typing import Any, Final

import cv2
import numpy as np

import tactflow
from lab.judges import judge
from lab.judges.label_file import FrameLabel, load_labels
from lab.peers.common import (
    Calls,
    Numbers,
    Picture,
    Scene,
    Settings,
    another,
    combinations,
    errors_of,
    failed,
    on_scenes,
    recording,
    search,
    turns,
)
from lab.peers.dots import FIRST_WIDE_SEED
from lab.wide import WideScene, wide_scene
from tactflow import Frame, Result
from tactflow.classic.functions import difference, mask_marker
from tactflow.sources import open_source
from tactflow.sources.files import load_image, to_bgr
from tactflow.tools.bench.lockstep import LockstepPipeline
from tactflow.tools.bench.metrics import mask_iou
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.scenes import Case
from tactflow.tools.bench.score import add_decision, add_geometry, add_mask
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.geometry.hull import contact_geometry

UNCHANGED_PICTURES: Final = {
    "stages.preprocess.rotate": 0,
    "stages.preprocess.downsample": 1,
    "stages.capture.settle": 0,
    "sinks.zmq": None,
    "sinks.jsonl": None,
    "sinks.view": None,
}
"""Pipeline settings for pictures that were processed already."""
OURS: Final = "tactflow"


# What a user of each package writes: a mask (H, W) uint8, 255 in contact; None without a contact.


def tactflow_contact(pictures: Sequence[Picture], pipeline: str) -> list[Picture | None]:
    """tactflow: pictures of one recording; the first shows the untouched gel."""
    results = tactflow.stream(pipeline, source=pictures, settings=UNCHANGED_PICTURES)
    return [result.contact_mask if result.contact else None for result in results]


class ClassicContact:
    """The original script: dots inpainted, then brighter in all channels."""

    def __init__(self, reference: Picture) -> None:
        self.reference = self.without_dots(reference)

    def __call__(self, picture: Picture) -> Picture | None:
        """The mask of one picture."""
        mask = difference(self.without_dots(picture), self.reference)
        return mask if mask.any() else None

    @staticmethod
    def without_dots(picture: Picture) -> Picture:
        """The picture, inpainted."""
        return cv2.inpaint(picture, mask_marker(picture), 7, cv2.INPAINT_TELEA)


class PyTouch:
    """pytouch: ContactArea, on pictures of a size that suits its fixed kernels."""

    def __init__(self, reference: Picture, contour_threshold: int, scale: float) -> None:
        from pytouch.tasks import ContactArea

        self.scale, self.shape = scale, reference.shape[:2]
        self.area = ContactArea(
            base=self.resized(reference), draw_poly=False, contour_threshold=contour_threshold
        )

    def resized(self, picture: Picture) -> Picture:
        """The picture at the size for pytouch."""
        return cv2.resize(picture, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_AREA)

    def __call__(self, picture: Picture) -> Picture | None:
        """The ellipse whose axes it returns, filled."""
        try:
            (first, last), (side, other) = self.area(self.resized(picture))
        except UnboundLocalError:  # that is how it says that there is no contact
            return None
        center, long, short = (first + last) / 2, first - last, side - other
        angle = float(np.degrees(np.arctan2(long[1], long[0])))
        axes = (float(np.hypot(*long)) / self.scale, float(np.hypot(*short)) / self.scale)
        mask = np.zeros(self.shape, np.uint8)
        cv2.ellipse(mask, (tuple(center / self.scale), axes, angle), 255, -1)
        return mask


class OpenCV:
    """OpenCV: difference from the reference, blurred, thresholded, the largest contour."""

    def __init__(self, reference: Picture, threshold: float, blur: int) -> None:
        self.reference, self.threshold, self.blur = reference, threshold, (blur, blur)

    def __call__(self, picture: Picture) -> Picture | None:
        """The mask of one picture."""
        change = cv2.blur(cv2.absdiff(picture, self.reference).max(axis=2), self.blur)
        above = np.uint8(255) * (change > self.threshold)
        outlines, _ = cv2.findContours(above.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if not outlines:
            return None
        largest = max(outlines, key=cv2.contourArea)
        return cv2.drawContours(np.zeros_like(above), [largest], 0, 255, -1)


PEERS: Final[Mapping[str, Callable[..., Any]]] = {
    "classic script": ClassicContact,
    "pytouch": PyTouch,
    "OpenCV difference": OpenCV,
}
CHOICES: Final[Mapping[str, Mapping[str, Sequence[Any]]]] = {
    "pytouch": {"contour_threshold": (100, 20), "scale": (1.0, 2.0)},
    "OpenCV difference": {"threshold": (15, 8, 25, 40), "blur": (9, 5, 21)},
}
REST_RECORDING_COUNT: Final = 6
"""Recordings of a lab without an outline that are judged: all 48 of a gripper would take half of the time."""
ADAPTERS: Final = {OURS: tactflow_contact, **PEERS}


# How they are measured.


class Ours:
    """A pipeline on pictures that were processed already, a block at a time, in one thread.

    Its time is that of everything that it computes: contact, dots, flow, and the message.
    """

    def __init__(self, pipeline: str, pictures: Sequence[Picture]) -> None:
        self._running = LockstepPipeline(
            tactflow.load(pipeline, source=pictures, settings=UNCHANGED_PICTURES)
        )

    def block(self, frames: int) -> list[tuple[Any, float]]:
        """Masks of the next pictures, None without a contact, and times, s."""
        results = self._running.block(frames)
        if len(results) < frames:
            self._running.close()
        return [(r.contact_mask if r.contact else None, r.cpu_s) for r in results]


def on_named(cases: Sequence[Case], folder: Path, peers: Sequence[str]) -> dict[str, Any]:
    """Named scenes: settings found on other recordings of every second of these sensors, all together."""
    others = [recording(another(case), folder) for case in cases[::2]]

    def loss(name: str, tried: Settings) -> float:
        return sum(overlap_lost(errors_of(follow, other, name, tried)) for other in others)

    settings = {name: search(CHOICES.get(name, {}), partial(loss, name)) for name in peers}
    return on_scenes(cases, folder, follow, lambda _: {OURS: {}} | settings)


def overlap_lost(errors: Numbers) -> float:
    """What the search minimises: lost overlap, and both kinds of wrong decisions, as shares."""
    false, missed = (errors.get(f"{kind}_contacts", 0.0) for kind in ("false", "missed"))
    return 1 - errors.get("contact_iou", 0.0) + (false + missed) / 100


def follow(
    scene: Scene, methods: Mapping[str, Settings], tallies: Mapping[str, Tally]
) -> dict[str, list[float]]:
    """Find the contacts of a recording. Where a peer raises, it has found none."""
    rendered, pictures, truths = scene
    pipeline = "default" if len(truths[0].origin) else "markerless"
    running = {
        name: Ours(pipeline, pictures)
        if name == OURS
        else Calls(PEERS[name](pictures[0], **settings), pictures)
        for name, settings in methods.items()
    }
    times: dict[str, list[float]] = {name: [] for name in methods}
    for name, index, mask, seconds in turns(running):
        if isinstance(mask, Exception):
            failed(name, mask)
            mask = None
        times[name].append(seconds)
        tally, truth = tallies[name], truths[index]
        if add_decision(tally, mask is not None, truth, rendered.deep(index)):
            add_mask(tally, mask, truth)
            if (contact := contact_geometry(mask)) is not None:
                add_geometry(tally, contact, truth)
    return times


def on_wide(count: int, peers: Sequence[str]) -> dict[str, Any]:
    """Random sensors, two pictures of each: one setting for all, found on one half, errors on the other."""
    scenes = [wide_scene(seed) for seed in range(FIRST_WIDE_SEED, FIRST_WIDE_SEED + 2 * count)]

    def errors(scenes: Sequence[WideScene], name: str, settings: Settings) -> Numbers:
        tally = Tally()
        for scene in scenes:
            touching = bool(scene.contact.any())
            if name == OURS:
                pipelines = ["default", "markerless"] if scene.dots.any() else ["markerless"]
                mask = _ours_or_none([scene.reference, scene.picture], pipelines)
            else:
                mask = _peers_or_none(name, PEERS[name](scene.reference, **settings), scene.picture)
            if touching:
                overlap = 0.0 if mask is None else mask_iou(mask, scene.contact)
                tally.add(contact_iou=overlap)
                tally.percent(missed_contacts=mask is None)
            else:
                tally.percent(false_contacts=mask is not None)
        return tally.errors()

    answers = {}
    for name in [OURS, *peers]:
        loss = partial(errors, scenes[::2], name)
        settings = search(CHOICES.get(name, {}), lambda tried, loss=loss: overlap_lost(loss(tried)))
        answers[name] = errors(scenes[1::2], name, settings) | {"settings": settings}
    return {"scenes": count, "all": answers}


def _ours_or_none(pictures: Sequence[Picture], pipelines: Sequence[str]) -> Picture | None:
    """By the first pipeline that takes the gel: where it has no dots, the message names `markerless`."""
    for pipeline in pipelines:
        try:
            return tactflow_contact(pictures, pipeline)[-1]
        except tactflow.TactflowError as error:
            failed(OURS, error)
    return None


def _peers_or_none(
    name: str, method: Callable[[Picture], Picture | None], picture: Picture
) -> Picture | None:
    try:
        return method(picture.copy())
    except Exception as error:  # whatever a peer raises where it cannot go on
        failed(name, error)
        return None


def on_gels(data: Path, peers: Sequence[str]) -> dict[str, Any]:
    """Outlines drawn on frames of real gels; settings were chosen on the other labs."""
    labels = chosen_labels(data)
    answers = {OURS: summary(list(judge.judge("default", labels, data)))}
    pairs = [(label, *pair(label, data)) for label in labels]
    for name in peers:
        candidates = {}
        for settings in combinations(CHOICES.get(name, {})):
            candidates[str(settings)] = [
                judge.compare(label, _result(name, settings, reference, picture, mapping))
                for label, reference, picture, mapping in pairs
            ]
        answers[name] = summary(chosen_elsewhere(candidates))
    return answers


def chosen_elsewhere(candidates: Mapping[str, Sequence[judge.Judged]]) -> list[judge.Judged]:
    """For each lab, the results of the candidate with the highest mean of the other labs' median overlaps."""
    overlaps: dict[str, dict[str, float]] = {}
    for name, judged in candidates.items():
        hulls: dict[str, list[float]] = {}
        for frame in judged:
            if not np.isnan(frame.hull):
                hulls.setdefault(frame.lab, []).append(frame.hull)
        overlaps[name] = {lab: median(values) for lab, values in hulls.items()}
    left_out: list[judge.Judged] = []
    for lab in sorted({frame.lab for judged in candidates.values() for frame in judged}):
        elsewhere = {
            name: sum(value for other, value in medians.items() if other != lab)
            for name, medians in overlaps.items()
        }
        best = max(elsewhere, key=lambda name: elsewhere[name])
        left_out += [frame for frame in candidates[best] if frame.lab == lab]
    return left_out


def chosen_labels(data: Path) -> list[FrameLabel]:
    """First labels of recordings at hand; of those without an outline, `REST_RECORDING_COUNT` a lab."""
    labels = [
        label for label in load_labels(judge.OUTLINES) if label.round == 1 and label.contact is not None
    ]
    labels = [label for label in labels if (data / label.recording).exists()]
    outlined = {label.recording for label in labels if label.outlines}
    kept = set(outlined)
    for lab in sorted({label.lab for label in labels}):
        others = sorted({label.recording for label in labels if label.lab == lab} - outlined)
        kept.update(others[:REST_RECORDING_COUNT])
    return [label for label in labels if label.recording in kept]


@lru_cache(maxsize=1)
def _video(path: Path) -> list[Picture]:
    with closing(open_source(str(path))) as reader:
        frames = iter(reader.read, None)
        return [to_bgr(frame[0], str(path)) for frame in frames]


def pair(label: FrameLabel, data: Path) -> tuple[Picture, Picture, PixelMapping]:
    """Reference and picture of a label as a pipeline of the judge processes them, and the mapping to them."""
    path = data / label.recording
    pictures = []
    for index in (label.reference, label.frame):
        if path.is_dir():
            file = next(
                f for f in sorted((path / str(index)).parent.iterdir()) if f.stem == Path(str(index)).name
            )
            pictures.append(load_image(str(file)))
        else:
            pictures.append(_video(path)[int(index)])
    height, width = pictures[0].shape[:2]
    preprocess = tactflow.Preprocessor(
        (width, height), downsample=2 if max(width, height) > judge.MAX_WHOLE_SIDE_PX else 1
    )
    reference, picture = (preprocess(image).copy() for image in pictures)
    return reference, picture, preprocess.mapping


def _result(
    name: str, settings: Settings, reference: Picture, picture: Picture, mapping: PixelMapping
) -> Result:
    mask = _peers_or_none(name, PEERS[name](reference, **settings), picture)
    contact = None if mask is None else contact_geometry(mask)
    return Result(
        Frame("peer", 0, 0.0, picture), {"contact": contact, "contact_mask": mask, "mapping": mapping}
    )


def summary(judged: Sequence[judge.Judged]) -> Numbers:
    """Medians over outlined frames; shares of frames with contact that are missed, at rest that are not."""
    touched, rest = (
        [frame for frame in judged if frame.touched],
        [frame for frame in judged if not frame.touched],
    )
    outlined = [frame for frame in touched if not np.isnan(frame.hull)]
    areas = np.array([frame.area for frame in outlined])
    return {
        "hull_iou": median(frame.hull for frame in outlined),
        "contact_iou": median(frame.region for frame in outlined),
        "worst_tenth": float(np.quantile([frame.hull for frame in outlined], 0.1)),
        "area_ratio": float(np.nanmedian(areas)),
        "missed_contacts": 100 * float(np.mean([not frame.found for frame in touched])),
        "false_contacts": 100 * float(np.mean([frame.found for frame in rest])),
        "outlines": len(outlined),
        "at_rest": len(rest),
    }
