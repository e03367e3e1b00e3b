"""Recordings of real gels of many labs: does it work there as it is, without settings of their own?

Every recording runs through the default pipeline, or through the one for gels without markers, with `rotate`
0 and a `downsample` of 1 or 2. Nothing else is set.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.labels import FOLDER, Label, labels_of, outlines_by_eye, touch_of
from tactflow.bench.lockstep import TimedResult, on_recording, with_params
from tactflow.bench.pipelines import Bench, Judge
from tactflow.bench.quantities import Tally
from tactflow.bench.results import RECORDING
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

_VIDEOS = (".avi", ".mp4", ".m4v", ".gif")


@dataclass(frozen=True, slots=True)
class Gel:
    """Recordings of one sensor, and what is known of them.

    folder : a video, several, or a folder of pictures. sensor : what it is. dots : counted by eye; 0 for a
    gel without, None where nobody counted.
    rest : so many first frames show the untouched gel. touched : from this frame on it is touched, or None.
    every : one recording of so many is used.
    chosen : whether constants were chosen on it; the others are the test.
    """

    folder: str
    sensor: str
    dots: int | None
    downsample: int = 1
    rest: int = 0
    touched: int | None = None
    every: int = 1
    chosen: bool = False

    def sources(self, gels: Path) -> list[Path]:
        """Its recordings: the videos in its folder, or the folder itself if it holds pictures."""
        inside = sorted((gels / self.folder).glob("*"))
        videos = [path for path in inside if path.suffix in _VIDEOS]
        return videos[:: self.every] or ([gels / self.folder] if inside else [])

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
    Gel("franka_mini", "GelSight Mini on a gripper", None, every=2, chosen=True),
    Gel("handmade_dots", "home-made gel, painted dots of many sizes", 127, 2, rest=14, chosen=True),
    Gel("sts_640", "See-Through-your-Skin, 640 x 480", 165, 2, chosen=True),
    Gel("mini_ball", "GelSight Mini, ball", 63, rest=1, touched=1, chosen=True),
    Gel("digit_fots", "DIGIT, ball", 0, rest=1, touched=1, chosen=True),
    Gel("gelslim_ball", "GelSlim 3.0, ball", None, rest=1, touched=1, chosen=True),
    Gel("wrs_cam1", "Osaka, fisheye", 97, rest=1, touched=1, chosen=True),
    Gel("tactip_video", "TacTip", 331, rest=29, touched=29, chosen=True),
    Gel("seu_a", "SEU GelSight, never touched", 149, 2, rest=_ALWAYS),
    Gel("sts_torque160", "See-Through-your-Skin, 160 x 120", 150),
    Gel("simple_marks", "home-made, strongly coloured light", 140, rest=1, touched=1),
    Gel("mini_box", "GelSight Mini, edge of a box", 0, rest=1, touched=1),
    Gel("thu_real", "THU GelSight", 0, rest=1, touched=1),
    Gel("9dtact_1", "9DTact, ball", 0, 2, rest=1, touched=1),
    Gel("handmade25", "home-made wedge, painted dots", 25, rest=1, touched=1),
    Gel("vptac3", "dome with mirrors, three grids", None),
    Gel("purdue_apple_grasping", "Purdue wedge, begins in contact", 126),
    Gel("jar_8_06_1", "home-made gel in a jar", 0, 2, rest=1, touched=1),
    Gel("jar_7_31_2", "home-made gel in a jar", 0, 2, rest=1, touched=1),
    Gel("fingervision", "FingerVision, transparent skin", 26),
)
"""Half of the sensors are for choosing constants, the others for reporting what comes of it."""


def check(data: Path) -> None:
    """Find out before a long run that there is nothing to measure.

    Raises
    ------
    ConfigError
        If the folder has no folder of gels.
    """
    if not (data / FOLDER).is_dir():
        raise ConfigError(f"--data {data}: required a folder with the folder {FOLDER} in it")


def measure_gels(bench: Bench, marked: tuple[str, Pipeline], bare: tuple[str, Pipeline], data: Path) -> None:
    """Measure every recording of a gel that is known here and in the folder.

    For a gel without dots, also what the pipeline for dots takes for such.

    marked, bare : name and pipeline for gels with dots, and for gels without. data : folder of recordings.
    """
    drawn = outlines_by_eye(data / FOLDER)
    for gel in GELS:
        sources, scene = gel.sources(data / FOLDER), RECORDING + gel.folder
        if not sources:
            continue
        # No other preprocessing than making the picture smaller.
        dotted, plain = (
            with_params(pipeline, "preprocess", rotate=0, downsample=gel.downsample)
            for pipeline in (marked[1], bare[1])
        )
        ready = {bare[0]: plain} if gel.dots == 0 else {marked[0]: dotted}
        parts = []
        for source in sources:
            labels = labels_of(source, data / FOLDER, gel.downsample, drawn)
            parts.append((source, partial(GelJudge, gel, labels, touch_of(source, data / FOLDER))))
        bench.measure(ready, scene, parts)
        if gel.dots == 0:
            bench.measure_refusal(marked[0], on_recording(dotted, sources[0]), scene)


class GelJudge(Judge):
    """Compares with labels of single frames, with what is known of rest and touch, and a count of dots."""

    def __init__(
        self, gel: Gel, labels: Mapping[int, Label], touch: NDArray[np.int8] | None, tally: Tally
    ) -> None:
        super().__init__(tally)
        self._gel, self._labels, self._touch = gel, labels, touch
        self._found: list[bool] = []
        self._dots: int | None = None

    def add(self, result: TimedResult) -> str:
        """Take one frame's answer; returns the kind of frame."""
        contact = result.contact
        self._found.append(contact is not None)
        if self._dots is None and result.markers is not None:
            self._dots = len(result.markers.position)
        if result.seq in self._labels and result.image is not None:
            label, shape = self._labels[result.seq], result.image.shape[:2]
            self.worst.add(label.compare(self.tally, contact, shape), result, label.mask(shape))
        return "idle" if contact is None else "contact"

    def finish(self) -> None:
        """Compare the decisions and the number of dots with what is known of the whole recording."""
        found, counted = np.array(self._found, np.bool_), self._gel.dots
        touched = self._gel.known(len(found)) if self._touch is None else self._touch[: len(found)]
        self.tally.percent(false_contacts=found[touched == 0], missed_contacts=~found[touched == 1])
        if counted and self._dots is not None:
            self.tally.add(
                dots_found=100.0 * min(self._dots, counted) / counted,
                dots_beyond=100.0 * max(self._dots - counted, 0) / counted,
            )
