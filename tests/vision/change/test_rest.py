"""The rest test: what it must see, what it must not, and how often it errs."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change import RestTest
from tactflow.vision.contact import ContactDetector

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
PITCH = 24


@lru_cache(maxsize=1)
def gel(shift: float = 0.0) -> Floats:
    """A gel with soft dark dots of radius 4 px on a grid, moved to the right by `shift` px."""
    y, x = np.mgrid[0:240, 0:320].astype(np.float32)
    dx, dy = (x - shift + PITCH / 2) % PITCH - PITCH / 2, (y + PITCH / 2) % PITCH - PITCH / 2
    dots = 80 / (1 + np.exp((np.hypot(dx, dy) - 4) / 0.5))
    return np.repeat((150 - dots)[:, :, None], 3, axis=2).astype(np.float32)


def noisy(image: Floats, seed: int, sigma: float = 2.0) -> Image:
    """The image as a camera with Gaussian noise sees it."""
    noise = np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image + np.float32(sigma) * noise), 0, 255).astype(np.uint8)


def at_rest(frames: int = 20, sigma: float = 2.0) -> RestTest:
    """A test that has seen a still scene."""
    test = RestTest(noisy(gel(), 0, sigma))
    for seed in range(frames):
        test.look(noisy(gel(), seed, sigma))
    return test


def test_false_alarms_keep_to_the_share_that_was_asked_for() -> None:
    """At 20 % asked for, Bonferroni allows no more: of 100 frames 20, and 4 standard deviations are 16."""
    test = RestTest(noisy(gel(), 0, 0.5), false_alarms=0.2)
    looks = [test.look(noisy(gel(), seed, 0.5)) for seed in range(1, 141)]
    assert not any(look.suspect for look in looks[1:])
    assert sum(look.changed for look in looks[40:]) < 20 + 16


def spot(radius: int, level: float) -> Floats:
    return level * cv2.circle(np.zeros((240, 320, 3), np.float32), (100, 90), radius, (1, 1, 1), -1)


@pytest.mark.parametrize("radius", [8, 16, 50])
@pytest.mark.parametrize("colour", [(1, 1, 1), (-1, -1, -1), (1, 0, 0), (1, -0.5, -0.5)])
def test_what_is_contact_is_suspect_however_slowly_it_comes(
    radius: int, colour: tuple[float, float, float]
) -> None:
    y, x = np.mgrid[0:240, 0:320].astype(np.float32)
    plain = np.repeat((120 + 30 * np.sin(x / 90) + 20 * np.cos(y / 70))[..., None], 3, axis=2)
    still = noisy(plain, 0)
    detector, test = ContactDetector(), RestTest(still)
    detector.add_reference(still)
    frames = [noisy(plain + spot(radius, level) * np.float32(colour), level) for level in range(80)]
    suspects = [test.look(frame).suspect for frame in frames]
    begin = [detector.detect(frame).touching for frame in frames].index(True)
    assert not any(suspects[1:3])
    assert any(suspects[begin : begin + 2])


def test_what_is_faint_contact_on_a_gray_camera_is_suspect_however_slowly_it_comes() -> None:
    y, x = np.mgrid[0:240, 0:320].astype(np.float32)
    plain = np.repeat((120 + 30 * np.sin(x / 90) + 20 * np.cos(y / 70))[..., None], 3, axis=2)

    def camera(seed: int, height: float) -> Image:
        bump = 1 + height * np.exp(-((x - 100) ** 2 + (y - 90) ** 2) / (2 * 16**2))[..., None]
        return np.repeat(noisy(plain * bump, seed)[..., :1], 3, axis=2)

    detector, test = ContactDetector(), RestTest(camera(0, 0))
    detector.add_reference(camera(0, 0))
    heights = np.repeat(np.linspace(0, 0.09, 30), 2)
    looks = [test.look(camera(seed, height)) for seed, height in enumerate(heights, 1)]
    found = [detector.detect(camera(seed, height)) for seed, height in enumerate(heights, 1)]
    begin = [result.touching for result in found].index(True)
    suspects = [look.suspect for look in looks]
    assert not any(suspects[1 : begin // 2])
    # It takes two frames to find a faint contact.
    assert sum(suspects[begin // 2 : begin + 2]) >= 2


def test_a_touch_in_a_frame_of_its_own_is_seen_and_what_follows_is_rest_again() -> None:
    test = at_rest()
    assert test.look(noisy(gel() + spot(8, 60), 99)).suspect
    # While something touches, all is worked on; the first frame after it still counts as touched.
    assert test.look(noisy(gel(), 100), touching=True).suspect
    assert not test.look(noisy(gel(), 101)).suspect
    assert test.look(noisy(gel() + spot(8, 60), 102)).suspect


def test_light_that_creeps_back_is_rest_and_light_that_departs_is_not() -> None:
    test = at_rest()
    for frame in range(10):
        test.look(noisy(gel() + spot(30, 60), 200 + frame), touching=True)
    back = [test.look(noisy(gel() + spot(30, 60 - 5 * frame), 220 + frame)).suspect for frame in range(10)]
    assert sum(back) <= 1
    away = [test.look(noisy(gel() + spot(30, frame), 240 + frame)).suspect for frame in range(60)]
    assert not any(away[:5])
    assert sum(away) > 10


@pytest.mark.parametrize("gain", [(1.3, 1, 0.8), (0.6, 0.6, 0.6)])
def test_other_lamps_are_no_touch(gain: tuple[float, float, float]) -> None:
    """Even if they shine from one side."""
    side = np.linspace(0.95, 1.05, 320, dtype=np.float32)[:, None]
    looks = [at_rest().look(noisy(gel() * np.float32(gain) * side, seed)) for seed in range(3)]
    assert not any(look.suspect for look in looks)


def test_a_slow_drag_is_looked_at_before_dots_are_off_by_their_tolerance() -> None:
    test = at_rest(sigma=0.5)
    looked_at, worst, repeated = 0.0, 0.0, 0
    for frame in range(40):
        shift = 0.02 * max(0, frame - 10)
        if test.look(noisy(gel(shift), 300 + frame, 0.5)).changed:
            looked_at = shift
        else:
            repeated += 1
        worst = max(worst, shift - looked_at)
    assert repeated >= 8
    assert worst <= 0.05


def test_a_frame_that_comes_twice_is_repeated_and_teaches_nothing() -> None:
    test = at_rest()
    frame = noisy(gel(), 99)
    test.look(frame)
    assert [test.look(frame.copy()) for _ in range(60)] == [(False, False)] * 60
    assert not test.look(noisy(gel(), 100)).suspect


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (7, 9), (31, 33), (601, 799)])
@pytest.mark.parametrize("level", [0, 128, 255])
def test_any_size_and_any_constant_frame_has_an_answer(shape: tuple[int, int], level: int) -> None:
    frame = np.full((*shape, 3), level, np.uint8)
    test = RestTest(frame)
    assert test.look(frame) == (True, True)
    assert [test.look(frame) for _ in range(5)] == [(False, False)] * 5
    assert test.look(frame, due=True) == (True, True)


def test_views_and_read_only_frames_are_fine_and_left_alone() -> None:
    view = np.asfortranarray(noisy(gel(), 3))
    kept = view.copy()
    view.flags.writeable = False
    test, plain = RestTest(view), RestTest(kept)
    for _ in range(3):
        assert test.look(view) == plain.look(kept)
    np.testing.assert_array_equal(view, kept)


@pytest.mark.parametrize(
    ("frame", "options", "words"),
    [
        (np.zeros((4, 4, 3), np.float32), {}, "required a non-empty"),
        (np.zeros((0, 4, 3), np.uint8), {}, "required a non-empty"),
        (np.zeros((4, 4), np.uint8), {}, "required a non-empty"),
        (np.zeros((4, 4, 3), np.uint8), {"false_alarms": 0}, "false_alarms in"),
        (np.zeros((4, 4, 3), np.uint8), {"false_alarms": float("nan")}, "false_alarms in"),
    ],
)
def test_what_it_cannot_work_with_is_refused(frame: Image, options: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        RestTest(frame, **options)
    with pytest.raises(ValueError, match="required a frame of shape"):
        RestTest(np.zeros((4, 4, 3), np.uint8)).look(np.zeros((5, 4, 3), np.uint8))
