from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.judges.judge import OUTLINES, Camera, Judged, every, fitted, interval, judge, main, scatter
from lab.judges.judge import labelled as labelled_frames
from lab.judges.label_file import FrameLabel, load_labels, save_labels
from tactflow.engine.errors import ConfigError
from tactflow.sim import open_scene

FRAMES = (0, 10, 25, 30)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FrameLabel]]:
    """Pictures of a simulated press, and labels with its true outlines; nothing touches in the first two."""
    data = tmp_path_factory.mktemp("data")
    (data / "press").mkdir()
    scene, labels = open_scene("press?frames=60"), []
    for index in FRAMES:
        cv2.imwrite(str(data / "press" / f"{index:03d}.png"), scene.frame(index))
        truth = scene.truth(index)
        labels.append(
            FrameLabel(
                recording="press",
                frame=f"{index:03d}",
                reference="000",
                lab="simulated",
                contact=truth.touching,
                outlines=[truth.hull.tolist()] if truth.touching else [],
            )
        )
    return data, labels


def test_true_outlines_are_found(labelled: tuple[Path, list[FrameLabel]]) -> None:
    data, labels = labelled
    judged = list(judge("default", labels, data))
    assert [one.touched for one in judged] == [label.contact for label in labels]
    for one in judged:
        assert one.found == one.touched
        assert np.isnan(one.hull) == (not one.touched)
        if one.touched:
            assert one.hull > 0.9
            assert one.region > 0.85
            assert one.center < 1
            assert 0.85 < one.area < 1.15


def test_true_outlines_are_found_without_colours(labelled: tuple[Path, list[FrameLabel]]) -> None:
    data, labels = labelled
    judged = list(judge("default", labels, data, camera=Camera(gray=True)))
    assert [one.found for one in judged] == [label.contact for label in labels]
    coloured = list(judge("default", labels, data))
    for one, other in zip(judged, coloured, strict=True):
        assert not one.touched or 0.8 < one.hull < other.hull


def test_dirt_lies_on_the_lens_after_the_reference(labelled: tuple[Path, list[FrameLabel]]) -> None:
    data, labels = labelled
    camera = Camera(specks=3)
    pictures = {}
    for kind in (Camera(), camera):
        results = labelled_frames("default", labels, data, images=True, camera=kind)
        pictures[kind] = [np.asarray(result.image, int) for _, result in results if result is not None]
    assert len(pictures[camera]) == len(labels)
    for clean, dirty in zip(*pictures.values(), strict=True):
        assert (dirty <= clean).all()
        assert (clean - dirty).max() > 40
    for one, label in zip(judge("default", labels, data, camera=camera), labels, strict=True):
        assert one.found == label.contact
        assert not one.touched or one.hull > 0.9


def test_every_other_label_of_each_lab() -> None:
    labels = [
        FrameLabel(recording=lab, frame=frame, reference=0, lab=lab, contact=False)
        for frame in range(3)
        for lab in "ab"
    ]
    assert [(label.lab, label.frame) for label in every(labels, 2)] == [
        ("a", 0),
        ("a", 2),
        ("b", 0),
        ("b", 2),
    ]


def test_frames_that_a_failing_pipeline_does_not_reach_are_missed(
    labelled: tuple[Path, list[FrameLabel]], tmp_path: Path
) -> None:
    labels = labelled[1]
    plain = tmp_path / "plain"
    plain.mkdir()
    for label in labels:
        cv2.imwrite(str(plain / f"{label.frame}.png"), np.full((600, 800, 3), 120, np.uint8))
    said: list[str] = []
    elsewhere = [label.model_copy(update={"recording": "plain"}) for label in labels]
    absent = [label.model_copy(update={"recording": "absent"}) for label in labels]
    judged = list(judge("default", [*elsewhere, *absent], tmp_path, said.append))
    assert [(one.recording, one.found, one.hull) for one in judged] == [("plain", False, 0.0)] * len(labels)
    assert len(said) == 2
    assert said[0].startswith("absent: not in")
    assert "markerless" in said[1]


def test_a_wrong_pipeline_is_refused_and_not_judged(
    labelled: tuple[Path, list[FrameLabel]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, labels = labelled
    save_labels(tmp_path / "mine.json", labels)
    assert main(["nosuch", "--data", str(data), "--labels", str(tmp_path / "mine.json")]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("tactflow: there is no file nosuch")


def test_labels_of_frames_that_cannot_be_there_are_refused(
    labelled: tuple[Path, list[FrameLabel]], tmp_path: Path
) -> None:
    data, labels = labelled
    with pytest.raises(ConfigError, match="no picture of that name"):
        list(judge("default", [labels[0].model_copy(update={"frame": "999"})], data))
    np.save(tmp_path / "press.npy", np.zeros((2, 60, 80, 3), np.uint8))
    with pytest.raises(ConfigError, match="required an index"):
        list(judge("default", [labels[0].model_copy(update={"recording": "press.npy"})], tmp_path))


def test_frames_of_one_recording_do_not_make_a_median_surer() -> None:
    generator = np.random.default_rng(1)
    one = Judged("a", "", touched=True, found=True)
    values = generator.uniform(0.5, 1.0, 12).tolist()
    apart = [replace(one, recording=str(number), hull=value) for number, value in enumerate(values)]
    repeated = [judged for judged in apart for _ in range(20)]
    low, high = interval(apart)
    assert 0.5 < low < np.median(values) < high < 1
    assert interval(repeated) == pytest.approx((low, high), abs=0.03)


def test_scatter_is_the_overlap_of_two_rounds() -> None:
    square = [(10.0, 10.0), (29.0, 10.0), (29.0, 29.0), (10.0, 29.0)]
    first = FrameLabel(recording="a", frame=1, reference=0, contact=True, outlines=[square])
    moved = [(x + 10, y) for x, y in square]
    again = first.model_copy(update={"round": 2, "outlines": (tuple(moved),)})
    assert scatter([first, again]) == [pytest.approx(1 / 3)]
    assert scatter([first]) == []


def test_the_command_prints_a_row_for_each_lab(
    labelled: tuple[Path, list[FrameLabel]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, labels = labelled
    save_labels(tmp_path / "mine.json", labels)
    assert main(["default", "wedge", "--data", str(data), "--labels", str(tmp_path / "mine.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if line][:4] == ["default", "lab", "simulated", "all"]


def test_a_folder_without_the_recordings_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--data", str(tmp_path)]) == 2
    assert "has none of the recordings" in capsys.readouterr().err
    (tmp_path / "labels.json").write_text(json.dumps([{"recording": "a"}]))
    assert main(["--data", str(tmp_path), "--labels", str(tmp_path / "labels.json")]) == 2
    assert "entry 1" in capsys.readouterr().err


def test_the_labels_of_the_package_are_enough_to_judge_by() -> None:
    labels = load_labels(OUTLINES)
    first = [label for label in labels if label.round == 1]
    assert sum(bool(label.outlines) for label in first) >= 150
    assert sum(label.contact is False for label in first) >= 150
    overlaps = scatter(labels)
    assert len(overlaps) == 40
    assert np.median(overlaps) > 0.85


def test_outlines_of_real_gels_are_found(shared_data: Path) -> None:
    first = [label for label in load_labels(OUTLINES) if label.round == 1]
    some = [label for label in first if label.recording in ("gels/thu_real", "mini_ball_gelslam")]
    judged = list(judge("default", some, shared_data))
    assert len(judged) == 37
    assert all(one.found for one in judged)
    assert np.median([one.hull for one in judged]) > 0.65


def test_the_worst_frames_are_drawn(labelled: tuple[Path, list[FrameLabel]], tmp_path: Path) -> None:
    data, labels = labelled
    save_labels(tmp_path / "labels.json", labels)
    words = ["--data", str(data), "--labels", str(tmp_path / "labels.json"), "--picture"]
    assert main([*words, str(tmp_path / "worst.png")]) == 0
    picture = cv2.imread(str(tmp_path / "worst.png"))
    assert picture is not None
    assert picture.shape == (240, 5 * 240, 3)
    drawn = (picture == (0, 255, 0)).all(axis=2).any(axis=0).reshape(5, 240).any(axis=1)
    assert drawn.sum() == sum(bool(label.outlines) for label in labels) > 1
    assert main([*words, str(tmp_path / "blank.png"), "--blank"]) == 0
    blank = cv2.imread(str(tmp_path / "blank.png"))
    assert blank is not None
    assert ((blank == (0, 255, 0)).all(axis=2) == (picture == (0, 255, 0)).all(axis=2)).all()
    assert main([*words, str(tmp_path / "no" / "worst.png")]) == 2


def test_the_setting_that_is_best_on_every_second_outline_is_judged_on_the_others() -> None:
    def judged(*overlaps: float) -> list[Judged]:
        return [Judged("one", "press", True, True, hull=overlap) for overlap in overlaps]

    lines = list(fitted({"a": judged(0.5, 0.6, 0.5, 0.6), "b": judged(0.9, 0.7, 0.9, 0.7)}))
    assert lines[1].split() == ["one", "2", "b", "0.60", "0.70"]
    assert lines[2].split() == ["all", "2", "0.60", "0.70"]
