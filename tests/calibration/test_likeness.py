"""The default calibration of a kind of sensor is compared with the pictures of a sensor before it is used."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import tactflow
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration, ScaleEntry, raw_corners, small_picture
from tactflow.calibration.likeness import match_light, place
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale

Picture = NDArray[np.uint8]
SIZE = (320, 240)
PITCH = 2.0
FALL = ((0.0, -0.16, -0.3, -0.3), (0.0, -0.06, -0.25, -0.12), (-0.05, 0.28, -0.6, -0.58))
"""Of blue, green, red: how the logarithm of the light depends on x, y, x^2, y^2, as on a GelSight Mini."""


def gel(zoom: float = 1.0) -> Picture:
    """The untouched gel of a sensor of the kind; zoom : width of its part that the picture shows."""
    y, x = (zoom * part for part in np.mgrid[-1:1:240j, -1:1:320j])
    light = [a * x + b * y + c * x * x + d * y * y for a, b, c, d in FALL]
    return np.asarray(130 * np.exp(np.stack(light, axis=2)), np.uint8)


def with_housing(picture: Picture) -> Picture:
    """The gel in the middle of a picture that also shows its housing."""
    small = cv2.resize(picture, (256, 192), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.copyMakeBorder(small, 24, 24, 32, 32, cv2.BORDER_CONSTANT, value=(60, 190, 20)))


def grid(pitch: float) -> NDArray[np.float64]:
    """(N, 2) px: dots in a square grid."""
    x, y = np.meshgrid(np.arange(20, 310, pitch), np.arange(20, 230, pitch))
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.fixture(scope="module")
def kind() -> Calibration:
    """The default of a kind whose gel is 20 mm wide."""
    mapping = PixelMapping.identity(SIZE)
    scale = Scale(0.0625, 0.0625, (0.003, 0.003), (159.5, 119.5))
    return Calibration(
        sensor="kind",
        kind="test gel",
        dot_pitch=PITCH,
        made_from="a formula",
        raw_size=SIZE,
        size=SIZE,
        corners=raw_corners(mapping),
        scale=ScaleEntry.of(scale, "known"),
        look=small_picture(gel()),
    )


def test_a_sensor_of_the_kind_is_recognised_at_any_exposure_and_white_balance(kind: Calibration) -> None:
    other = np.asarray(gel() * np.array([0.6, 1.1, 0.8]), np.uint8)
    scale, words = place(kind, other, PixelMapping.identity(SIZE))
    assert (scale, words) == (kind.scale, "")


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (gel()[::-1, ::-1], "turned by 180 degrees clockwise, or mirrored upside down"),
        (gel()[::-1], "mirrored upside down: add 180 to stages.preprocess.rotate"),
        (cv2.resize(np.rot90(gel()), SIZE), "turned by 270 degrees clockwise"),
        (gel(0.5), "shows about 0.5 times the width of its gel"),
        (with_housing(gel()), "the housing around the gel; crop it to the sensing area"),
        (gel()[..., ::-1], "another sensor, or something touches it"),
        (gel()[:240, :240], "have another shape"),
    ],
    ids=["turned", "upside down", "turned by 90", "cropped", "uncropped", "other kind", "square"],
)
def test_a_picture_that_the_default_is_not_for_is_refused_with_what_to_do(
    kind: Calibration, picture: Picture, words: str
) -> None:
    height, width = picture.shape[:2]
    found = place(kind, np.ascontiguousarray(picture), PixelMapping.identity((width, height)))
    assert found.scale is None
    assert words in found.words


def test_the_pitch_of_the_dots_gives_the_scale_of_a_zoomed_picture(kind: Calibration) -> None:
    mapping = PixelMapping.identity(SIZE)
    dots = grid(PITCH / (0.72 * kind.scale.x))
    scale, words = place(kind, gel(0.72), mapping, dots)
    assert scale is not None
    assert scale.x == pytest.approx(0.72 * kind.scale.x, rel=1e-3)
    assert scale.stderr[0] == pytest.approx(0.03 * scale.x, rel=1e-2)
    assert "scale by the pitch of the dots, 0.72 times the usual one" in words
    assert place(kind, gel(0.72), mapping).scale is None
    few = place(kind, gel(), mapping, dots[:3])
    assert few.scale == kind.scale


def test_dots_of_another_pitch_than_the_light_says_are_refused(kind: Calibration) -> None:
    found = place(kind, gel(), PixelMapping.identity(SIZE), grid(PITCH / (0.5 * kind.scale.x)))
    assert found.scale is None
    assert "by its dots the picture shows 0.50 times the width of its gel" in found.words


def rest_of(folder: Path) -> Picture:
    """The untouched gel of a recording."""
    names = ("background.png", "000.png", "000.jpg", "reference.jpg")
    path = next(folder / name for name in names if (folder / name).exists())
    picture = cv2.imread(str(path))
    assert picture is not None
    return np.asarray(picture, np.uint8)


MINIS = ("mini_ball_gelslam", "mini_ball_9mm", "gels/mini_box")
OTHERS = (
    "gels/digit_fots",
    "digit_ball",
    "wedge_ball",
    "gels/gelslim_ball",
    "gels/wrs_cam1",
    "gels/thu_real",
)


def test_minis_of_three_labs_have_the_light_of_their_default_and_other_sensors_have_not(
    shared_data: Path,
) -> None:
    known = Calibration.load(KINDS / "mini.yaml")
    for name in MINIS:
        rest = rest_of(shared_data / name)
        found = match_light(known.look, rest)
        assert found.fits, name
        assert 0.85 < found.zoom < 1.15, name
        assert not match_light(known.look, np.ascontiguousarray(rest[::-1, ::-1])).fits, name
    for name in OTHERS:
        assert not match_light(known.look, rest_of(shared_data / name)).fits, name


def as_it_is(picture: Picture) -> Picture:
    return picture


@pytest.mark.parametrize(
    ("change", "crop", "warning"),
    [
        (as_it_is, [32, 24, 256, 192], ""),
        (np.fliplr, [32, 24, 256, 192], "the picture is mirrored"),
        (as_it_is, [96, 72, 128, 96], "it is cropped or zoomed"),
        (as_it_is, None, "the housing around the gel; crop it to the sensing area"),
    ],
    ids=["as it is", "mirrored", "cropped twofold", "uncropped"],
)
def test_a_mini_whose_picture_is_not_as_it_should_be_has_no_depth_and_says_why(
    shared_data: Path,
    caplog: pytest.LogCaptureFixture,
    change: Callable[[Picture], Picture],
    crop: list[int] | None,
    warning: str,
) -> None:
    paths = sorted((shared_data / "mini_ball_4mm").glob("*.png"))[:3]
    pictures = [np.ascontiguousarray(change(np.asarray(cv2.imread(str(path))))) for path in paths]
    with caplog.at_level(logging.WARNING, "tactflow"):
        results = list(
            tactflow.stream("mini_plain", source=pictures, settings={"stages.preprocess.crop": crop})
        )
    assert any(result.depth for result in results) == (not warning)
    assert caplog.text.count("the calibration of a GelSight Mini is not used") == bool(warning)
    assert warning in caplog.text
