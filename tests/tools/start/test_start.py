"""`tactflow start` without questions, and what it refuses."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import tactflow
from tactflow.cli.main import main, make_parser
from tactflow.engine.errors import SourceError
from tactflow.sources import FrameReader
from tactflow.tools.start import command as start
from tactflow.tools.start.propose import divide
from tests.terminal import Terminal

Recorded = Callable[[str], str]
"""Name and settings of a simulated scene -> a recording of it with few pixels."""


MADE = Path("made.yaml")
PROPOSE = ("start", "--yes", "--no-run", "--out", str(MADE))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("recorded")

    @cache
    def record(scene: str) -> str:
        gel = tactflow.open_scene(scene)
        file = folder / f"{scene.partition('?')[0]}-{len(gel)}.npy"
        np.save(file, np.stack([cv2.resize(gel.frame(seq), (400, 300)) for seq in range(len(gel))]))
        return str(file)

    return record


@pytest.mark.parametrize(
    ("scene", "base", "dots"),
    [("press", "default", True), ("halo", "markerless", False), ("painted", "default", True)],
)
def test_a_script_takes_the_proposals_and_the_file_finds_the_contacts(
    scene: str, base: str, dots: bool, recorded: Recorded, terminal: Terminal
) -> None:
    source = recorded(f"{scene}?frames=120")
    MADE.write_text("mine")
    assert terminal(*PROPOSE, source) == 2
    assert "already exists; give --overwrite" in terminal.err
    assert MADE.read_text() == "mine"
    assert terminal(*PROPOSE, source, "--overwrite") == 0
    assert "is written" in terminal.err
    text = MADE.read_text()
    assert f"from {base}.yaml" in text.splitlines()[0]
    assert ("tracker" in yaml.safe_load(text)["stages"]) == dots
    assert tactflow.check(MADE) == []
    results = list(tactflow.stream(MADE))
    assert not results[0].contact
    assert sum(result.contact is not None for result in results) > 20


def test_without_a_press_the_proposal_says_that_contacts_are_untested(
    recorded: Recorded, terminal: Terminal
) -> None:
    assert terminal(*PROPOSE, recorded("idle?frames=40")) == 0
    assert "No press was seen" in terminal.err


def test_a_gel_whose_presses_no_pipeline_finds_is_not_set_up(terminal: Terminal) -> None:
    frames = np.full((24, 96, 128, 3), 90, np.uint8)
    frames += np.random.default_rng(0).integers(0, 4, frames.shape, np.uint8)
    frames[8:, 30:60, 40:80] = 97  # a change too faint for a contact, and too large for rest
    np.save("faint.npy", frames)
    assert terminal(*PROPOSE, "faint.npy") == 3
    assert "No pipeline finds the presses" in terminal.err
    assert not MADE.exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="cameras have no list outside Linux")
def test_without_a_camera_the_error_says_what_to_do(tmp_path: Path) -> None:
    args = make_parser("start").parse_args(["start", "--out", str(tmp_path / "made.yaml")])
    args.dev = tmp_path
    with pytest.raises(SourceError, match="no camera is plugged in") as caught:
        start.run(args)
    assert "tactflow start sim:press" in str(caught.value)
    (tmp_path / "video0").write_text("not a device")
    with pytest.raises(SourceError, match="video0"):
        start.run(args)


def test_a_script_cannot_press_a_camera(monkeypatch: pytest.MonkeyPatch, terminal: Terminal) -> None:
    class Live(FrameReader):
        live, fps = True, 30.0

        def _frames(self) -> Iterator[tuple[np.ndarray, float]]:
            yield np.zeros((60, 80, 3), np.uint8), 0.0

    monkeypatch.setattr(start, "open_source", lambda _: Live("a camera"))
    assert terminal(*PROPOSE, "0") == 2
    assert "--yes: required a recording as SRC" in terminal.err


class Scripted:
    """Answers in place of a person."""

    unattended, url, reader = False, None, None

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.asked: list[str] = []

    def ask(self, text: str, choices: Mapping[str, str], **_: object) -> str:
        self.asked.append(text)
        answer = self.answers.pop(0)
        assert answer in choices
        return answer

    def begin(self, *_: object, **__: object) -> None: ...

    def show(self, _: object) -> None: ...

    def close(self) -> None: ...


def test_of_several_cameras_the_one_that_is_the_sensor_is_set_up(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = [str(tmp_path / "busy.avi"), "sim:idle?frames=30", recorded("halo?frames=60")]
    answers = Scripted("no", "yes", "digit", "90", "write")
    monkeypatch.setattr(start, "_cameras", lambda _: cameras)
    monkeypatch.setattr(start, "Questions", lambda *_: answers)
    out = tmp_path / "made.yaml"
    assert main(["start", "--no-run", "--out", str(out)]) == 0
    assert [text for text in answers.asked if "Is this" in text] == [
        f"Is this the sensor? {source}" for source in cameras[1:]
    ]
    pipeline = yaml.safe_load(out.read_text())
    assert pipeline["stages"]["capture"]["source"] == cameras[2]
    assert pipeline["stages"]["preprocess"]["rotate"] == 90
    assert pipeline["sensor"] == "digit"


@pytest.mark.parametrize(
    ("recording", "base", "dots"),
    [("digit_fots", "digit", False), ("gelslim_ball", "default", True), ("mini_ball", "mini", True)],
)
def test_real_sensors(recording: str, base: str, dots: bool, shared_data: Path, terminal: Terminal) -> None:
    assert terminal(*PROPOSE, str(shared_data / "gels" / recording)) == 0
    assert f"from {base}.yaml" in MADE.read_text().splitlines()[0]
    assert ("tracker" in yaml.safe_load(MADE.read_text())["stages"]) == dots


def test_presses_are_found_in_a_film_that_begins_with_another_state_of_the_gel(shared_data: Path) -> None:
    reader = cv2.VideoCapture(str(shared_data / "gels/franka_mini/ball_white_thread-1-0.avi"))
    frames = []
    while (read := reader.read())[0]:
        frames.append(cv2.resize(read[1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    sample = divide([np.asarray(frame, np.uint8) for frame in frames])
    assert sample.reference > 0
    assert len(sample.pressed) > 0.8 * len(frames)
    assert sample.strongest in sample.pressed
