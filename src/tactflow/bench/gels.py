"""Recordings of real gels of many labs: does it work there as it is, without settings of their own?

Every recording runs through the default pipeline, or through the one for gels without markers, with `rotate`
0 and a `downsample` of 1 or 2. Nothing else is set.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.labels import (
    DotMotion,
    Polygons,
    compare_decisions,
    compare_first_contact,
    labels_of,
    outlines_by_eye,
)
from tactflow.bench.lockstep import TimedResult, on_recording, take_turns
from tactflow.bench.pictures import WorstFrame
from tactflow.bench.pipelines import PIPELINE, measure_refusal
from tactflow.bench.quantities import Tally
from tactflow.bench.results import RECORDING, BenchResult
from tactflow.bench.timing import CopyUnit, Times
from tactflow.engine.graph import Pipeline

FOLDER = "gels"
"""Where the recordings of gels are, in the folder of recordings."""

OUTLINES = "outlines by eye"
"""Name of the recording that stands for the outlines of all gels together."""

STEPS = 100
"""Steps of the progress display for one recording. Chosen by hand: some are longer."""

_VIDEOS = (".avi", ".mp4", ".m4v", ".gif")
_PICTURES = (".png", ".jpg")


@dataclass(frozen=True, slots=True)
class Gel:
    """Recordings of one sensor, and what is known of them.

    folder : a video, several, or a folder of pictures. sensor : what it is. dots : counted by eye; 0 for a
    gel without, None where nobody counted.
    rest : so many first frames show the untouched gel. touched : from this frame on it is touched, or None.
    moves : rest and touch follow from the motion of the dots against this frame, or None.
    frames : only so many first frames are used, or None for all. every : one recording of so many is used.
    chosen : whether constants were chosen on it; the others are the test.
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
        """(frames,): 1 touched, 0 at rest, -1 unknown, by `rest` and `touched`."""
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
    """In words: which recordings are missing from a folder of recordings, and which are unknown."""
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


def measure_gels(
    result: BenchResult,
    marked: tuple[str, Pipeline],
    bare: tuple[str, Pipeline],
    data: Path,
    unit: CopyUnit,
    step: Callable[[int], None],
    pictures: Path | None = None,
) -> None:
    """Measure every recording of a gel that is known here and in the folder.

    For a gel without dots, also what the pipeline for dots takes for such; and all outlines together.

    Parameters
    ----------
    result : what is measured is added to it.
    marked, bare : name and pipeline for gels with dots, and for gels without.
    data : folder of recordings. unit : measured along the way. step : called with steps, see `step_count`.
    pictures : folder for a picture of the worst labelled frame of each recording, or None.
    """
    drawn = outlines_by_eye(data / FOLDER)
    together = Tally()
    for gel in present(data):
        name, pipeline = bare if gel.dots == 0 else marked
        ready = prepared(pipeline, gel.downsample)
        tally = _measure(result, gel, name, ready, data / FOLDER, drawn, unit, step, pictures)
        if not {"label_distance_p50", "line_angle_p50"} & set(tally.values):
            for key in ("outline_iou_p50", "outline_iou_min"):
                together.values[key] += tally.values[key]
        if gel.dots == 0:
            source = on_recording(prepared(marked[1], gel.downsample), gel.sources(data / FOLDER)[0])
            measure_refusal(result, marked[0], source, RECORDING + gel.folder)
    if errors := together.errors():
        count = len(together.values["outline_iou_p50"])
        result.add(PIPELINE, marked[0], RECORDING + OUTLINES, errors, frames=count)


def _measure(
    result: BenchResult,
    gel: Gel,
    name: str,
    pipeline: Pipeline,
    gels: Path,
    drawn: Polygons,
    unit: CopyUnit,
    step: Callable[[int], None],
    pictures: Path | None,
) -> Tally:
    """Measure one pipeline on all recordings of one sensor."""
    tally, scene, frames = Tally(), RECORDING + gel.folder, 0
    times: Times = defaultdict(list)
    for source in gel.sources(gels):
        watch = _Watch(gel, source, gels, drawn, tally)
        ready = {name: on_recording(pipeline, source)}
        found, failures = take_turns(ready, watch.see, unit=unit, late=watch.is_over)
        for kind, samples in found[name].items():
            times[kind] += samples
        if name in failures:
            result.failures[f"{PIPELINE}/{name}/{scene}"] = f"{source.name}: {failures[name]}"
        watch.judge()
        watch.worst.write(pictures, f"{gel.folder}-{source.stem}-{name}")
        frames += len(watch.found)
        step(STEPS)
    result.add(PIPELINE, name, scene, tally.errors(), times=times, frames=frames)
    return tally


class _Watch:
    """One pipeline on one recording. found : frame by frame, whether a contact was seen."""

    def __init__(self, gel: Gel, source: Path, gels: Path, drawn: Polygons, tally: Tally) -> None:
        self.found: list[bool] = []
        self.worst = WorstFrame()
        self._gel = gel
        self._tally = tally
        self._labels = labels_of(source, gels, gel.downsample, drawn)
        self._motion = None if gel.moves is None else DotMotion(gel.moves)
        self._dots: int | None = None

    def see(self, _: str, result: TimedResult) -> str:
        """Take one frame's answer; returns the kind of frame."""
        contact, index = result.contact, result.frame.seq
        self.found.append(contact is not None)
        if self._motion is not None:
            self._motion.add(result.frame.image)
        if self._dots is None and result.markers is not None:
            self._dots = len(result.markers.position)
        if index in self._labels and result.image is not None:
            label, shape = self._labels[index], result.image.shape[:2]
            overlap = label.compare(self._tally, contact, shape)
            self.worst.see(overlap, result, label.mask(shape), label.center)
        return "idle" if contact is None else "contact"

    def is_over(self) -> bool:
        """Whether enough frames were seen."""
        return self._gel.frames is not None and len(self.found) >= self._gel.frames

    def judge(self) -> None:
        """Compare the decisions and the number of dots with what is known of the whole recording."""
        found, counted = np.array(self.found, np.bool_), self._gel.dots
        if self._motion is None:
            compare_decisions(self._tally, self._gel.known(len(found)), found)
        else:
            touched = self._motion.touched()
            compare_decisions(self._tally, touched, found)
            compare_first_contact(self._tally, touched, found)
        if counted and self._dots is not None:
            self._tally.add(
                dots_found=100.0 * min(self._dots, counted) / counted,
                dots_beyond=100.0 * max(self._dots - counted, 0) / counted,
            )
