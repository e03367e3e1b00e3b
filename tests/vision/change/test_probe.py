"""The change probe: what it must see, what it must not, and how often it errs."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change import ChangeProbe

Image = NDArray[np.uint8]


@lru_cache(maxsize=1)
def gel(height: int = 240, width: int = 320, shift: float = 0.0) -> NDArray[np.float32]:
    """A gel with soft dark dots of radius 4 px on a grid of pitch 24 px, moved to the right by `shift` px."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    dx = (x - shift + 12) % 24 - 12
    dy = (y + 12) % 24 - 12
    dots = 80 / (1 + np.exp((np.hypot(dx, dy) - 4) / 0.5))
    return np.repeat((150 - dots)[:, :, None], 3, axis=2).astype(np.float32)


def noisy(image: NDArray[np.float32], seed: int, sigma: float = 2.0) -> Image:
    """The image as a camera with Gaussian noise sees it."""
    noise = np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image + np.float32(sigma) * noise), 0, 255).astype(np.uint8)


def warmed_up(image: NDArray[np.float32], frames: int = 20, sigma: float = 2.0) -> ChangeProbe:
    """A probe that has seen a still scene."""
    probe = ChangeProbe(noisy(image, 0, sigma))
    for seed in range(frames):
        probe.look(noisy(image, seed, sigma))
    return probe


@pytest.mark.parametrize("sigma", [0.0, 0.5, 2.0, 6.0])
def test_a_still_scene_is_unchanged_and_its_noise_is_measured(sigma: float) -> None:
    image = gel()
    probe = warmed_up(image, sigma=sigma)
    changed = [probe.look(noisy(image, 1000 + seed, sigma)) for seed in range(100)]
    # Rounding to whole levels adds a variance of 1/12. The median of 48 tiles' variances, each an average
    # over some 20 frames of 32 samples, scatters by about 1 %; six of that are allowed.
    assert probe.noise == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.06, abs=0.02)
    assert sum(changed) <= 2


def test_false_alarms_keep_to_the_share_that_was_asked_for() -> None:
    """At 20 % asked for, Bonferroni allows no more: of 400 frames 80, and 4 standard deviations are 32."""
    image = gel()
    probe = ChangeProbe(noisy(image, 0), false_alarms=0.2)
    for seed in range(30):
        probe.look(noisy(image, seed))
    changed = sum(probe.look(noisy(image, 1000 + seed)) for seed in range(400))
    assert 0 < changed < 80 + 32


@pytest.mark.parametrize(
    ("what", "image"),
    [
        ("every dot moves 0.1 px", gel(shift=0.1)),
        ("the light brightens by half a grey level", gel() + 0.5),
        (
            "a small bright spot",
            gel() + 30 * cv2.circle(np.zeros((240, 320, 3), np.float32), (100, 90), 8, (1, 1, 1), -1),
        ),
        ("one row of tiles darkens", gel() - 2.0 * (np.arange(240) < 40)[:, None, None]),
        # In a window of 3 x 3 tiles: 8 lines x 120 px, so 0.3 levels are 0.3 / (2 sqrt(2 / 960)) = 3.3 of its
        # standard deviations in each channel, and 7.7 in the window of 7 x 7 that holds all of it.
        (
            "a soft shadow of 0.3 grey levels over a third of the frame",
            gel() - 0.3 * (np.arange(320) < 120)[None, :, None],
        ),
        ("colour changes, brightness does not", gel() + np.array([1.0, -0.5, -0.5], np.float32)),
        (
            "one dot jumps by half a pitch",
            np.concatenate([gel()[:, :60], gel(shift=12)[:, 60:84], gel()[:, 84:]], axis=1),
        ),
    ],
)
def test_a_change_is_seen(what: str, image: NDArray[np.float32]) -> None:
    probe = warmed_up(gel())
    assert probe.look(noisy(image, 99)), f"{what}: {probe.strongest:.1f} of {probe.bound:.1f}"
    assert not probe.look(noisy(image, 100)), "the changed frame is the new anchor"


def test_a_slow_creep_adds_up_until_it_is_seen() -> None:
    """0.004 px a frame is far below what one step shows; what may pass unseen stays below 0.1 px."""
    probe = warmed_up(gel())
    anchor = 0.0
    worst = 0.0
    seen = 0
    for i in range(200):
        if probe.look(noisy(gel(shift=0.004 * i), 500 + i)):
            anchor, seen = 0.004 * i, seen + 1
        worst = max(worst, 0.004 * i - anchor)
    assert seen >= 8
    assert worst < 0.1


def test_repeated_frames_are_unchanged_and_the_next_real_one_is_found() -> None:
    image = noisy(gel(), 1)
    probe = ChangeProbe(image)
    assert [probe.look(image) for _ in range(20)] == [True] * 6 + [False] * 14
    assert probe.look(noisy(gel(), 2)), "new noise on a source that was frozen is a change"


def test_a_flickering_light_is_never_taken_for_noise() -> None:
    """All frames differ by whole grey levels that all tiles share; also after seconds of it."""
    probe = ChangeProbe(noisy(gel(), 0))
    levels = np.random.default_rng(5).normal(0, 3, 300)
    changed = [probe.look(noisy(gel() + level, 100 + i)) for i, level in enumerate(levels)]
    # Two levels in a row that differ by less than 0.1 are nearly the same light: 2 % of them; 6 % may be.
    assert np.count_nonzero(changed) >= 282


def test_noise_that_neighbouring_pixels_share_is_learned() -> None:
    """A camera that smooths or compresses: sums over tiles scatter more than independent pixels would."""
    smooth = [
        cv2.GaussianBlur(np.random.default_rng(i).normal(0, 12, (240, 320, 3)), (0, 0), 2.0)
        for i in range(150)
    ]
    probe = ChangeProbe(noisy(gel(), 0))
    changed = [probe.look(noisy(gel() + extra, 200 + i, 0.5)) for i, extra in enumerate(smooth)]
    # One in a thousand is asked for; while six pairs of frames are all that is known, more.
    assert np.count_nonzero(changed[6:]) <= 4
    assert probe.look(noisy(gel(shift=0.5), 999, 0.5))


def test_noise_learned_while_everything_moved_is_learned_anew() -> None:
    random = np.random.default_rng(3)
    probe = ChangeProbe(noisy(gel(), 0))
    for i in range(40):
        probe.look(noisy(gel(shift=float(random.uniform(-4, 4))), i))
    for i in range(160):
        probe.look(noisy(gel(), 100 + i))
    # As in a scene that never moved; the noise of a median of tiles is known to 6 %, see above.
    assert probe.noise == pytest.approx(np.hypot(2.0, np.sqrt(1 / 12)), rel=0.06)
    assert probe.look(noisy(gel(shift=0.1), 999))


def test_what_is_calm_is_rarer_than_what_is_unchanged() -> None:
    """One still frame in ten may be not calm (Bonferroni: fewer): 30 of 300, and 5 deviations are 26."""
    probe = warmed_up(gel(), frames=40)
    looks = [(probe.look(noisy(gel(), 1000 + i)), probe.calm) for i in range(300)]
    assert not any(changed and calm for changed, calm in looks)
    assert 0 < sum(not calm for _, calm in looks) < 30 + 26


def test_noise_learned_from_frozen_frames_recovers() -> None:
    image = noisy(gel(), 1)
    probe = ChangeProbe(image)
    for _ in range(20):
        probe.look(image)
    changed = [probe.look(noisy(gel(), 100 + i)) for i in range(120)]
    assert not any(changed[90:])


@pytest.mark.parametrize(
    "shape", [(1, 1, 3), (1, 50, 3), (50, 1, 3), (7, 9, 3), (31, 33), (601, 799, 3), (8, 8, 1)]
)
@pytest.mark.parametrize("level", [0, 128, 255])
def test_any_size_and_any_constant_frame_has_an_answer(shape: tuple[int, ...], level: int) -> None:
    frame = np.full(shape, level, np.uint8)
    probe = ChangeProbe(frame)
    assert [probe.look(frame) for _ in range(10)] == [True] * 6 + [False] * 4
    assert np.isfinite(probe.strongest)
    other = np.full(shape, 40, np.uint8)
    assert probe.look(other)


def test_views_and_read_only_frames_are_fine_and_left_alone() -> None:
    frame = noisy(gel(), 3)
    view = np.asfortranarray(frame)
    view.flags.writeable = False
    probe, plain = ChangeProbe(view), ChangeProbe(frame)
    for _ in range(8):
        assert probe.look(view) == plain.look(frame)
    assert probe.strongest == plain.strongest


@pytest.mark.parametrize(
    ("frame", "options", "words"),
    [
        (np.zeros((4, 4), np.float32), {}, "required an image of uint8"),
        (np.zeros((0, 4), np.uint8), {}, "required an image of uint8"),
        (np.zeros((4, 4), np.uint8), {"false_alarms": 0}, "false_alarms in"),
        (np.zeros((4, 4), np.uint8), {"false_alarms": float("nan")}, "false_alarms in"),
        (np.zeros((4, 4), np.uint8), {"tile": 1}, "at least 8 px"),
    ],
)
def test_what_it_cannot_work_with_is_refused(frame: Image, options: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ChangeProbe(frame, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="required a frame of shape"):
        ChangeProbe(np.zeros((4, 4), np.uint8)).look(np.zeros((5, 4), np.uint8))
