"""`doctor` on the recordings of one session: are its sensors in step?"""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.recording.course import Course, Glance
from tactflow.tools.doctor.step import Track, examine_session
from tests.terminal import Terminal

FPS = 25.0
MOVES = np.random.default_rng(4).exponential(5.0, 400)
"""How much the gel moves in each moment of a session, grey levels."""


def track(name: str, moves: NDArray[np.float64], begins: float | None = None, start: float = 0.0) -> Track:
    """The course of a sensor that sees these moves."""
    course = Course()
    own = np.random.default_rng(len(name)).exponential(1.0, len(moves))
    for seq, change in enumerate(moves + own):
        course.add(Glance(start + seq / FPS, seq, float(change), False, 0.0))
    return Track(name, course, begins)


@pytest.mark.parametrize(
    ("right", "verdict", "says"),
    [
        (track("right", MOVES[:300]), "good", "right and left are in step"),
        (track("right", MOVES[:297], start=0.012), "good", "right and left are in step"),
        (track("right", MOVES[[0, 0, 0, *range(297)]]), "warning", "right is 119 ms behind left"),
        (track("right", MOVES[5:305]), "warning", "left is 200 ms behind right"),
        (
            track("right", np.concatenate([MOVES[:150], MOVES[160:310]])),
            "warning",
            "right goes out of step with left: ",
        ),
        (track("right", MOVES[:250]), "warning", "right ends 2.0 s before left"),
        (track("right", MOVES[:140]), "fault", "right ends 6.4 s before left"),
        (track("right", MOVES[:60]), "fault", "right ends 9.6 s before left"),
        (track("right", MOVES[::-1][:300]), "unknown", "no motion in common"),
    ],
)
def test_a_sensor_that_is_out_of_step_is_found(right: Track, verdict: str, says: str) -> None:
    (found,) = examine_session([track("left", MOVES[:300]), right])
    assert (found.verdict, says in found.says) == (verdict, True), found


def test_sensors_with_a_common_clock_are_compared_at_the_same_moments() -> None:
    left = track("left", MOVES[:300], begins=1e9)
    late = track("right", MOVES[100:400], begins=1e9 + 100 / FPS)
    (found,) = examine_session([left, late])
    assert found.says == "right begins 4.0 s after left; left ends 4.0 s before right"
    (found,) = examine_session([left, track("right", MOVES[104:304], begins=1e9 + 100 / FPS)])
    assert "left is 160 ms behind right" in found.says


def films(folder: Path, *lags: int) -> list[str]:
    """A lossless film of a gel that moves, for each lag, frames."""
    rng = np.random.default_rng(6)
    steps = np.stack([rng.normal(0, move / 5, (48, 64, 3)) for move in MOVES[:120]])
    light = np.linspace(60, 180, 64)[:, None]
    pictures = np.clip(light + np.cumsum(steps, axis=0), 0, 255).astype(np.uint8)
    paths = []
    for number, lag in enumerate(lags):
        path = folder / f"finger-{number}.avi"
        video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), FPS, (64, 48))
        for index in range(110):
            video.write(pictures[max(index - lag, 0)])
        video.release()
        paths.append(str(path))
    return paths


def test_several_recordings_have_one_verdict_and_json_holds_it(tmp_path: Path, terminal: Terminal) -> None:
    paths = films(tmp_path, 0, 4)
    terminal("doctor", *paths)
    line = terminal.out.splitlines()[-1]
    assert re.fullmatch(r"usable: finger-1.avi is 1[56]. ms behind finger-0.avi", line)
    terminal("doctor", "--json", *paths)
    report = json.loads(terminal.out)
    assert [part["source"] for part in report["recordings"]] == paths
    assert report["together"][0]["name"] == "step"
    assert report["says"] == line == f"{report['recording']}: {line.partition(': ')[2]}"


def test_doctor_without_a_recording_says_what_is_required(terminal: Terminal) -> None:
    assert terminal("doctor") == 2
    assert "required a RECORDING, or --source SRC" in terminal.err
