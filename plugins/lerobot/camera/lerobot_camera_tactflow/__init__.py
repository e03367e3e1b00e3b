"""A tactile sensor as a camera of LeRobot: `cameras="{gel: {type: tactflow, source: /dev/video0}}"`."""

from lerobot_camera_tactflow.camera import TactflowCamera
from lerobot_camera_tactflow.configuration import Output, TactflowCameraConfig

__all__ = ["Output", "TactflowCamera", "TactflowCameraConfig"]
