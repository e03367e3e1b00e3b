"""Stage `preprocess`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.engine.frame import Frame
from tactflow.stages.preprocess import Preprocess

WEDGE = {
    "from": [[33, 58], [208, 61], [56, 250], [185, 244]],
    "to": [[0, 0], [240, 0], [0, 320], [240, 320]],
    "size": [240, 320],
}


def stage(**params: Any) -> Preprocess:
    return Preprocess(Preprocess.Params.model_validate(params))


def frame(width: int = 80, height: int = 60, seed: int = 0) -> Frame:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    image.flags.writeable = False
    return Frame("main", 0, 0.0, image)


def test_every_parameter_reaches_the_mapping() -> None:
    result = stage(
        rotate=270,
        downsample=2,
        crop=[10, 20, 200, 280],
        homography=WEDGE,
        undistort={"camera_matrix": [[300, 0, 120], [0, 300, 160], [0, 0, 1]], "distortion": [0.1, 0, 0, 0]},
    ).process(frame(240, 320))
    assert result.mapping.size == (140, 100)
    assert result.image.shape == (100, 140, 3)
    assert result.mapping.lens is not None


def test_a_real_wedge_is_rectified_to_the_full_picture(shared_data: Path) -> None:
    image = cv2.imread(str(shared_data / "wedge_ball" / "reference.jpg"))
    assert image is not None
    result = stage(homography=WEDGE).process(Frame("main", 0, 0.0, np.asarray(image, np.uint8)))
    assert result.image.shape == (320, 240, 3)
    np.testing.assert_allclose(result.mapping.to_processed(WEDGE["from"]), WEDGE["to"], atol=1e-9)
    # The four points lie on the gel, so no part of the result is outside the raw frame, where it is black.
    assert result.image.max(axis=2).min() > 0


@pytest.mark.parametrize(
    ("params", "told"),
    [
        (
            {"crop": [0, 0, 40, 20]},
            "80 x 60 becomes 40 x 20 by crop: stages.preprocess",
        ),
        (
            {"crop": [0, 0, 40, 20], "rotate": 180, "downsample": 4},
            "80 x 60 becomes 10 x 5 by crop, downsample and rotate: stages.preprocess; "
            "dots may be lost: try downsample: 1",
        ),
        ({}, None),
    ],
)
def test_what_becomes_of_the_picture_is_told_once(
    params: dict[str, Any], told: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    preprocess = stage(**params)
    image = np.zeros((60, 80, 3), np.uint8)
    with caplog.at_level("INFO", "tactflow"):
        for seq in range(2):
            preprocess.process(Frame("main", seq, 0.0, image))
    assert [record.getMessage() for record in caplog.records] == ([told] if told else [])
