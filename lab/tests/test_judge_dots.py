from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.judges.judge_dots import CHANGES, DOTS, compare, find, judge, main
from lab.judges.label_file import FrameLabel, load_labels, save_labels
from tests.vision.dots import grid, render

TRUTH = grid(5, 7, 30.0, corner=(40.0, 35.0))
SIZE = (260, 200)


def label(dots: object, round_: int = 1, frame: int = 0) -> FrameLabel:
    return FrameLabel(
        recording="gel", frame=frame, reference=0, lab="simulated", round=round_, contact=None, dots=dots
    )


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A recording whose first frame shows dots and whose second frame shows none."""
    (tmp_path / "gel").mkdir()
    cv2.imwrite(str(tmp_path / "gel" / "0.png"), render(SIZE, TRUTH, 4.0, noise=1.0))
    cv2.imwrite(str(tmp_path / "gel" / "1.png"), render(SIZE, TRUTH[:0], 4.0, noise=1.0))
    return tmp_path


def test_a_missed_dot_and_a_false_one_are_counted() -> None:
    found = np.concatenate([TRUTH[1:] + 2.0, [[55.0, 50.0]]])
    one = compare("lab", found, TRUTH, TRUTH[:0], SIZE)
    assert (one.dots, one.found, one.false) == (35, 34, 1)


def test_two_found_in_one_place_are_one_and_a_false_one() -> None:
    one = compare("lab", np.concatenate([TRUTH, TRUTH[:1] + 3.0]), TRUTH, TRUTH[:0], SIZE)
    assert (one.found, one.false) == (35, 1)


def test_uncertain_dots_and_those_at_the_border_count_neither_way() -> None:
    uncertain, border = TRUTH[:4], np.array([[3.0, 100.0]])
    for found in (TRUTH[4:], np.concatenate([TRUTH, border])):
        one = compare("lab", found, np.concatenate([TRUTH[4:], border]), uncertain, SIZE)
        assert (one.dots, one.found, one.false) == (31, 31, 0)


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_the_picture_takes_the_dots_along(change: str) -> None:
    changed, matrix = CHANGES[change](render(SIZE, TRUTH, 4.0, noise=1.0))
    expected = TRUTH @ matrix[:, :2].T + matrix[:, 2]
    found = find(changed)
    assert len(found) == len(TRUTH)
    away = np.linalg.norm(found[:, None] - expected, axis=2).min(axis=1)
    assert away.max() < 0.2


def test_a_dot_of_only_one_round_is_uncertain(data: Path) -> None:
    labels = [label(TRUTH[2:].tolist()), label(TRUTH.tolist(), round_=2), label((), frame=1)]
    judged = list(judge(labels, data))
    assert [one.kind for one in judged] == [*CHANGES, ""]
    assert all((one.dots, one.found, one.false) == (33, 33, 0) for one in judged[:-1])
    assert judged[-1].false == 0


def test_the_labels_of_the_package_name_dots_of_many_labs_and_pictures_without() -> None:
    labels = load_labels(DOTS)
    assert len({one.lab for one in labels if one.dots}) >= 15
    assert sum(one.dots == () for one in labels) >= 50


def test_the_command_prints_a_table(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_labels(data / "labels.json", [label(TRUTH.tolist()), label((), frame=1)])
    assert main(["--data", str(data), "--labels", str(data / "labels.json")]) == 0
    printed = capsys.readouterr().out
    assert "simulated" in printed
    assert "100.0 %" in printed
    assert "Pictures without dots: 1, with some found: 0" in printed
