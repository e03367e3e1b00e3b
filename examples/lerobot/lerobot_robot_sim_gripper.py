"""A simulated gripper with two fingers, and its leader, to try tactile sensors in LeRobot without a robot.

    pip install . ./plugins/lerobot/camera ./examples/lerobot
    lerobot-record --robot.type=sim_gripper --teleop.type=sim_leader \
        --robot.cameras='{left: {type: tactflow, source: "sim:press", width: 300, height: 400, fps: 30}}' ...

Its fingers follow the leader at once and touch nothing: what the sensors see does not depend on them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

JOINTS = ("left.pos", "right.pos")
"""Names of the joints: distance of each finger from the middle, mm."""
OPEN_MM = 40.0
"""Distance at which the leader begins, mm: that of common parallel grippers."""


@RobotConfig.register_subclass("sim_gripper")
@dataclass
class SimGripperConfig(RobotConfig):
    """The gripper. `cameras` are those of its fingers."""

    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class SimGripper(Robot):
    """A gripper whose fingers are where they were last sent."""

    config_class = SimGripperConfig
    name = "sim_gripper"

    def __init__(self, config: SimGripperConfig) -> None:
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)
        self._positions = dict.fromkeys(JOINTS, OPEN_MM)
        self._is_connected = False

    @property
    def observation_features(self) -> dict[str, Any]:
        """The joints, and the pictures of the cameras."""
        pictures = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**dict.fromkeys(JOINTS, float), **pictures}

    @property
    def action_features(self) -> dict[str, Any]:
        """The joints."""
        return dict.fromkeys(JOINTS, float)

    @property
    def is_connected(self) -> bool:
        """Whether all cameras run."""
        return self._is_connected

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - there is nothing to calibrate
        """Start the cameras."""
        for camera in self.cameras.values():
            camera.connect()
        self._is_connected = True

    is_calibrated = True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        """The joints, and the next picture of each camera."""
        return self._positions | {name: camera.read() for name, camera in self.cameras.items()}

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Move the fingers."""
        self._positions = {name: float(action[name]) for name in JOINTS}
        return action

    @check_if_not_connected
    def disconnect(self) -> None:
        """Stop the cameras."""
        self._is_connected = False
        for camera in self.cameras.values():
            camera.disconnect()


@TeleoperatorConfig.register_subclass("sim_leader")
@dataclass
class SimLeaderConfig(TeleoperatorConfig):
    """The leader. `period_s` is how long closing and opening take together."""

    period_s: float = 2.0


class SimLeader(Teleoperator):
    """A leader that closes and opens all the time."""

    config_class = SimLeaderConfig
    name = "sim_leader"

    def __init__(self, config: SimLeaderConfig) -> None:
        super().__init__(config)
        self.config = config
        self._begin: float | None = None

    @property
    def action_features(self) -> dict[str, Any]:
        """The joints."""
        return dict.fromkeys(JOINTS, float)

    feedback_features: dict[str, Any] = {}  # noqa: RUF012 - as in the base class
    is_calibrated = True

    @property
    def is_connected(self) -> bool:
        """Whether it moves."""
        return self._begin is not None

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - there is nothing to calibrate
        """Begin to close."""
        self._begin = time.monotonic()

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    @check_if_not_connected
    def get_action(self) -> dict[str, Any]:
        """Where the fingers are now."""
        assert self._begin is not None
        phase = (time.monotonic() - self._begin) / self.config.period_s % 1.0
        return dict.fromkeys(JOINTS, OPEN_MM * abs(2.0 * phase - 1.0))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    @check_if_not_connected
    def disconnect(self) -> None:
        """Stop."""
        self._begin = None
