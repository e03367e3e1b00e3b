"""Which of the first frames shows the untouched gel in steady light."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change.settling import MAX_STEADY_FRAMES, Settling, change_between, look_at, unevenness

Image = NDArray[np.uint8]

RNG = np.random.default_rng(7)
Y, X = np.mgrid[0:120, 0:160]
GEL = np.stack([90 + 0.3 * X, 120 - 0.2 * Y, 80 + 0.2 * Y + 0.1 * X], axis=-1)
"""A gel lit from the sides, grey levels."""


def picture(
    gain: float | tuple[float, float, float] = 1.0, pressed: float = 0.0, place: float = 70.0
) -> Image:
    """The gel under another light, with noise; `pressed` in the middle or at another x, relative."""
    bump = pressed * np.exp(-((X - place) ** 2 + (Y - 60) ** 2) / 2 / 12**2)
    colours = np.stack([bump, -bump, 0 * bump], axis=-1)
    light = GEL * np.asarray(gain) * (1 + colours) + RNG.normal(0, 1.5, GEL.shape)
    return np.asarray(np.clip(np.rint(light), 0, 255), np.uint8)


def settled(frames: list[Image], rate: float = 25.0) -> Settling:
    """Look at frames until no more need to be."""
    settling = Settling()
    for index, frame in enumerate(frames):
        settling.add(frame, index / rate)
        if settling.steady:
            break
    return settling


def test_light_that_is_steady_from_the_start_leaves_the_first_frame_the_reference() -> None:
    settling = settled([picture() for _ in range(30)])
    assert (len(settling), settling.best()) == (MAX_STEADY_FRAMES, 0)
    assert settling.alike() == list(range(MAX_STEADY_FRAMES))


@pytest.mark.parametrize("white_balance", [False, True])
def test_frames_are_passed_over_while_the_camera_sets_its_light(white_balance: bool) -> None:
    gains = [1.3 - 0.03 * i for i in range(10)]
    frames = [picture((1.0, 1.0, g) if white_balance else g) for g in gains] + [picture() for _ in range(20)]
    settling = settled(frames)
    assert settling.steady
    assert settling.best() >= 9
    assert not settling.touched_before(settling.best())


def test_saturated_pixels_do_not_hide_that_the_light_changes() -> None:
    gain, moved = change_between(look_at(picture(2.2)), look_at(picture(1.8)))
    np.testing.assert_allclose(gain, np.log(1.8 / 2.2), atol=0.01)
    assert not moved


def test_the_touch_of_before_is_not_taken_for_the_untouched_gel() -> None:
    frames = [picture(0.6, 0.5), *(picture(1, 0.5) for _ in range(5)), *(picture() for _ in range(7))]
    settling = settled(frames + [picture(1, -0.4) for _ in range(20)])
    assert settling.steady
    assert 6 <= settling.best() <= 12
    assert settling.touched_before(settling.best())


def test_a_grasp_in_which_a_lamp_changes_is_not_taken_for_the_untouched_gel() -> None:
    """The pattern of a gel without dots is so strong that a contact hardly makes it less even."""
    pattern = 1 + 0.3 * np.sin(X / 6)[..., None]
    frames = [picture() for _ in range(7)]
    frames += [picture(1, 0.15 * i) for i in range(1, 4)]
    frames += [picture((1, 1.03, 0.95), 0.5) for _ in range(20)]
    frames = [np.asarray(np.clip(frame * pattern, 0, 255), np.uint8) for frame in frames]
    settling = settled(frames, 30.0)
    assert settling.steady
    assert settling.best() == 0


@pytest.mark.parametrize(("rate", "looked_at"), [(100.0, 10), (25.0, 10), (15.0, 6), (12.5, 5), (2.0, 4)])
def test_light_must_be_steady_for_a_time_but_never_for_fewer_frames_than_tell(
    rate: float, looked_at: int
) -> None:
    assert len(settled([picture() for _ in range(30)], rate)) == looked_at


@pytest.mark.parametrize("every", [1, 2])
def test_a_gel_at_rest_between_two_grasps_is_found_at_half_the_rate_too(every: int) -> None:
    warming = [picture(0.7 + 0.05 * i, 0.3) for i in range(6)]
    grasped = [picture(1, 0.2 * i, 100) for i in range(1, 4)] + [picture(1, 0.6, 100) for _ in range(60)]
    frames = warming + [picture() for _ in range(6)] + grasped
    settling = settled(frames[::every], 25 / every)
    assert 6 <= every * settling.best() <= 11


def test_a_touch_of_which_only_the_end_is_seen_is_not_the_gel_but_one_that_lasts_may_be() -> None:
    untouched = [picture(1, 0.2, 110) for _ in range(20)]
    brief = settled([picture(1, 0.25, 60) for _ in range(3)] + untouched)
    assert (brief.best() >= 3, brief.undecided) == (True, False)
    lasting = settled([picture(1, 0.25, 60) for _ in range(6)] + untouched)
    assert (lasting.best(), lasting.undecided) == (0, True)


def test_a_finger_that_comes_early_is_not_taken_for_the_gel() -> None:
    settling = settled([picture() for _ in range(6)] + [picture(1, 0.3) for _ in range(20)])
    assert settling.steady
    assert settling.best() == 0
    assert settling.alike() == list(range(6))


def test_a_picture_without_noise_is_the_evenest() -> None:
    gel = np.full((120, 160, 3), 100, np.uint8)
    settling = settled([gel] * 6 + [picture(1, 0.3)] * 20)
    assert unevenness(look_at(gel)) == 0
    assert settling.steady
    assert settling.touched
    assert settling.best() == 0


def test_two_states_that_are_as_even_are_said_to_be_undecided() -> None:
    first = [picture(1, 0.3, 110) for _ in range(6)]
    settling = settled(first + [picture(1, 0.3) for _ in range(20)])
    assert (settling.undecided, settling.best(), settling.begins) == (True, 0, 6)
    assert not settled([picture() for _ in range(20)]).undecided
    passing = [picture(1, 0.3) for _ in range(3)]
    assert not settled([picture() for _ in range(3)] + passing + [picture() for _ in range(20)]).undecided
    assert not settled(first + [picture() for _ in range(20)]).undecided


def test_a_finger_that_comes_slowly_ends_the_frames_that_are_alike() -> None:
    pressed = [0.0] * 4 + [0.03 * i for i in range(12)]
    settling = settled([picture(1, depth) for depth in pressed] + [picture(1, 0.33)] * 10)
    assert settling.best() == 0
    assert max(settling.alike()) <= 8


def test_a_lamp_that_flickers_is_as_steady_as_it_gets() -> None:
    flicker = RNG.normal(1, 0.03, 40)
    settling = settled([picture(gain) for gain in flicker])
    assert settling.steady
    assert settling.best() <= 2


def test_separate_pictures_are_no_video_and_the_first_one_is_the_reference() -> None:
    settling = Settling()
    for index in range(2 * MAX_STEADY_FRAMES):
        assert not settling.unrelated
        settling.add(np.roll(picture(1, 0.6 if index else 0), 13 * index, axis=1), index / 25)
    assert settling.unrelated
    assert settling.best() == 0


@pytest.mark.parametrize("shape", [(3, 4), (1, 1, 3), (48, 64, 1), (700, 30, 3), (1, 640), (2000, 2, 3)])
def test_pictures_of_any_size_can_be_looked_at(shape: tuple[int, ...]) -> None:
    settling = settled([np.full(shape, 100, np.uint8)] * MAX_STEADY_FRAMES)
    assert settling.steady
    assert settling.best() == 0
