"""Stage `force`."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactflow.calibration.file import Calibration, DotsForceEntry, ForceEntry, LinearForceEntry
from tactflow.engine.contract import StageParams
from tactflow.engine.frame import Absent
from tactflow.stages.force import Force
from tactflow.vision.field_force import GRID_CELLS, FieldForce
from tactflow.vision.force import LightChange
from tactflow.vision.types import Contact, Depth, Flow, Markers, Scale
from tests.calibrations import bare_calibration

SCALE = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
GEL = np.full((24, 32, 3), 90, np.uint8)
CONTACT = Contact(400.0, (10.0, 10.0), None, None, np.zeros((0, 2)), None)
DEPTH = Depth(np.zeros((24, 32), np.float32), 0.5, 0.02, 3.0, 0.2, 1.5)
FIT = {"error": [0.1, 0.05], "range": [0.2, 6.0], "rmse": 0.2, "r2": 0.9}
BY_DEPTH = LinearForceEntry(
    stiffness={"volume": 2.0, "area": 0.5}, greatest={"volume": 2, "area": 9.0}, **FIT
)  # type: ignore[arg-type]
BY_CHANGE = LinearForceEntry(stiffness={"root_change": 0.1}, greatest={"root_change": 90}, **FIT)  # type: ignore[arg-type]
DRAG = LinearForceEntry(stiffness={"shear_by_area": 0.5}, greatest={"shear_by_area": 4.0}, **FIT)  # type: ignore[arg-type]
CELLS = GRID_CELLS * GRID_CELLS * 3 // 4
BY_DOTS = FieldForce(
    np.stack([np.tile([1 / CELLS, 0.0], CELLS), np.tile([0.0, 1 / CELLS], CELLS)]),
    np.array([[2.0, 0, 0], [0, 2, 10], [0, 0, 0], [0, 0, 0], [0, 0, 0]]),
)
"""x and y are twice the mean displacement, z ten times that along y, N per mm."""


def stage(
    folder: Path,
    press: LinearForceEntry | None,
    drag: LinearForceEntry | None = None,
    least_change: float | None = None,
    dots: dict[Any, DotsForceEntry] | None = None,
    drift: float = 0.0,
) -> Any:
    """The stage with a calibration that knows such a force."""
    force = ForceEntry(
        press=press,
        drag=drag,
        dots=dots or {},
        change_at_rest=0.2,
        least_change=least_change,
        recordings={"a": 0.0},
        presses=9,
        left_out="press",
        drift=drift,
    )
    made = bare_calibration(scale=SCALE, force=force, field_force=BY_DOTS if dots else None)
    made.save(folder / "main.yaml")
    return Force(StageParams(), Calibration.load(folder / "main.yaml"))


def test_the_force_is_linear_in_what_is_seen_with_its_error(tmp_path: Path) -> None:
    found = stage(tmp_path, BY_DEPTH, DRAG).process(CONTACT, SCALE, GEL, GEL, DEPTH, Flow((3.0, -1.0), 4))
    # 400 px^2 are 4 mm^2; the volume that counts is the one in the contact.
    assert found.value == pytest.approx((0.5 * 0.3 * 4, -0.5 * 0.1 * 4, 2 * 1.5 + 0.5 * 4))
    assert found.stderr == pytest.approx((np.hypot(0.1, 0.03), np.hypot(0.1, 0.01), np.hypot(0.1, 0.25)))
    assert found.in_range
    still = stage(tmp_path, BY_DEPTH, DRAG).process(CONTACT, SCALE, GEL, GEL, DEPTH, Flow(None, 0))
    assert still.value[:2] == still.stderr[:2] == (None, None)


def test_a_twist_is_resisted_by_the_stiffness_to_shear(tmp_path: Path) -> None:
    twisted = Flow((0.0, 0.0), 4, rotation=-6.0)
    radius = math.sqrt(4 / math.pi)
    # Springs on 4 mm^2, of 0.5 N/mm^3, each times its motion and its lever.
    thin = stage(tmp_path, BY_DEPTH, DRAG).process(CONTACT, SCALE, GEL, GEL, DEPTH, twisted)
    rings = (np.arange(1000) + 0.5) / 1000 * radius
    springs = 0.5 * 2 * np.pi * rings * radius / 1000
    assert thin.torque == pytest.approx(np.sum(springs * rings * np.radians(6) * rings), rel=1e-5)
    # A deep gel of shear modulus G under a disc: 16/3 G a to shear, 16/3 G a^3 to twist.
    modulus = 0.05
    by_width = DRAG.model_copy(update={"stiffness": {"shear_by_width": 16 / 3 * modulus * radius / 2}})
    deep = stage(tmp_path, BY_DEPTH, by_width).process(CONTACT, SCALE, GEL, GEL, DEPTH, twisted)
    assert deep.torque == pytest.approx(16 / 3 * modulus * radius**3 * np.radians(6))
    unknown = stage(tmp_path, BY_DEPTH, DRAG).process(CONTACT, SCALE, GEL, GEL, DEPTH, Flow((1.0, 0.0), 2))
    assert unknown.torque is None
    assert stage(tmp_path, BY_DEPTH).process(CONTACT, SCALE, GEL, GEL, DEPTH, twisted).torque is None


def test_without_heights_the_change_of_the_light_stands_for_them(tmp_path: Path) -> None:
    gel = np.full((96, 128, 3), 90, np.uint8)
    pressed = gel.copy()
    pressed[32:64, 40:88] = 113
    force = stage(tmp_path, BY_CHANGE)
    found = force.process(CONTACT, SCALE, pressed, gel)
    change = SCALE.area(LightChange(gel)(pressed))
    # About the root of 23 / 90 in three channels on 32 x 48 pixels of 0.01 mm^2.
    assert change == pytest.approx(15.36 * np.sqrt(np.sqrt(3) * 23 / 90), rel=0.25)
    assert found.value[2] == pytest.approx(0.1 * (change - 0.2))
    # Another exposure is no change.
    darker = force.process(CONTACT, SCALE, np.uint8(0.8 * pressed), gel)
    assert darker.value[2] == pytest.approx(found.value[2], abs=0.05)


def test_a_change_of_the_whole_gel_is_a_force_without_a_contact(tmp_path: Path) -> None:
    gel = np.full((96, 128, 3), 90, np.uint8)
    soft = gel.copy()
    soft[:, :64] = 100
    change = SCALE.area(LightChange(gel)(soft)) - 0.2
    sensitive, dull = (stage(tmp_path, BY_CHANGE, least_change=part * change) for part in (0.9, 1.1))
    found = sensitive.process(None, SCALE, soft, gel)
    assert found.value == (None, None, pytest.approx(0.1 * change))
    assert found.stderr[2] is not None
    assert dull.process(None, SCALE, soft, gel) == Absent("no_contact")
    assert sensitive.process(None, SCALE, gel, gel) == Absent("no_contact")
    for unable in (stage(tmp_path, BY_CHANGE), stage(tmp_path, BY_DEPTH, least_change=0.1)):
        assert unable.process(None, SCALE, soft, gel) == Absent("no_contact")


def test_what_is_no_gel_does_not_count() -> None:
    gel = np.full((96, 128, 3), 90, np.uint8)
    gel[:, :32] = 5
    flicker = gel.copy()
    flicker[:, :24] = 20
    assert LightChange(gel)(flicker) == pytest.approx(0, abs=1)


def test_nothing_is_said_without_a_calibration_or_without_the_heights_it_needs(tmp_path: Path) -> None:
    assert Force(StageParams()).process(CONTACT, SCALE, GEL, GEL) == Absent("no_calibration")
    assert stage(tmp_path, BY_DEPTH).process(CONTACT, SCALE, GEL, GEL) == Absent("no_depth")


def test_a_contact_beyond_the_fit_is_told_and_warned_of_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    force, deep = stage(tmp_path, BY_DEPTH), replace(DEPTH, pressed=2.5)
    with caplog.at_level(logging.WARNING, "tactflow"):
        for _ in range(3):
            found = force.process(CONTACT, SCALE, GEL, GEL, deep)
            assert not found.in_range
    (record,) = caplog.records
    assert "7.00 N is of a larger contact" in record.getMessage()
    assert "0.20 to 6.00 N" in record.getMessage()


def dragged(x: float, y: float) -> Markers:
    """Dots all over the gel that have moved by (x, y), px."""
    across, down = np.meshgrid(np.arange(2.0, 32, 4), np.arange(2.0, 24, 4))
    origin = np.column_stack([across.ravel(), down.ravel()])
    return Markers(origin, origin + np.array([x, y]), np.zeros(48, np.uint8), np.full(48, 0.01))


def test_dots_give_the_force_in_three_directions_without_a_contact(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    part = DotsForceEntry(error=(0.1, 0.05), range=(-1, 3), rmse=0.2, r2=0.9)
    force = stage(tmp_path, None, dots=dict.fromkeys("xyz", part))
    found = force.process(None, SCALE, GEL, GEL, markers=dragged(-3, 2))
    # Mean displacement of (-0.3, 0.2) mm; between dots and beyond them it is estimated.
    assert found.value == pytest.approx((-0.6, 0.4, 2.0), rel=0.1)
    error = np.hypot(0.1, 0.05 * np.linalg.norm(found.value))
    assert found.stderr == pytest.approx((error, error, error))
    assert found.in_range
    # Nothing pulls at the gel.
    assert force.process(None, SCALE, GEL, GEL, markers=dragged(0, -2)).value[2] == 0
    assert force.process(CONTACT, SCALE, GEL, GEL) == Absent("no_markers")
    with caplog.at_level(logging.WARNING, "tactflow"):
        assert not force.process(None, SCALE, GEL, GEL, markers=dragged(0, 4)).in_range
    assert "was fitted to (-1.00 to 3.00 N)" in caplog.text


def test_dots_may_give_the_drag_and_heights_the_press(tmp_path: Path) -> None:
    part = DotsForceEntry(error=(0.1, 0.0), range=(-1, 3), rmse=0.2, r2=0.9)
    force = stage(tmp_path, BY_DEPTH, dots={"x": part, "y": part})
    found = force.process(CONTACT, SCALE, GEL, GEL, DEPTH, markers=dragged(3, 0))
    assert found.value == pytest.approx((0.6, 0, 2 * 1.5 + 0.5 * 4), rel=0.1, abs=0.01)
    assert force.process(None, SCALE, GEL, GEL, markers=dragged(3, 0)) == Absent("no_contact")


def test_a_gel_that_is_not_as_it_was_calibrated_has_wider_errors(tmp_path: Path) -> None:
    usual = stage(tmp_path, BY_DEPTH, DRAG).process(CONTACT, SCALE, GEL, GEL, DEPTH, Flow((3.0, 0.0), 4))
    assert usual.as_calibrated
    drifted = stage(tmp_path, BY_DEPTH, DRAG, drift=0.2).process(
        CONTACT, SCALE, GEL, GEL, DEPTH, Flow((3.0, 0.0), 4)
    )
    assert not drifted.as_calibrated
    assert drifted.value == usual.value
    wider = [np.hypot(error, 0.2 * value) for value, error in zip(usual.value, usual.stderr, strict=True)]
    assert drifted.stderr == pytest.approx(wider)
    # The left half of the gel is brighter at rest than it was: each part by a fifth of the mean.
    other = GEL.copy()
    other[:, :16] = 135
    found = stage(tmp_path, BY_DEPTH).process(CONTACT, SCALE, other, other, DEPTH)
    assert not found.as_calibrated
    assert found.stderr[2] == pytest.approx(np.hypot(usual.stderr[2], 0.2 * usual.value[2]), rel=0.01)
