"""What counts as a fault of a live source, told frame by frame and second by second."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sources.health import SETTLE_SECONDS, STEADY_SECONDS, Health, Verdict, Watch
from tests.clock import ManualClock

BRIGHT = np.full((48, 64, 3), 100, np.uint8)


class Story:
    """A source at 10 frames per second, and its health."""

    def __init__(self, **settings: float | bool | None) -> None:
        self.clock = ManualClock()
        self.health = Health(Watch(**settings), "cam", None, self.clock)  # type: ignore[arg-type]
        self.random = np.random.default_rng(0)

    def noisy(self) -> NDArray[np.uint8]:
        return self.random.integers(90, 110, BRIGHT.shape, np.uint8)

    def frames(self, count: int, image: NDArray[np.uint8] | None = None) -> list[Verdict]:
        """So many frames, 0.1 s apart; noisy ones if no picture is given."""
        verdicts = []
        for _ in range(count):
            self.clock.advance(0.1)
            verdicts.append(self.health.frame(self.noisy() if image is None else image, self.clock.now()))
        return verdicts

    def silence(self, seconds: float) -> None:
        self.clock.advance(seconds)
        self.health.look(self.clock.now())


def test_frames_that_differ_are_good() -> None:
    story = Story()
    assert set(story.frames(50)) == {Verdict.GOOD}
    assert story.health.state == "running"


def test_silence_is_reported_once_it_lasts(caplog: pytest.LogCaptureFixture) -> None:
    story = Story(silent_after=0.8)
    story.frames(20)
    story.silence(0.7)
    assert story.health.state == "running"
    story.silence(0.2)
    story.silence(0.2)
    assert story.health.state.startswith("waiting since")
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


def test_a_camera_that_was_never_fast_is_not_silent_after_the_usual_time() -> None:
    story = Story(silent_after=0.05)
    story.frames(200)
    # Three times its interval of 0.1 s.
    story.silence(0.25)
    assert story.health.state == "running"
    story.silence(0.1)
    assert story.health.state != "running"


def test_frames_right_behind_a_silence_are_held_back() -> None:
    story = Story(silent_after=0.5, frozen_after=None)
    story.frames(5)
    story.silence(1.0)
    assert story.frames(1) == [Verdict.WITHHOLD]
    story.clock.advance(1.5 * SETTLE_SECONDS)
    assert story.health.frame(story.noisy(), story.clock.now()) is Verdict.GOOD
    assert story.health.state == "running"


def test_a_frozen_picture_opens_the_source_anew_after_its_time() -> None:
    story = Story(frozen_after=1.0)
    story.frames(5)
    verdicts = story.frames(20, BRIGHT)
    # The first differs from those before it; ten more make one second.
    assert verdicts.index(Verdict.REOPEN) in (10, 11)
    assert set(verdicts[:10]) == {Verdict.GOOD}


def test_without_reconnection_a_frozen_picture_is_only_held_back() -> None:
    story = Story(frozen_after=1.0, reconnect=False)
    verdicts = story.frames(30, BRIGHT)
    assert verdicts[-1] is Verdict.WITHHOLD
    assert Verdict.REOPEN not in verdicts


def test_black_before_any_light_is_held_back_from_the_first_frame() -> None:
    story = Story(frozen_after=None, black_after=1.0)
    assert story.frames(5, 0 * BRIGHT) == [Verdict.WITHHOLD] * 5
    assert story.frames(1) == [Verdict.GOOD]


def test_a_short_dark_moment_behind_light_is_passed_on() -> None:
    story = Story(frozen_after=None, black_after=1.0)
    story.frames(5)
    assert set(story.frames(8, 0 * BRIGHT)) == {Verdict.GOOD}


def test_the_time_between_attempts_doubles_up_to_the_last() -> None:
    story = Story(first_retry=0.25, last_retry=2.0)
    story.frames(5)
    story.health.ended("unplugged", story.clock.now())
    delays = []
    for _ in range(6):
        delays.append(story.health.retry_at - story.clock.now())
        story.clock.advance(delays[-1])
        story.health.missed_attempt("nothing there", story.clock.now())
    assert delays == pytest.approx([0.25, 0.5, 1.0, 2.0, 2.0, 2.0])


@pytest.mark.parametrize(("seconds", "starts_small"), [(0.5, False), (STEADY_SECONDS + 1, True)])
def test_only_a_connection_that_lasted_makes_the_next_attempts_quick_again(
    seconds: float, starts_small: bool
) -> None:
    story = Story(first_retry=0.25, last_retry=2.0)
    story.frames(5)
    story.health.ended("unplugged", story.clock.now())
    for _ in range(4):
        story.health.missed_attempt("nothing there", story.clock.now())
    story.frames(round(seconds / 0.1))
    story.health.ended("unplugged", story.clock.now())
    assert (story.health.retry_at - story.clock.now() < 0.3) == starts_small


def test_patience_ends_with_what_was_tried_last() -> None:
    story = Story(no_frame_timeout=5.0)
    story.frames(5)
    story.health.ended("unplugged", story.clock.now())
    story.health.missed_attempt("no such device", story.clock.now())
    story.clock.advance(4.5)
    assert story.health.given_up(story.clock.now()) is None
    story.clock.advance(1.0)
    error = story.health.given_up(story.clock.now())
    assert "gone, no good frame for 5.5 s; the last attempt of 1: no such device" in str(error)
