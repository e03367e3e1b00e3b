"""The camera: an output of a tactflow pipeline, as LeRobot reads cameras."""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import ColorMode
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError
from numpy.typing import NDArray

from lerobot_camera_tactflow.configuration import Output, TactflowCameraConfig
from lerobot_camera_tactflow.run import SharedRun
from tactflow import Result, TactflowError

logger = logging.getLogger(__name__)

READ_TIMEOUT_MS = 10_000
"""Longest wait of `read` for a frame, ms: that of LeRobot's own cameras."""
UNCHANGED_GREY = 128
"""Grey level of `difference` where nothing has changed."""


class TactflowCamera(Camera):
    """One output of a tactile sensor.

    `result` is tactflow's result of the frame that was returned last, or None; `result.t` is its capture
    time. After `connect`, `height` and `width` are the first two lengths of what is returned.

    >>> camera = TactflowCamera(TactflowCameraConfig(source="sim:press", output="markers"))
    >>> with camera:
    ...     markers = camera.async_read()
    >>> markers.shape
    (80, 5)
    """

    def __init__(self, config: TactflowCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.result: Result | None = None
        self._run: SharedRun | None = None
        # A key for the shared run that does not keep this camera alive: it disconnects when it is deleted.
        self._reader = object()
        self._shape: tuple[int, ...] = ()
        self._origins: NDArray[np.float64] | None = None

    def __str__(self) -> str:
        return f"{type(self).__name__}({self.config.source}, {self.config.output.value})"

    @property
    def is_connected(self) -> bool:
        """Whether the pipeline runs for this camera."""
        return self._run is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The cameras of this machine; use `id` as `source`."""
        from tactflow.sources.cameras import list_cameras

        return [
            {"name": camera.name or camera.device, "type": "tactflow"} | {"id": camera.source}
            for camera in list_cameras()
        ]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Start the pipeline, and wait for its first frame if `warmup`, or if width or height are not set.

        Raises
        ------
        ConnectionError : the source cannot be opened, the pipeline is invalid or lacks what the output needs,
            or no frame arrived in time. DeviceAlreadyConnectedError : it is connected already.
        """
        try:
            self._run, self._origins = SharedRun.join(self.config, self._reader), None
            if warmup or self.width is None or self.height is None:
                self._check_first_frame()
        except (RuntimeError, TactflowError, TimeoutError, ValueError) as error:
            self._leave()
            raise ConnectionError(f"Failed to connect to {self}: {error}") from error
        except BaseException:
            self._leave()
            raise
        logger.info("%s connected.", self)

    def _check_first_frame(self) -> None:
        """Determine the shape of the output. The next read returns this frame, too."""
        assert self._run is not None
        result = self._run.peek(self.config.timeout_s)
        if result is None:
            raise TimeoutError(f"no frame arrived within {self.config.timeout_s:g} s")
        shape = self._output(result).shape
        for name, wanted, given in (("height", self.height, shape[0]), ("width", self.width, shape[1])):
            if wanted not in (None, given):
                raise ValueError(f"{name}={wanted} is configured, but the pipeline gives {given}")
        self._shape, (self.height, self.width) = shape, shape[:2]

    @check_if_not_connected
    def read(self) -> NDArray[Any]:
        """Return the next frame, as `async_read` with a timeout of ten seconds."""
        return self.async_read(READ_TIMEOUT_MS)

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """Return the newest frame that this camera has not returned yet, in the shape given by `Output`.

        Raises
        ------
        DeviceNotConnectedError : before `connect`. TimeoutError : no frame arrived in time.
        RuntimeError : the source has ended, a stage failed, or the shape is not that of the first frame.
        """
        assert self._run is not None
        try:
            result = self._run.read(self._reader, timeout_ms / 1000)
        except RuntimeError as error:
            raise RuntimeError(f"{self} read thread is not running: {error}") from error
        if result is None:
            raise TimeoutError(f"{self} async_read timeout after {timeout_ms}ms")
        return self._returned(result)

    @check_if_not_connected
    def read_latest(self, max_age_ms: int = 500) -> NDArray[Any]:
        """Return the newest frame immediately, even if it was returned before.

        Raises
        ------
        DeviceNotConnectedError : before `connect`. TimeoutError : it is older than `max_age_ms`.
        RuntimeError : there is none yet.
        """
        assert self._run is not None
        with self._run.changed:
            result, arrived = self._run.latest, self._run.arrived
        if result is None:
            raise RuntimeError(f"{self} has not captured any frames yet.")
        age_ms = (time.monotonic() - arrived) * 1e3
        if age_ms > max_age_ms:
            raise TimeoutError(
                f"{self} latest frame is too old: {age_ms:.1f} ms (max allowed: {max_age_ms} ms)."
            )
        return self._returned(result)

    def disconnect(self) -> None:
        """Stop the pipeline unless other cameras use it. Raises DeviceNotConnectedError before `connect`."""
        if self._run is None:
            raise DeviceNotConnectedError(f"{self} not connected.")
        self._leave()
        logger.info("%s disconnected.", self)

    def _leave(self) -> None:
        run, self._run = self._run, None
        if run is not None:
            run.leave(self._reader)

    def _returned(self, result: Result) -> NDArray[Any]:
        output = self._output(result)
        if self._shape and output.shape != self._shape:
            raise RuntimeError(f"{self}: shape {output.shape}, but the first frame had {self._shape}")
        self.result = result
        return output

    def _output(self, result: Result) -> NDArray[Any]:
        """The configured output of a result. Raises ValueError if the pipeline does not compute it."""
        match self.config.output:
            case Output.IMAGE:
                return self._in_order(_required(result, "image", "a stage preprocess"))
            case Output.DIFFERENCE:
                unmarked = _required(result, "unmarked", "a stage inpaint").astype(np.int16)
                change = unmarked - _required(result, "untouched", "a stage untouched")
                return self._in_order((UNCHANGED_GREY + change // 2).clip(0, 255).astype(np.uint8))
            case Output.DEPTH:
                _required(result, "scale", "a stage scale, and settings with a calibration")
                heights = np.zeros(result.size[::-1]) if result.depth is None else result.depth.heights
                grey = np.rint(heights * (255 / self.config.depth_mm)).clip(0, 255).astype(np.uint8)
                return np.repeat(grey[:, :, None], 3, 2)
            case Output.MARKERS:
                markers = _required(result, "markers", "a stage tracker")
                columns = [markers.origin, markers.displacement, markers.status[:, None]]
                if self._origins is None:
                    self._origins = markers.origin.copy()
                # A dataset has a fixed shape, so leave out markers that were added after the first frame.
                count = len(self._origins)
                was_extended = np.array_equal(markers.origin[:count], self._origins)
                return np.hstack(columns).astype(np.float32)[: count if was_extended else None]

    def _in_order(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A writable copy (H, W, 3), in the configured order of colors."""
        rgb = self.config.color_mode is ColorMode.RGB
        return np.ascontiguousarray(image[:, :, ::-1]) if rgb else image.copy()


def _required(result: Result, port: str, source: str) -> Any:
    value = result.value(port)
    if value is None:
        raise ValueError(f"the pipeline gives no {port}: it needs {source}")
    return value
