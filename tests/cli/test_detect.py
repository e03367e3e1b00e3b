"""`detect` says what marks a gel has, and draws it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.terminal import Terminal

GEL = "sim:press?frames=2"


def test_detected_dots_are_described_and_drawn(tmp_path: Path, terminal: Terminal) -> None:
    file = tmp_path / "found.png"
    assert terminal("detect", GEL, "--downsample", "2", "--picture", str(file)) == 0
    title, *lines = terminal.out.splitlines()
    assert title == f"{GEL}: 400 x 300 px"
    assert lines[0].startswith("yellow circles: 80 dark dots, radius 4.9 px, 34.0 px apart")
    assert lines[1].startswith("green: 142 links; 98 % of the parallelograms")
    picture = cv2.imread(str(file))
    assert picture is not None
    # Enlarged to 800 x 600, and the caption below.
    assert picture.shape[1] == 800
    assert picture.shape[0] > 600
    assert ((picture == (0, 255, 255)).all(axis=2)).any()


def test_a_gel_without_marks_is_exit_code_3_and_the_best_spots_are_drawn(
    tmp_path: Path, terminal: Terminal
) -> None:
    speckle = np.random.default_rng(1).normal(0, 1, (240, 320))
    speckle = cv2.GaussianBlur(speckle, (0, 0), 2.0)
    image, file = tmp_path / "speckle.png", tmp_path / "found.jpg"
    cv2.imwrite(str(image), np.where(speckle > 0.1, 40, 170).astype(np.uint8))
    assert terminal("detect", str(image), "--picture", str(file)) == 3
    out = terminal.out
    assert "0 markers found" in out
    assert "form no lattice" in out
    assert "magenta: best, " in out
    assert cv2.imread(str(file)) is not None


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["nowhere.mp4"], 4, "no such file"),
        ([GEL, "--dot", "900"], 2, "--dot: required dot_radius 1 to 150 px, got 900"),
        ([GEL, "--picture", "found.txt"], 2, "ends in .png or .jpg, got found.txt"),
        ([GEL, "--picture", "here.png"], 2, "here.png already exists; give --overwrite"),
    ],
)
def test_wrong_input_is_refused_in_words(
    options: list[str], code: int, words: str, tmp_path: Path, terminal: Terminal
) -> None:
    (tmp_path / "here.png").write_bytes(b"mine")
    assert terminal("detect", *options) == code
    assert words in terminal.err
    assert (tmp_path / "here.png").read_bytes() == b"mine"
