"""Comparison with the untouched gel: compiled loops give what numpy and OpenCV give."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.contact import background, contact_outline
from tactflow.vision.contact.background import CELL, Change, UntouchedGel
from tactflow.vision.contact.detector import ContactDetector, _closed_changes

Image = NDArray[np.uint8]

pytestmark = pytest.mark.skipif(
    not compiled.active(), reason='numba is not here: pip install "tactflow[fast]"'
)

SIZES = st.tuples(st.integers(1, 70), st.integers(1, 70))
"""Heights and widths: also of less than a cell, and of no whole number of cells."""


def _pictures(size: tuple[int, int], seed: int, count: int) -> list[Image]:
    """A shaded gel with noise, and with a spot that grows from frame to frame."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    gel = (
        rng.uniform(40, 200, 3) + x[..., None] * rng.uniform(-1, 1, 3) + y[..., None] * rng.uniform(-1, 1, 3)
    )
    away = np.hypot(x - rng.uniform(0, size[1]), y - rng.uniform(0, size[0]))[..., None]
    spot = rng.uniform(-80, 80, 3) * np.exp(-((away / 12) ** 2))
    frames = [gel + spot * frame + rng.normal(0, 2, (*size, 3)) for frame in range(count)]
    return [np.clip(np.rint(frame), 0, 255).astype(np.uint8) for frame in frames]


def _compared(frames: list[Image], on: bool) -> tuple[UntouchedGel, list[Change]]:
    with compiled.switched(on):
        gel = UntouchedGel(frames[0], 0.025, 0.01, 1.0)
        changes: list[Change] = []
        for frame in frames:
            before = changes[-1].evidence > 10 if changes else None
            changes.append(gel.compare(frame, before, changes[-1].evidence if changes else None))
        return gel, changes


def _close(fast: NDArray[np.float32], slow: NDArray[np.float32]) -> None:
    """Equal to the rounding of float32, of which a value takes part in some ten operations: 1e-5 of the
    largest (measured: up to 2e-6)."""
    scale = max(1.0, float(np.abs(slow).max(initial=0)))
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-5 * scale)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(0, 2**16))
def test_both_ways_see_the_same_change(size: tuple[int, int], seed: int) -> None:
    frames = _pictures(size, seed, 3)
    (_, fast), (_, slow) = _compared(frames, True), _compared(frames, False)
    for one, other in zip(fast, slow, strict=True):
        assert np.array_equal(one.half, other.half)
        # The fit stops within 0.05 of a step, wherever that is: rounding may decide which step is the last.
        np.testing.assert_allclose(one.light, other.light, atol=0.05)
        if np.abs(one.light - other.light).max() < 1e-3:
            # A light that differs by so much moves a deviation by 1e-3 / 0.29 grey levels, the least noise.
            least = 1e-3 / (12**-0.5 * 2 / 3)
            for name in ("square", "colour", "evidence"):
                found, wanted = getattr(one, name), getattr(other, name)
                slack = 2 * least * np.sqrt(np.abs(wanted).max()) + least**2
                np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=slack)
            assert one.largest == pytest.approx(other.largest, rel=1e-2, abs=1e-2)
            assert one.largest_colour == pytest.approx(other.largest_colour, rel=1e-2, abs=1e-2)
            assert one.left == pytest.approx(other.left, rel=1e-2)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(0, 2**16), st.data())
def test_both_ways_find_a_window_as_strong(size: tuple[int, int], seed: int, data: st.DataObject) -> None:
    frames = _pictures(size, seed, 2)
    (fast_gel, _), (slow_gel, changes) = _compared(frames, True), _compared(frames, False)
    high, wide = changes[1].square.shape
    top, left = data.draw(st.integers(0, high - 1)), data.draw(st.integers(0, wide - 1))
    bottom, right = data.draw(st.integers(top + 1, high)), data.draw(st.integers(left + 1, wide))
    inside = np.random.default_rng(seed).random((bottom - top, right - left)) < 0.8
    window = slice(top, bottom), slice(left, right), inside
    with compiled.switched(True):
        fast = fast_gel.lengths(changes[1], *window)
    with compiled.switched(False):
        slow = slow_gel.lengths(changes[1], *window)
    _close(fast.strength, slow.strength)
    _close(fast.mean, slow.mean)
    for name in ("tone", "total", "squares"):
        # Sums of so many numbers, each as right as `_close` says.
        slack = 1e-5 * fast.strength.size * max(1.0, float(slow.strength.max()))
        assert getattr(fast, name) == pytest.approx(getattr(slow, name), rel=1e-5, abs=slack)


@settings(max_examples=100, deadline=None)
@given(SIZES, st.integers(0, 2**16), st.data())
def test_both_ways_halve_a_window_of_a_mask_alike(
    size: tuple[int, int], seed: int, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    mask = (rng.random(size) < rng.uniform(0, 0.5)).astype(np.uint8) * rng.choice([1, 7, 255])
    high, wide = -(-size[0] // CELL), -(-size[1] // CELL)
    top, left = data.draw(st.integers(0, high - 1)), data.draw(st.integers(0, wide - 1))
    bottom, right = data.draw(st.integers(top + 1, high)), data.draw(st.integers(left + 1, wide))
    inside = rng.random((bottom - top, right - left)) < 0.7
    found = []
    for on in (True, False):
        with compiled.switched(on):
            found.append(contact_outline.hidden_cells(mask.astype(np.uint8), CELL * top, CELL * left, inside))
    assert np.array_equal(*found)


@settings(max_examples=100, deadline=None)
@given(st.tuples(st.integers(1, 20), st.integers(1, 20)), SIZES, st.integers(0, 2**16), st.data())
def test_both_ways_fill_a_level_set_alike(
    size: tuple[int, int], frame: tuple[int, int], seed: int, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    # Sixteenths, with which interpolation by quarters is exact.
    level = (rng.integers(-40, 40, size) / 16).astype(np.float32)
    top, left = data.draw(st.integers(0, frame[0] - 1)), data.draw(st.integers(0, frame[1] - 1))
    before = rng.choice([0, 255], frame, p=[0.9, 0.1]).astype(np.uint8)
    masks = []
    for on in (True, False):
        masks.append(before.copy())
        with compiled.switched(on):
            contact_outline.fill_level(level, top, left, masks[-1])
    assert np.array_equal(*masks)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(0, 2**16))
def test_both_ways_close_changes_alike(size: tuple[int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    square = (rng.random(size) < rng.uniform(0, 1)).astype(np.float32)
    closed = []
    for on in (True, False):
        with compiled.switched(on):
            closed.append(_closed_changes(square, 0.5))
    assert np.array_equal(*closed)


@pytest.mark.parametrize("seed", range(8))
def test_contact_is_outlined_alike(seed: int) -> None:
    """Measured: no pixel differs; three may, whose level is zero to rounding."""
    y, x = np.mgrid[0:192, 0:160]
    gel = np.stack([110 + 0.2 * x, 120 + 0.15 * y, 130 - 0.1 * x - 0.1 * y], axis=-1)
    hidden = np.zeros((192, 160), np.uint8)
    for row in range(12, 192, 24):
        for column in range(12, 160, 24):
            hidden[np.hypot(y - row, x - column) < 4] = 255
    results = []
    for on in (True, False):
        with compiled.switched(on):
            detector = ContactDetector()
            noise = np.random.default_rng(seed)
            detector.add_reference(np.rint(gel + noise.normal(0, 1.5, gel.shape)).astype(np.uint8))
            masks = []
            for step in range(1, 9):
                away = np.hypot((x - 80) / 1.4, y - 90 + seed) / (10 + 4 * step)
                if seed % 2:
                    change = 1 + 0.3 * np.exp(-(away**4))[..., None]
                else:
                    turn = np.arctan2(y - 90 + seed, x - 80)
                    slope = away * (away < 1) + np.exp(-((away - 1) * 5)) * (away >= 1)
                    change = 1 + 0.3 * np.stack([slope * np.cos(turn + p) for p in (0, 2.1, 4.2)], axis=-1)
                frame = np.clip(np.rint(gel * change + noise.normal(0, 1.5, gel.shape)), 0, 255)
                result = detector.detect(frame.astype(np.uint8), hidden)
                masks.append(result.mask)
                assert result.touching == masks[-1].any()
            results.append(masks)
    assert any(mask.any() for mask in results[0])
    for fast, slow in zip(*results, strict=True):
        assert np.count_nonzero(fast != slow) <= 3


def test_a_frame_that_must_not_be_written_is_compared() -> None:
    frames = _pictures((64, 64), 5, 2)
    for frame in frames:
        frame.setflags(write=False)
    detector = ContactDetector()
    detector.add_reference(frames[0])
    assert detector.detect(frames[1]).mask.shape == (64, 64)


def test_the_kernels_of_the_comparison_do_not_wait_for_the_first_frame() -> None:
    ContactDetector()
    assert background.smooth_cells._compiled is not None
    assert contact_outline.continue_outline._compiled is not None
