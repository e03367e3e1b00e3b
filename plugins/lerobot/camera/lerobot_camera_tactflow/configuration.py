"""Settings of the camera."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from lerobot.cameras.configs import CameraConfig, ColorMode


class Output(StrEnum):
    """What the camera returns; (H, W) is the size of the processed frame.

    Attributes
    ----------
    image : (H, W, 3) uint8, the processed frame.
    difference : (H, W, 3) uint8, 128 + half of the change against the untouched gel, without its dots.
    depth : (H, W, 3) uint8, grey, depth of the indentation: `depth_mm` or more is 255.
    markers : (N, 5) float32: x, y of each marker in the reference frame and its displacement dx, dy, px, and
        its status: 0 tracked, 1 inferred, 2 lost.
    """

    IMAGE = "image"
    DIFFERENCE = "difference"
    DEPTH = "depth"
    MARKERS = "markers"


@CameraConfig.register_subclass("tactflow")
@dataclass
class TactflowCameraConfig(CameraConfig):
    """A tactile sensor; `width` and `height`, if set, must be those of the output.

    Cameras with the same source, pipeline, settings and pace share one run, so that a sensor can have several
    outputs.

    Attributes
    ----------
    source : as for `tactflow run --source`: a camera, a recording, `sim:press`.
    pipeline : a file, or the name of a shipped pipeline such as "mini"; None is tactflow's default.
    output : what the camera returns, see `Output`.
    settings : overrides of the pipeline file, such as `{"calibration": "left.yaml"}`.
    color_mode : order of the colors of `image` and `difference`.
    depth_mm : depth that becomes 255, mm; a smaller one gives finer steps.
    realtime : play a recording at its own pace, like a camera. Otherwise the next frame waits until all
        cameras have read the last one, and no frame is dropped.
    timeout_s : longest wait for the first frame, s; a camera needs some seconds, a loaded computer more.
    """

    source: str
    pipeline: str | None = None
    output: Output = Output.IMAGE
    settings: dict[str, Any] = field(default_factory=dict)
    color_mode: ColorMode = ColorMode.RGB
    depth_mm: float = 2.0
    realtime: bool = True
    timeout_s: float = 120.0

    def __post_init__(self) -> None:
        self.output = Output(self.output)
        self.color_mode = ColorMode(self.color_mode)
        for name in ("depth_mm", "timeout_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"`{name}` must be positive, but {getattr(self, name)} is provided.")
        if not self.source:
            raise ValueError("`source` cannot be empty.")

    @property
    def run_key(self) -> str:
        """Equal for cameras that share a run."""
        return json.dumps([self.source, self.pipeline, self.settings, self.realtime], sort_keys=True)
