"""How the gel moves between its dots, and whether it slips: against the motion that the simulator knows.

Outlines are the true ones and the dots where they are, with the noise of a good tracker, so that what is
measured is the field and the test for slip alone.
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.quantities import Tally
from tactflow.bench.results import BenchResult
from tactflow.sim import Truth, open_scene
from tactflow.vision.flow import DisplacementField, FieldModel, SlipTest
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Markers, MarkerStatus

MOTION: Final = "motion"
"""Group of the rows about the motion of the gel."""
SCENES: Final = ("press", "cable", "box", "slide", "twist", "dense", "stick_slip")
"""What moves the gel: apart, along, around, and past its limit of friction."""
NOISE: Final = 0.02
"""Standard deviation of a dot's coordinate, px: that of the default tracker on `press`."""
EVERY: Final = 4
"""The field of every so many frames is compared: those between say the same. Chosen by hand."""


def measure_motion(result: BenchResult) -> None:
    """Measure field and slip on each scene."""
    for name in SCENES:
        _measure(result, name)


def _measure(result: BenchResult, name: str) -> None:
    scene, preprocess = open_scene(f"{name}?seed=11"), Preprocessor((800, 600), rotate=90, downsample=2)
    truth = scene.truth(0, preprocess)
    height, width = truth.contact_mask.shape
    model, rng, slip_test = FieldModel(truth.origin, (width, height)), np.random.default_rng(1), SlipTest()
    tally, times = Tally(), []
    slips: list[tuple[bool, bool]] = []
    """Frame by frame of this contact: whether it truly slips, and whether the test says so."""
    for index in range(len(scene)):
        truth = scene.truth(index, preprocess)
        if not truth.touching:
            _compare_slip(tally, slips)
            slips = []
            slip_test.reset()
            continue
        markers = visible_markers(truth, rng)
        began = time.thread_time()
        field = model(markers)
        times.append(time.thread_time() - began)
        if field is None:
            continue
        slip = slip_test(field, np.uint8(255) * truth.contact_mask)
        slips.append((truth.slipping, slip is not None and slip.slipping))
        if index % EVERY == 0:
            _compare_field(tally, field, truth)
    result.add(MOTION, "field", name, tally.errors(), times={"contact": times}, frames=len(times))


def _compare_field(tally: Tally, field: DisplacementField, truth: Truth) -> None:
    """Compare both components of the displacement, on the gel that is in contact now."""
    points = field.grid.points.reshape(-1, 2)
    displacement = truth.displacement(points)
    now = np.rint(points + displacement).astype(int)
    height, width = truth.contact_mask.shape
    inside = np.all((now >= 0) & (now < (width, height)), axis=1)
    inside[inside] = truth.contact_mask[now[inside, 1], now[inside, 0]]
    error = field.displacement.reshape(-1, 2)[inside] - displacement[inside]
    stderr = field.stderr.reshape(-1, 1)[inside]
    tally.add(field_rms=error)
    tally.within("field", error, np.maximum(stderr, 1e-9))


def _compare_slip(tally: Tally, slips: list[tuple[bool, bool]]) -> None:
    """Compare the onset of slip in one contact, or count false alarms in one that sticks."""
    true, found = ([pair[k] for pair in slips] for k in (0, 1))
    if True not in true:
        tally.percent(slip_false=found)
        return
    tally.percent(slip_missed=True not in found)
    if True in found:
        tally.add(slip_onset=abs(found.index(True) - true.index(True)))


def visible_markers(truth: Truth, rng: np.random.Generator) -> Markers:
    """The dots that can be seen, as a good tracker would find them."""
    status = np.where(truth.visible, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
    position: NDArray[np.float64] = truth.position + rng.normal(0, NOISE, truth.position.shape)
    return Markers(truth.origin, position, status, np.full(len(status), NOISE))
