"""Recordings of real gels of many labs: does it work there as it is, without settings of their own?

Every recording runs through the default pipeline, or through the one for gels without markers, with `rotate`
0 and a `downsample` of 1 or 2. Nothing else is set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.gel_labels import DotMotion, Label, labels_of, outlines_by_eye
from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.methods import fill_times
from tactflow.bench.pictures import draw
from tactflow.bench.pipelines import measure_refusal, on_recording
from tactflow.bench.results import RECORDING, Measurement
from tactflow.bench.timing import BLOCK, CopyUnit, Samples, quiet
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.vision.types import Contact

FOLDER = "gels"
"""Where the recordings of gels are, in the folder of recordings."""

OUTLINES = "outlines by eye"
"""Name under which the outlines of all gels together are told."""

STEPS = 100
"""Steps of the progress display for one recording; chosen by hand, some are longer."""

PROMPT = 4
"""Frames within which a first contact has to be seen; chosen by hand, 0.16 s at 25 frames a second."""
EARLY = 25
"""Frames within which a first contact is an early one: 1 s at 25 frames a second."""

_VIDEOS = (".avi", ".mp4", ".m4v", ".gif")
_PICTURES = (".png", ".jpg")


@dataclass(frozen=True, slots=True)
class Gel:
    """Recordings of one sensor, and what is known of them.

    folder : a video, several, or a folder of pictures. sensor : what it is. dots : how many are seen by eye;
    0 for a gel without, None where nobody counted.
    rest : so many first frames show the untouched gel. touched : from this frame on it is touched, or None.
    moves : rest and touch are told by the motion of the dots against this frame, or None.
    frames : only so many first frames are looked at, or None for all. every : one recording of so many is
    looked at.
    chosen : whether constants were chosen on it; what comes of the others is the test.
    """

    folder: str
    sensor: str
    dots: int | None
    downsample: int = 1
    rest: int = 0
    touched: int | None = None
    moves: int | None = None
    frames: int | None = None
    every: int = 1
    chosen: bool = False

    def sources(self, gels: Path) -> list[Path]:
        """Its recordings: the videos in its folder, or the folder itself if it holds pictures."""
        inside = sorted((gels / self.folder).iterdir()) if (gels / self.folder).is_dir() else []
        videos = [path for path in inside if path.suffix in _VIDEOS]
        pictures = any(path.suffix in _PICTURES for path in inside)
        return videos[:: self.every] or ([gels / self.folder] if pictures else [])

    def known(self, frames: int) -> NDArray[np.int8]:
        """(frames,): 1 touched, 0 at rest, -1 unknown, as far as `rest` and `touched` tell."""
        known = np.full(frames, -1, np.int8)
        known[: self.rest] = 0
        if self.touched is not None:
            known[self.touched :] = 1
        return known


_ALWAYS = 1_000_000
"""Frames; more than any of the recordings has."""

GELS = (
    Gel("franka_mini", "GelSight Mini on a gripper", None, moves=12, every=2, chosen=True),
    Gel("handmade_dots", "home-made gel, painted dots of many sizes", 127, 2, rest=14, chosen=True),
    Gel("sts_640", "See-Through-your-Skin, 640 x 480", 165, 2, moves=0, chosen=True),
    Gel("mini_ball", "GelSight Mini, ball", 63, rest=1, touched=1, chosen=True),
    Gel("digit_fots", "DIGIT, ball", 0, rest=1, touched=1, chosen=True),
    Gel("gelslim_ball", "GelSlim 3.0, ball", None, rest=1, touched=1, chosen=True),
    Gel("wrs_cam1", "Osaka, fisheye", 97, rest=1, touched=1, chosen=True),
    Gel("tactip_video", "TacTip", 331, rest=29, touched=29, chosen=True),
    Gel("seu_a", "SEU GelSight, never touched", 149, 2, rest=_ALWAYS),
    Gel("sts_torque160", "See-Through-your-Skin, 160 x 120", 150, moves=0),
    Gel("simple_marks", "home-made, strongly coloured light", 140, rest=1, touched=1),
    Gel("mini_box", "GelSight Mini, edge of a box", 0, rest=1, touched=1),
    Gel("thu_real", "THU GelSight", 0, rest=1, touched=1),
    Gel("9dtact_1", "9DTact, ball", 0, 2, rest=1, touched=1),
    Gel("handmade25", "home-made wedge, painted dots", 25, rest=1, touched=1),
    Gel("vptac3", "dome with mirrors, three grids", None),
    Gel("purdue_apple_grasping", "Purdue wedge, begins in contact", 126),
    Gel("jar_8_06_1", "home-made gel in a jar", 0, 2, rest=1, touched=1),
    Gel("jar_7_31_2", "home-made gel in a jar", 0, 2, rest=1, touched=1),
    Gel("fingervision", "FingerVision, transparent skin", 26, frames=60),
)
"""Half of the sensors are for choosing constants, the others for reporting what comes of it."""


def present(data: Path) -> list[Gel]:
    """The known recordings that are in a folder of recordings."""
    return [gel for gel in GELS if gel.sources(data / FOLDER)]


def left_out(data: Path) -> list[str]:
    """A line that names the recordings that are missing, and one the folders that nothing is known of."""
    if not (data / FOLDER).is_dir():
        return [f"{FOLDER}: not in {data}, left out"]
    here, known = {gel.folder for gel in present(data)}, {gel.folder for gel in GELS}
    missing = [gel.folder for gel in GELS if gel.folder not in here]
    unknown = sorted(
        path.name for path in (data / FOLDER).iterdir() if path.is_dir() and path.name not in known
    )
    return [
        f"{FOLDER}: left out, because {why}: {', '.join(names)}"
        for why, names in (("missing", missing), ("unknown", unknown))
        if names
    ]


def step_count(data: Path) -> int:
    """Steps that `measure_gels` will report."""
    return STEPS * sum(len(gel.sources(data / FOLDER)) for gel in present(data))


def prepared(pipeline: Pipeline, downsample: int) -> Pipeline:
    """The same pipeline with no other preprocessing than making the picture smaller."""
    node = pipeline.nodes["preprocess"]
    params = node.component.params.model_validate({"rotate": 0, "downsample": downsample})
    return replace(pipeline, nodes={**pipeline.nodes, "preprocess": replace(node, params=params)})


@dataclass(slots=True)
class GelTally:
    """Counts what a pipeline says about the recordings of one sensor.

    rest, touched : frames known to be so; false, missed : those of them in which the pipeline disagrees.
    early, prompt : recordings whose first contact comes within a second, and those of them in which it was
    seen in time. overlaps, centers, angles : one for each labelled frame in which there is something to
    compare. missing, beyond : dots not found, and found beyond those seen, %.
    """

    rest: int = 0
    false: int = 0
    touched: int = 0
    missed: int = 0
    early: int = 0
    prompt: int = 0
    overlaps: list[float] = field(default_factory=list[float])
    centers: list[float] = field(default_factory=list[float])
    angles: list[float] = field(default_factory=list[float])
    dots: dict[str, float] = field(default_factory=dict[str, float])

    def decisions(self, known: NDArray[np.int8], said: NDArray[np.bool_]) -> None:
        """Compare the decisions on a recording, (N,), with what `Gel.known` or the dots say."""
        self.rest += int(np.count_nonzero(known == 0))
        self.false += int(np.count_nonzero((known == 0) & said))
        self.touched += int(np.count_nonzero(known == 1))
        self.missed += int(np.count_nonzero((known == 1) & ~said))

    def first(self, known: NDArray[np.int8], said: NDArray[np.bool_]) -> None:
        """Judge when the first contact of a recording was seen, if it begins early; as `decisions`."""
        resting = np.flatnonzero(known == 0)
        begun = np.flatnonzero(known[resting[0] :] == 1) + resting[0] if len(resting) else resting
        if len(begun) and begun[0] <= EARLY:
            self.early += 1
            self.prompt += bool(said[begun[0] : begun[0] + PROMPT].any())

    def compare(self, label: Label, contact: Contact | None, shape: tuple[int, int]) -> float:
        """Compare a labelled frame; returns the overlap, 0 where no contact was found."""
        overlap = label.overlap(contact, shape)
        self.overlaps.append(overlap)
        if contact is not None and label.center is not None:
            self.centers.append(float(np.hypot(*np.subtract(contact.center, label.center))))
        if contact is not None and contact.angle is not None and label.angle is not None:
            self.angles.append(metrics.angle_error(contact.angle, label.angle))
        return overlap

    def counted(self, found: int, seen: int) -> None:
        """Compare the number of dots with what is seen by eye."""
        self.dots = {
            "dots_found": 100.0 * min(found, seen) / seen,
            "dots_beyond": 100.0 * max(found - seen, 0) / seen,
        }

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        errors = dict(self.dots)
        if self.rest:
            errors["false_contacts"] = 100.0 * self.false / self.rest
        if self.touched:
            errors["missed_contacts"] = 100.0 * self.missed / self.touched
        if self.early:
            errors["early_found"] = 100.0 * self.prompt / self.early
        errors.update(outline_errors(self.overlaps))
        if self.centers:
            errors["label_distance_p50"] = float(np.median(self.centers))
        if self.angles:
            errors["line_angle_p50"] = float(np.median(self.angles))
            errors["line_angle_max"] = max(self.angles)
        return errors


def outline_errors(overlaps: list[float]) -> dict[str, float]:
    """Median and worst overlap with outlines drawn by eye; nothing where there is none."""
    if not overlaps:
        return {}
    return {"outline_iou_p50": float(np.median(overlaps)), "outline_iou_min": min(overlaps)}


@dataclass(slots=True)
class _Watch:
    """One pipeline on one recording, frame by frame.

    said : whether it saw a contact. dots : markers in its first answer. worst : the frame that disagrees most
    with a label, or the first one that disagrees with what is known, and how much, 0 to 1.
    """

    labels: Mapping[int, Label]
    tally: GelTally
    motion: DotMotion | None
    said: list[bool] = field(default_factory=list[bool])
    dots: int | None = None
    worst: Outcome | None = None
    badness: float = 0.0

    def see(self, outcome: Outcome) -> None:
        """Take one frame's answer."""
        index = outcome.frame.seq
        if index < 0:  # the reference, handed over in front of the recording
            return
        contact = outcome.contact
        self.said.append(contact is not None)
        if self.motion is not None:
            self.motion.add(outcome.frame.image)
        if self.dots is None and outcome.markers is not None:
            self.dots = len(outcome.markers.position)
        if index in self.labels and outcome.image is not None:
            overlap = self.tally.compare(self.labels[index], contact, outcome.image.shape[:2])
            if self.worst is None or 1 - overlap > self.badness:
                self.worst, self.badness = outcome, 1 - overlap

    def label(self) -> Label | None:
        """Of the worst frame."""
        return None if self.worst is None else self.labels.get(self.worst.frame.seq)


def _answers(pipeline: Pipeline, scratch: Path, frames: int | None) -> Iterator[Outcome]:
    """What a pipeline says about each frame of its recording, in turns of some frames."""
    with quiet(), closing(LockstepPipeline(pipeline, scratch / "gel.jsonl")) as running:
        left = frames or _ALWAYS
        while left > 0 and (outcomes := running.block(min(BLOCK, left))):
            yield from outcomes
            left -= len(outcomes)


def _measure(
    gel: Gel,
    name: str,
    pipeline: Pipeline,
    gels: Path,
    scratch: Path,
    unit: CopyUnit,
    step: Callable[[int], None],
    pictures: Path | None,
) -> tuple[Measurement, GelTally]:
    """One pipeline on all recordings of one sensor."""
    made, tally = Measurement("pipeline", name, RECORDING + gel.folder), GelTally()
    drawn = outlines_by_eye(gels)
    samples: dict[Any, Samples] = {}
    for source in gel.sources(gels):
        unit.take(BLOCK)
        motion = None if gel.moves is None else DotMotion(gel.moves)
        watch = _Watch(labels_of(source, gels, gel.downsample, drawn), tally, motion)
        try:
            for outcome in _answers(on_recording(pipeline, source), scratch, gel.frames):
                watch.see(outcome)
                kind = (
                    "reference"
                    if outcome.frame.reference
                    else "idle"
                    if outcome.contact is None
                    else "contact"
                )
                samples.setdefault(kind, Samples()).add(outcome.cpu, outcome.wall)
        except TactflowError as error:
            made.failure = made.failure or f"{source.name}: {error}"
        said = np.array(watch.said, np.bool_)
        known = gel.known(len(said)) if motion is None else motion.touched()
        tally.decisions(known, said)
        if motion is not None:
            tally.first(known, said)
        made.frames += len(said)
        if gel.dots and watch.dots is not None:
            tally.counted(watch.dots, gel.dots)
        if pictures is not None:
            _keep(watch, pictures / f"{gel.folder}-{source.stem}-{name}.png")
        step(STEPS)
    fill_times(made, samples, unit, None)
    made.errors = tally.errors()
    return made, tally


def _keep(watch: _Watch, path: Path) -> None:
    """Write a picture of the worst frame, if there is one."""
    label = watch.label()
    if watch.worst is None or watch.worst.image is None or label is None:
        return
    caption = f"{path.stem}, frame {watch.worst.frame.seq}: IoU {1 - watch.badness:.2f}"
    picture = draw(watch.worst, label.mask(watch.worst.image.shape[:2]), label.center, caption)
    if picture is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture)


def measure_gels(
    marked: tuple[str, Pipeline],
    bare: tuple[str, Pipeline],
    data: Path,
    scratch: Path,
    unit: CopyUnit,
    step: Callable[[int], None],
    pictures: Path | None = None,
) -> Iterator[Measurement]:
    """Run on every recording of a gel that is known here and there.

    Parameters
    ----------
    marked, bare : name and pipeline for gels with dots, and for gels without.
    data : folder of recordings. scratch : for temporary files. step : called with the steps done, see
        `step_count`. pictures : folder for a picture of the worst labelled frame of each recording, or None.

    Returns
    -------
    One measurement for each sensor; for one without dots another one, of what the pipeline for dots takes for
    such; and one of all outlines together.
    """
    overlaps: list[float] = []
    for gel in present(data):
        name, pipeline = bare if gel.dots == 0 else marked
        ready = prepared(pipeline, gel.downsample)
        made, tally = _measure(gel, name, ready, data / FOLDER, scratch, unit, step, pictures)
        yield made
        if not tally.centers and not tally.angles:
            overlaps += tally.overlaps
        if gel.dots == 0:
            source = on_recording(prepared(marked[1], gel.downsample), gel.sources(data / FOLDER)[0])
            yield measure_refusal(marked[0], source, made.scene, scratch)
    together = Measurement("pipeline", marked[0], RECORDING + OUTLINES, frames=len(overlaps))
    together.errors = outline_errors(overlaps)
    if overlaps:
        yield together
