"""The calibration file: written, read, checked against the frames, refused where it does not fit."""

from __future__ import annotations

import errno
import logging
from pathlib import Path

import numpy as np
import pytest
import yaml

import tactflow
from tactflow.calibration import KINDS, kinds
from tactflow.calibration.file import Calibration, ScaleEntry, raw_corners, small_picture
from tactflow.engine.errors import ConfigError, StageError
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

MAPPING = Preprocessor((800, 600), rotate=90, downsample=2).mapping
GEL = np.full((400, 300, 3), (90, 120, 100), np.uint8)
CALIBRATION = Calibration(
    sensor="left",
    made_from="sim:press",
    raw_size=(800, 600),
    size=(300, 400),
    corners=raw_corners(MAPPING),
    look=small_picture(GEL),
    scale=ScaleEntry.of(Scale(0.05, 0.06, (0.001, 0.002), (149.5, 199.5)), "pitch"),
)
PIPELINE = """
sensor: left
calibration: left.yaml
stages:
  capture: {source: "sim:press?frames=40"}
  preprocess: {rotate: 90, downsample: 2}
  marker_mask:
  inpaint:
  difference:
  untouched:
  scale:
  hull: {when: touching}
"""


@pytest.fixture
def pipeline(tmp_path: Path) -> Path:
    """A pipeline file with its calibration beside it."""
    first = next(tactflow.stream(source="sim:press?frames=40", max_frames=1, images=True))
    assert first.image is not None
    CALIBRATION.model_copy(update={"look": small_picture(first.image)}).save(tmp_path / "left.yaml")
    path = tmp_path / "pipeline.yaml"
    path.write_text(PIPELINE)
    return path


def test_a_file_reads_back_as_it_was_written(tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "a" / "left.yaml")
    found = Calibration.load(tmp_path / "a" / "left.yaml")
    assert found.scale == CALIBRATION.scale
    assert (found.sensor, found.made_from, found.size) == ("left", "sim:press", (300, 400))
    assert found.corners == CALIBRATION.corners
    assert found.made


def test_a_pipeline_gives_millimetres_with_it_and_none_without(pipeline: Path) -> None:
    result = next(r for r in tactflow.stream(pipeline) if r.contact is not None)
    assert result.scale is not None
    assert result.contact is not None
    x, y = result.contact.center
    assert result.scale.point((x, y)) == pytest.approx(((x - 149.5) * 0.05, (y - 199.5) * 0.06))
    plain = tactflow.stream(pipeline, settings={"calibration": None})
    assert next(r for r in plain if r.contact is not None).scale is None


def test_a_calibration_that_no_stage_uses_is_warned_of(pipeline: Path) -> None:
    assert not any("no stage uses it" in warning for warning in tactflow.load(pipeline).warnings)
    loaded = tactflow.load(pipeline, settings={"stages.scale": None})
    assert any("calibration: no stage uses it" in warning for warning in loaded.warnings)


@pytest.mark.parametrize(
    ("setting", "words"),
    [("rotate: 270", "raw px elsewhere"), ("downsample: 4", "gave 300 x 400 px; here it gives 150 x 200 px")],
)
def test_frames_of_another_preprocess_end_the_run_with_the_numbers(
    pipeline: Path, setting: str, words: str
) -> None:
    name, value = setting.split(": ")
    with pytest.raises(StageError, match=words):
        list(tactflow.stream(pipeline, settings={f"stages.preprocess.{name}": int(value)}))


def test_a_gel_that_looks_unlike_is_warned_of_with_the_numbers(
    pipeline: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "tactflow"):
        list(tactflow.stream(pipeline, max_frames=3))
    assert not caplog.records
    with caplog.at_level(logging.WARNING, "tactflow"):
        list(tactflow.stream(pipeline, source="sim:round_gel", max_frames=3))
    assert "differs by" in caplog.text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "other/1"}, "format"),
        ({"scale": {"mm_per_pixel": [0.0, 1.0]}}, "greater than 0"),
        ({"scale": {"mm_per_pixel": [0.1]}}, "scale"),
        ({"colour": 1}, "colour"),
        ({"corners": [[0.0, 0.0], [1.0], [0.0, 1.0], [1.0, 1.0]]}, "corners.1"),
        ({"made": "x" * (1 << 18)}, "larger than 128 KiB"),
        *((text, "is not a calibration file; make a new") for text in ("", "- 1", "press", "a: 3", PIPELINE)),
        ("[" * 5000, "make a new one"),
    ],
)
def test_a_file_that_is_not_a_calibration_is_refused(
    tmp_path: Path, change: dict[str, object] | str, words: str
) -> None:
    path = tmp_path / "left.yaml"
    CALIBRATION.save(path)
    text = change if isinstance(change, str) else yaml.safe_dump(yaml.safe_load(path.read_text()) | change)
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        Calibration.load(path)


def test_a_calibration_that_cannot_be_written_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "left.yaml"
    CALIBRATION.save(path)

    def full(file: Path, **_: object) -> None:
        file.write_bytes(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(ConfigError, match="No space left"):
        CALIBRATION.model_copy(update={"sensor": "right"}).save(path)
    assert Calibration.load(path).sensor == "left"
    assert len(list(tmp_path.iterdir())) == 2


def test_the_password_of_a_camera_is_not_kept(tmp_path: Path) -> None:
    address = "rtsp://me:secret@camera/1?pwd=secret"
    CALIBRATION.model_copy(update={"made_from": address}).save(tmp_path / "left.yaml")
    assert "secret" not in (tmp_path / "left.yaml").read_text()


@pytest.fixture
def recording(pipeline: Path) -> Path:
    """A recording that was made with the calibration."""
    pytest.importorskip("mcap")
    path = pipeline.with_name("press.mcap")
    tactflow.run(pipeline, settings={"sinks": {"record": {"path": str(path)}}}, max_frames=3)
    return path


@pytest.mark.parametrize("own", ["", "calibration: mini"])
def test_playing_a_recording_uses_its_calibration_where_the_pipeline_has_none_or_a_default(
    own: str, recording: Path, tmp_path: Path
) -> None:
    plain = tmp_path / "plain.yaml"
    plain.write_text(PIPELINE.replace("calibration: left.yaml", own))
    assert {r.scale for r in tactflow.stream(plain, source=str(recording))} == {CALIBRATION.scale}
    assert Calibration.load(recording).scale == CALIBRATION.scale
    without = tactflow.stream(plain, source=str(recording), settings={"calibration": None})
    assert {r.scale for r in without} == {None}


def test_a_recorded_calibration_of_other_frames_is_left_out_with_a_warning(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    plain = tmp_path / "plain.yaml"
    plain.write_text(PIPELINE.replace("calibration: left.yaml", "").replace("rotate: 90", "rotate: 270"))
    with caplog.at_level(logging.WARNING, "tactflow"):
        results = list(tactflow.stream(plain, source=str(recording)))
    assert {result.scale for result in results} == {None}
    assert caplog.text.count("is not used") == 1


def of_a_kind(calibration: Calibration) -> Calibration:
    """The calibration as the default of a kind of sensor, with lengths to 5 %."""
    entry = calibration.scale_entry
    stderr = tuple(0.05 * value for value in entry.mm_per_pixel)
    wider = entry.model_copy(update={"stderr": stderr})
    return calibration.model_copy(update={"kind": "test gel", "scale_entry": wider})


def test_a_default_of_a_kind_is_for_frames_of_its_shape_in_any_size(tmp_path: Path) -> None:
    of_a_kind(CALIBRATION).save(tmp_path / "kind.yaml")
    kind = Calibration.load(tmp_path / "kind.yaml")
    half = Preprocessor((400, 300), rotate=90, downsample=2).mapping
    assert kind.misfit(MAPPING) is kind.misfit(half) is None
    scale = kind.scale_at((150, 200))
    assert (scale.x, scale.y, scale.origin) == (0.1, 0.12, (74.5, 99.5))
    assert scale.stderr == pytest.approx((0.1 * 0.05, 0.12 * 0.05))
    assert "have another shape" in str(kind.misfit(Preprocessor((800, 600), downsample=2).mapping))
    assert "turned or mirrored" in str(
        kind.misfit(Preprocessor((800, 600), rotate=270, downsample=2).mapping)
    )


def test_a_default_of_a_kind_says_once_that_it_is_one_and_is_left_out_for_another_gel(
    pipeline: Path, caplog: pytest.LogCaptureFixture
) -> None:
    known = Calibration.load(pipeline.with_name("left.yaml"))
    of_a_kind(known).save(pipeline.with_name("left.yaml"))
    with caplog.at_level(logging.INFO, "tactflow"):
        results = list(tactflow.stream(pipeline))
    assert all(result.scale for result in results)
    assert caplog.text.count("default calibration of a test gel: lengths +- 5 %") == 1
    assert "tactflow calibrate --refine" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING, "tactflow"):
        results = list(tactflow.stream(pipeline, settings={"stages.preprocess.rotate": 270}))
    assert {result.scale for result in results} == {None}
    assert caplog.text.count("the calibration of a test gel is not used: the frames are turned") == 1
    with caplog.at_level(logging.WARNING, "tactflow"):
        results = list(tactflow.stream(pipeline, source="sim:round_gel", max_frames=3))
    assert {result.scale for result in results} == {None}
    assert "the light of the untouched gel differs from that of one by" in caplog.text


@pytest.mark.parametrize("kind", kinds())
def test_the_shipped_defaults_say_what_they_are_made_from_and_how_far_off_they_are(kind: str) -> None:
    known = Calibration.load(KINDS / f"{kind}.yaml")
    assert known.kind is not None
    assert "MIT" in known.made_from
    assert known.scale.stderr[0] == pytest.approx(0.05 * known.scale.x)
    if known.photometric is None:
        assert known.slopes is None
        return
    assert known.slopes is not None
    assert known.information is not None
    assert np.linalg.eigvalsh(known.information).min() > -1e-3
    errors = known.photometric.errors()
    assert 0.5 * known.photometric.depth_stderr < errors.between < known.photometric.depth_stderr < 0.25


def test_a_default_for_other_frames_knows_their_scale_and_their_part_of_the_gel() -> None:
    known = Calibration.load(KINDS / "mini.yaml")
    usual = known.scale_at((640, 480))
    half = known.at(Scale(usual.x / 2, usual.y / 2, (0.001, 0.001), usual.origin), (640, 480))
    assert half.scale_at((640, 480)).x == pytest.approx(usual.x / 2)
    assert half.scale.stderr[0] == pytest.approx(0.002)
    assert known.slopes is not None
    assert half.slopes is not None
    # Terms of the place: 1, x, y, x^2, x y, y^2.
    ratio = half.slopes.coefficients[:, 0, 0] / known.slopes.coefficients[:, 0, 0]
    assert ratio.tolist() == pytest.approx([1, 0.5, 0.5, 0.25, 0.25, 0.25])
    assert known.at(usual, (640, 480)) is known


def test_a_file_without_its_arrays_or_with_broken_ones_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "left.yaml"
    CALIBRATION.save(path)
    path.with_suffix(".npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(ConfigError, match="make a new one"):
        Calibration.load(path)
    np.savez_compressed(path.with_suffix(".npz"), look=np.zeros(2 << 20, np.uint8))
    with pytest.raises(ConfigError, match="unpack to more than 1 MiB"):
        Calibration.load(path)
    path.with_suffix(".npz").unlink()
    with pytest.raises(ConfigError, match=r"left\.npz"):
        Calibration.load(path)
