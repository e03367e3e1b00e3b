"""How the gel moves between its dots, and whether it slips: against the motion that the simulator knows.

Outlines are the true ones and the dots where they are, with the noise of a good tracker, so that what is
measured is the field and the test for slip alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.results import Measurement
from tactflow.bench.timing import CopyUnit, Samples, timed
from tactflow.sim import Scene, Truth, open_scene
from tactflow.vision.flow import DisplacementField, FieldModel, SlipTest
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Markers, MarkerStatus

SCENES: Final = ("press", "cable", "box", "slide", "twist", "dense", "stick_slip")
"""What moves the gel: apart, along, around, and past its limit of friction."""
NOISE: Final = 0.02
"""Standard deviation of a dot's coordinate, px: that of the default tracker on `press`."""
EVERY: Final = 4
"""The field of every so many frames is compared: neighbouring ones tell the same."""


@dataclass(slots=True)
class FieldScore:
    """off, stated : px, error of each component in the contact, and its standard error."""

    off: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])
    stated: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])

    def add(self, found: DisplacementField, truth: Truth) -> None:
        """Compare one frame, on the gel that is in contact now."""
        points = found.grid.points.reshape(-1, 2)
        true = truth.displacement(points)
        now = np.rint(points + true).astype(int)
        height, width = truth.contact_mask.shape
        inside = np.all((now >= 0) & (now < (width, height)), axis=1)
        inside[inside] = truth.contact_mask[now[inside, 1], now[inside, 0]]
        off = found.displacement.reshape(-1, 2)[inside] - true[inside]
        self.off.append(off.ravel())
        self.stated.append(np.repeat(found.stderr.reshape(-1)[inside], 2))

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        off, stated = np.concatenate(self.off), np.concatenate(self.stated)
        ratio = np.abs(off) / np.maximum(stated, 1e-9)
        return {
            "field_rms": metrics.rms(np.abs(off).tolist()) or 0.0,
            "field_within_one": 100.0 * float(np.mean(ratio < 1)),
            "field_within_two": 100.0 * float(np.mean(ratio < 2)),
        }


@dataclass(slots=True)
class SlipScore:
    """late : frames from the true onset of each slip to the one that was said; None where none was said.
    false : frames of a contact that does not slip in which slip was said. touched : frames with contact."""

    late: list[int | None] = field(default_factory=list[int | None])
    false: int = 0
    touched: int = 0

    def add(self, true: list[bool], said: list[bool]) -> None:
        """One contact, frame by frame."""
        self.touched += len(true)
        if True not in true:
            self.false += sum(said)
            return
        self.late.append(said.index(True) - true.index(True) if True in said else None)

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        found = {"slip_false": 100.0 * self.false / max(self.touched, 1)}
        if self.late:
            told = [abs(late) for late in self.late if late is not None]
            found["slip_missed"] = 100.0 * self.late.count(None) / len(self.late)
            found |= {"slip_onset": float(max(told))} if told else {}
        return found


def measure(unit: CopyUnit) -> list[Measurement]:
    """Field and slip on each scene. unit : measured along the way."""
    return [
        _measured(open_scene(f"{name}?seed=11"), Measurement("motion", "field", name), unit)
        for name in SCENES
    ]


def _measured(scene: Scene, measurement: Measurement, unit: CopyUnit) -> Measurement:
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    rest = scene.truth(0, preprocess)
    size = (rest.contact_mask.shape[1], rest.contact_mask.shape[0])
    model, rng = FieldModel(rest.origin, size), np.random.default_rng(1)
    field_score, slip_score, samples, test = FieldScore(), SlipScore(), Samples(), SlipTest()
    true: list[bool] = []
    said: list[bool] = []
    for index in range(len(scene)):
        truth = scene.truth(index, preprocess)
        if not truth.touching:
            if true:
                slip_score.add(true, said)
                true, said = [], []
            test.reset()
            continue
        markers = seen_markers(truth, rng)
        unit.take()
        found = timed(partial(model, markers), samples)
        if found is None:
            continue
        mask = np.uint8(255) * truth.contact_mask
        slip = test(found, mask)
        true.append(truth.slipping)
        said.append(slip is not None and slip.slipping)
        if index % EVERY == 0:
            field_score.add(found, truth)
    measurement.frames = slip_score.touched
    measurement.errors = {**field_score.errors(), **slip_score.errors()}
    measurement.copies = {"contact": 1e3 * float(np.median(samples.cpu)) / unit.copy_ms}
    return measurement


def seen_markers(truth: Truth, rng: np.random.Generator) -> Markers:
    """The dots that can be seen, as a good tracker would tell them."""
    status = np.where(truth.visible, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
    position = truth.position + rng.normal(0, NOISE, truth.position.shape)
    return Markers(truth.origin, position, status, np.full(len(status), NOISE))
