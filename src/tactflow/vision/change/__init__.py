"""Change probe: is anything different from the last frame that was worked on?"""

from tactflow.vision.change.hold import ChangeHold
from tactflow.vision.change.probe import ChangeProbe

__all__ = ["ChangeHold", "ChangeProbe"]
