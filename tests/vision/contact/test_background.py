"""Comparison with the untouched gel: compiled loops give what numpy and OpenCV give, at any size."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.contact import ContactDetector, background
from tactflow.vision.contact.background import BackgroundModel, Change
from tactflow.vision.contact.illumination import IlluminationModel, under_illumination

Image = NDArray[np.uint8]

SIZES = st.tuples(st.integers(1, 70), st.integers(1, 70))
"""Heights and widths: also of less than a cell, and of no whole number of cells."""

CHANNELS = np.eye(3, dtype=np.float32)
"""Mixtures that are the channels themselves."""


def _with_numpy() -> Any:
    """A context in which loops run in NumPy."""
    patch = pytest.MonkeyPatch()
    for loop in compiled.kernels():
        patch.setattr(loop, "compiled", loop.plain)
    return patch


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


def _compared(frames: list[Image]) -> tuple[BackgroundModel, list[Change]]:
    model = BackgroundModel(frames[0], 0.025, 0.01, 1.0)
    changes: list[Change] = []
    for frame in frames:
        evidence = changes[-1].deviations[2] if changes else None
        changes.append(model.compare(frame, None if evidence is None else evidence * (evidence > 10)))
    return model, changes


def _close(fast: NDArray[np.float32], slow: NDArray[np.float32]) -> None:
    """Equal to the rounding of float32, of which a value takes part in some ten operations: 1e-5 of the
    largest (measured: up to 2e-6)."""
    scale = max(1.0, float(np.abs(slow).max(initial=0)))
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-5 * scale)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(0, 2**16))
def test_the_loops_see_the_change_that_the_plain_version_sees(size: tuple[int, int], seed: int) -> None:
    frames = _pictures(size, seed, 3)
    _, fast = _compared(frames)
    oracles = _with_numpy()
    try:
        _, slow = _compared(frames)
    finally:
        oracles.undo()
    for one, other in zip(fast, slow, strict=True):
        assert np.array_equal(one.half, other.half)
        # The fit stops within 0.05 of a step, wherever that is: rounding may decide which step is the last.
        lights = [
            under_illumination(np.full(one.cells.shape, 100, np.float32), c.illumination)
            for c in (one, other)
        ]
        np.testing.assert_allclose(*lights, atol=0.05)
        if np.abs(lights[0] - lights[1]).max() < 1e-3:
            # A light that differs by so much moves a deviation by 1e-3 / 0.29 grey levels, the least noise.
            least = 1e-3 / (12**-0.5 * 2 / 3)
            for found, wanted in zip(one.deviations, other.deviations, strict=True):
                slack = 2 * least * np.sqrt(np.abs(wanted).max()) + least**2
                np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=slack)
            assert one.largest == pytest.approx(other.largest, rel=1e-2, abs=1e-2)
            assert one.largest_colour == pytest.approx(other.largest_colour, rel=1e-2, abs=1e-2)
            # A ratio, of which decisions ask whether it is above 0.2 or more: one of 1e-6 may be 2e-6.
            assert one.remaining == pytest.approx(other.remaining, rel=1e-2, abs=1e-4)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(0, 2**16), st.data())
def test_the_loops_find_a_window_as_changed_as_the_plain_version(
    size: tuple[int, int], seed: int, data: st.DataObject
) -> None:
    model, changes = _compared(_pictures(size, seed, 2))
    high, wide = changes[1].cells.shape[1:]
    top, left = data.draw(st.integers(0, high - 1)), data.draw(st.integers(0, wide - 1))
    bottom, right = data.draw(st.integers(top + 1, high)), data.draw(st.integers(left + 1, wide))
    inside = np.random.default_rng(seed).random((bottom - top, right - left)) < 0.8
    mixtures = data.draw(st.sampled_from([CHANNELS, CHANNELS[:2] - 0.3, CHANNELS[:1] + 0.5]))
    window = slice(top, bottom), slice(left, right), inside, mixtures
    fast = model.window_change(changes[1], *window)
    oracles = _with_numpy()
    try:
        slow = model.window_change(changes[1], *window)
    finally:
        oracles.undo()
    _close(fast, slow)


def _contacts(seed: int) -> list[Image]:
    """Masks of a growing contact on a gel of one kind or the other."""
    y, x = np.mgrid[0:192, 0:160]
    gel = np.stack([110 + 0.2 * x, 120 + 0.15 * y, 130 - 0.1 * x - 0.1 * y], axis=-1)
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
        result = detector.detect(frame.astype(np.uint8))
        masks.append(result.mask)
        assert result.touching == masks[-1].any()
    return masks


@pytest.mark.parametrize("seed", range(8))
def test_the_loops_outline_a_contact_as_the_plain_version(seed: int) -> None:
    """Measured: no pixel differs; three may, whose level is zero to rounding."""
    fast = _contacts(seed)
    oracles = _with_numpy()
    try:
        slow = _contacts(seed)
    finally:
        oracles.undo()
    assert any(mask.any() for mask in fast)
    for one, other in zip(fast, slow, strict=True):
        assert np.count_nonzero(one != other) <= 3


def test_a_frame_that_must_not_be_written_is_compared() -> None:
    frames = _pictures((64, 64), 5, 2)
    for frame in frames:
        frame.setflags(write=False)
    detector = ContactDetector()
    detector.add_reference(frames[0])
    assert detector.detect(frames[1]).mask.shape == (64, 64)


def test_a_gel_is_lit_as_the_coefficients_say_and_saturates() -> None:
    gel = np.full((3, 5, 7), 100, np.float32)
    coefficients = np.array([[0.5, 0, 0, 9], [0, 0.4, 0.8, 0], [2, 0, 0, 0]], np.float32)
    lit = under_illumination(gel, coefficients)
    assert np.all(lit[0] == 159)
    assert lit[1, 0].tolist() == pytest.approx(np.linspace(40, 80, 7).tolist())
    assert lit[1, :, 0].tolist() == pytest.approx(np.linspace(40, 120, 5).tolist())
    assert np.all(lit[2] == 255)


def _lit_gel(black: bool) -> NDArray[np.float32]:
    """Cells of a gel lit from the sides, with a black surround or without, grey levels."""
    y, x = np.mgrid[0:60, 0:80].astype(np.float32)
    gel = np.stack([60 + x, 170 - y, 100 + 0.5 * x + 0.5 * y])
    if black:
        gel[:, (x - 40) ** 2 + (y - 30) ** 2 > 28**2] = 2
    return gel


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("gains", [(0.7, 0.7, 0.7), (1.35, 1.35, 1.35), (1.3, 1.0, 0.75)])
@pytest.mark.parametrize("touched", [0.0, 0.4])
def test_exposure_and_white_balance_are_compensated_to_a_third_and_black_stays_black(
    gains: tuple[float, float, float], touched: float, black: bool
) -> None:
    gel = _lit_gel(black)
    model = IlluminationModel(gel, 0.25 + (0.025 * gel) ** 2)
    frame = gel * np.array(gains, np.float32)[:, None, None]
    rest = slice(round(touched * 80), None)
    frame[:, :, : rest.start] *= 1.8
    left = np.abs(under_illumination(gel, model.fit(frame)) - frame)[..., rest]
    assert np.all(left < 1 + 0.025 * gel[..., rest])


def test_saturated_blocks_tell_nothing_of_the_light() -> None:
    gel = _lit_gel(black=False)
    model = IlluminationModel(gel, 0.25 + (0.025 * gel) ** 2)
    frame = np.minimum(2.2 * gel, 255).astype(np.float32)
    left = np.abs(under_illumination(gel, model.fit(frame)) - frame)
    assert left.max() < 0.025 * 255


def test_the_first_contact_waits_for_nothing_that_the_untouched_gel_could_tell(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gel = np.full((64, 48, 3), 120, np.uint8)
    pressed = gel.copy()
    pressed[20:40, 20:40] = 160
    model = BackgroundModel(gel, repeatability=0.025, tint=0.01, shift=1.0)
    model.compare(gel, None)
    monkeypatch.delattr(background, "_steepness")
    change = model.compare(pressed, None)
    window = model.window_change(change, slice(0, 16), slice(0, 12), np.ones((16, 12), np.bool_), CHANNELS)
    # Measured: 20 against 3.6, what is left of the gain that is taken out.
    assert np.abs(window[:, 15, 15]).min() > 4 * np.abs(window[:, 2, 2]).max()


def test_blotches_wider_than_a_cell_are_no_noise_to_an_outline() -> None:
    random = np.random.default_rng(4)
    noise = random.normal(0, 2, (160, 160, 3))
    blotches = cv2.GaussianBlur(random.normal(0, 1, (160, 160)), (0, 0), 4)[..., None]
    strengths = []
    for shade in (0.0, 0.3):
        gel = 120 * (1 + shade * np.tanh(2 * blotches / blotches.std())) + noise
        pressed = gel.copy()
        pressed[60:100, 60:100] += [40, 0, -40]
        model = BackgroundModel(gel.astype(np.uint8), repeatability=0.025, tint=0.01, shift=0.0)
        change = model.compare(pressed.astype(np.uint8), None)
        window = model.window_change(
            change, slice(0, 40), slice(0, 40), np.ones((40, 40), np.bool_), CHANNELS
        )
        strengths.append(float(np.linalg.norm(window, axis=0)[34:46, 34:46].mean()))
    # Measured: 18.4 and 17.5; 7.8 on blotches with the noise by which it is told whether anything touches.
    assert strengths[1] > 0.8 * strengths[0]
