"""Parameters out of range, and unknown ones, are refused before anything starts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import tactflow

WEDGE = {
    "from": [[33, 58], [208, 61], [56, 250], [185, 244]],
    "to": [[0, 0], [240, 0], [0, 320], [240, 320]],
    "size": [240, 320],
}
WRONG: dict[str, list[dict[str, Any]]] = {
    "capture": [
        *({"reference": value} for value in (0, -3, True, "", 1.5, None)),
        *({"source": None}, {"source": True}, {"skip": -1}, {"width": 0}, {"fps": 0.0}),
        *({"fps": float("inf")}, {"format": "MJPEG"}, {"sauce": "sim:press"}),
    ],
    "preprocess": [
        *({"rotate": 45}, {"downsample": 3}, {"method": "cubic"}, {"crop": [0, 0, 10]}, {"rotation": 90}),
        *({"crop": [-1, 0, 10, 10]}, {"homography": {**WEDGE, "size": [0, 320]}}),
        *({"homography": {**WEDGE, "from": WEDGE["from"][:3]}},),
        *({"homography": {**WEDGE, "from": [[0, 0], [1, 1], [2, 2], [0, 5]]}},),
        *({"undistort": {"camera_matrix": np.eye(3).tolist()}},),
        *({"undistort": {"camera_matrix": [[1]], "distortion": [0, 0, 0, 0]}},),
        *({"undistort": {"camera_matrix": np.eye(3).tolist(), "distortion": [0, 0, 0]}},),
    ],
    "marker_mask": [{"dot": 0}, {"dot": "big"}, {"contrast": 300}, {"polarity": "green"}],
    "inpaint": [{"method": "magic"}, {"radius": 0}],
    "difference": [
        *(
            {"false_alarms": 0},
            {"repeatability": 2},
            {"relaxation": 1},
            {"tint": 2},
            {"creep": -1},
            {"border": 1},
            {"core": 0},
        ),
        *({"method": "magic"}, {"edge": 1}),
    ],
    "hull": [
        *({"min_area": -1}, {"merge": "near"}, {"min_aera": 3}),
    ],
    "tracker": [{"dot": 0.2}, {"polarity": "red"}, {"max_displacement": 0}],
    "flow_in_mask": [{"method": "mode"}],
    "visualize": [{"arrow_scale": -1}, {"view": "x"}, {"arrows": 3}, {"deepest": 0}],
}


@pytest.mark.parametrize(("stage", "wrong"), [(stage, wrong) for stage in WRONG for wrong in WRONG[stage]])
def test_a_wrong_parameter_is_refused_by_name(stage: str, wrong: dict[str, Any]) -> None:
    with pytest.raises(tactflow.ConfigError, match="|".join(wrong)):
        tactflow.stage(stage, **wrong)
